"""URL detection: tells URLs of object stores from paths of folders. Imports no store, so that each command can afford it."""

from __future__ import annotations

import re
from pathlib import Path

_URL = re.compile(r"([a-z][a-z0-9+.-]+):(?:/+(.*))?", re.DOTALL | re.IGNORECASE)


def as_url(place: Path | str | None) -> str | None:
    """Normalize a URL: scheme in lower case, "://" where `Path` has collapsed it to ":/", no trailing slashes. None: a local path."""
    match = _URL.fullmatch(str(place)) if place is not None else None
    if match is None:
        return None
    scheme, rest = match[1].lower(), match[2] or ""
    return f"{scheme}://{'/' if scheme == 'file' else ''}{rest.rstrip('/')}"
