"""Entry point of `python -m synpick_warp`: the command line."""

from __future__ import annotations

import sys

from synpick_warp.cli.commands import main

if __name__ == "__main__":
    sys.exit(main())
