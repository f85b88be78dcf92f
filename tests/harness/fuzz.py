"""Number of examples of fuzz tests: short in the suite, longer by SYNPICK_FUZZ_EXAMPLES."""

from __future__ import annotations

import os


def fuzz_examples(default: int) -> int:
    """SYNPICK_FUZZ_EXAMPLES, or a default."""
    return int(os.environ.get("SYNPICK_FUZZ_EXAMPLES", default))
