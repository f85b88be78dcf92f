"""Comparisons: data sets, devices, checkouts.

python -m tools.compare runs A B          # two data sets, file by file, such as bakes with different numbers of worlds
python -m tools.compare pictures          # the same pictures on two devices
python -m tools.compare guard OLD NEW     # two checkouts, in all that they write, read and compile
"""

import importlib
import sys

from tools.options import fail

COMMANDS = ("runs", "pictures", "guard")


def main(arguments: list[str]) -> int:
    """Run one comparison; returns the exit code."""
    if not arguments or arguments[0] not in COMMANDS:
        return fail("compare", f"{arguments[0] if arguments else 'nothing'} is no comparison; allowed: {', '.join(COMMANDS)}")
    return importlib.import_module(f"tools.compare.{arguments[0]}").main(arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
