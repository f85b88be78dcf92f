"""Recognition of URLs among folders. Apart from the stores, since each command and `import synpick_warp` need it."""

from __future__ import annotations

import re
from pathlib import Path

_URL = re.compile(r"([a-z][a-z0-9+.-]+):(?:/+(.*))?", re.DOTALL)


def as_url(place: Path | str | None) -> str | None:
    """URL that a place names; None: it is a folder. A `Path` has lost one of the URL's slashes."""
    match = _URL.fullmatch(str(place)) if place is not None else None
    if match is None:
        return None
    scheme, rest = match[1], match[2] or ""
    return f"{scheme}://{'/' if scheme == 'file' else ''}{rest.rstrip('/')}"
