"""Entry point of `python -m synpick_warp`: the command line."""

import gc
import sys

from synpick_warp.system.processes.interrupt import KeptInterrupt


def start() -> int:
    """Run the command line; an interrupt while its modules are imported is one line, too."""
    try:
        with KeptInterrupt():
            from synpick_warp.cli.main import main
    except KeyboardInterrupt:
        print("synpick-warp: interrupted", file=sys.stderr)
        return 130  # 128 + SIGINT, the shell convention
    code = main()
    gc.freeze()  # Otherwise the interpreter's last collection walks all that was imported, for some 2 s.
    return code


if __name__ == "__main__":
    sys.exit(start())
