"""Places of data sets: a folder of this machine, also as a file:// URL, or a prefix in an object store by its URL. Imports no store."""

import re
from pathlib import Path
from urllib.parse import unquote_to_bytes

from synpick_warp.errors import DeviceError, StoreError, escape, shorten, suggest

SCHEMES = ("s3", "gs", "az")
"""Schemes of object stores."""
FILE = "file"
RAY = "ray"
_ALLOWED = "allowed: s3://bucket/prefix, gs://bucket/prefix, az://container/prefix, or a folder, also as file:///folder"
_URL = re.compile(r"([a-z][a-z0-9+.-]+(?:::[a-z0-9+.-]+)*):(/{,2})(.*)", re.DOTALL | re.IGNORECASE)
_WORD = re.compile(rf"(--[a-z][a-z-]*=)?((?:{'|'.join((*SCHEMES, FILE))}):.*)", re.DOTALL | re.IGNORECASE)
_ENGINE = re.compile(rf"{RAY}(://(\[[0-9a-fA-F:]+\]|[\w.-]+):[0-9]{{1,5}})?")
_BUCKET = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{,218}[A-Za-z0-9])?")
_SECRET = re.compile(r"[@?#]|%(?:40|3f|23)", re.IGNORECASE)
"""Delimiters, also coded, before or behind which a URL has passwords and signatures: no message shows a URL that has one."""


def parse_place(place: Path | str) -> Path | str:
    """Parse the place of a data set: the path of a folder, or the URL of a prefix in an object store, without a slash at its end.

    `Path` collapses "://" to ":/", which is a store in a `Path` alone; file URLs are text, as "file:/host/x" might have named a host.
    Raises StoreError: the scheme is unknown, or the URL is not of the form of its scheme."""
    match = _URL.fullmatch(str(place))
    scheme = match[1].lower() if match else ""
    if match is None or (match[3] and not match[2] and scheme not in (*SCHEMES, FILE)):
        return Path(place)
    rest = match[3].rstrip("/")
    shown = f"{scheme}://…" if _SECRET.search(rest) else shorten(f"{scheme}:{match[2]}{rest}")
    if scheme == FILE:
        if isinstance(place, Path):
            raise StoreError(f"{shown} is a URL in a Path, which drops slashes; name it as text, or the folder by its path")
        return _parse_file(match[2] + match[3], shown)
    if scheme not in SCHEMES:
        others = "bake into a folder for other services, and copy it by their own programs, such as hf upload or sftp"
        raise StoreError(f"{escape(scheme)}:// is no store known here{suggest(scheme, SCHEMES)}; {_ALLOWED}; {others}")
    bucket, _, prefix = rest.partition("/")
    if len(match[2]) < (1 if isinstance(place, Path) else 2):
        raise StoreError(f"{shown} has not two slashes before its bucket; write {scheme}://bucket/prefix")
    if re.search(r"[@?#%\\]", rest) or not rest.isprintable():
        reason = "has one of @ ? # % \\ or a control character"
        raise StoreError(f"{shown} {reason}; name bucket and prefix alone, and set credentials in the environment")
    if not bucket or _BUCKET.fullmatch(bucket) is None:
        raise StoreError(f"{shown} names no bucket; name one with a prefix, such as {scheme}://bucket/prefix")
    if prefix and not {"", ".", ".."}.isdisjoint(prefix.split("/")):
        raise StoreError(f"{shown} has a part . or .., or an empty one; name a prefix without")
    return f"{scheme}://{rest}"


def _parse_file(text: str, shown: str) -> Path:
    """Path of a file URL (RFC 8089), given what follows "file:"; `shown`: the URL in messages. Raises StoreError."""
    host, path = "", text
    if text.startswith("//"):
        host, slash, path = text[2:].partition("/")
        path = f"{slash}{path.lstrip('/')}"
    if not path.startswith("/") or host.lower() not in ("", "localhost"):
        raise StoreError(f"{shown} is not of this machine; write file:///folder, or mount the other machine's folder and name its path")
    data = unquote_to_bytes(path)
    if re.search(r"[?#]|%(?![0-9a-f]{2})|%2f|%00", path, re.IGNORECASE):
        raise StoreError(f"{shown} has ?, # or %, and not as %3F, %23 or %25, or a coded slash or zero; name the folder by its path")
    try:
        return Path(data.decode())
    except UnicodeDecodeError:
        raise StoreError(f"{shown} is not UTF-8; name the folder by its path") from None


def store_url(place: Path | str | None) -> str | None:
    """URL of a place in an object store; None: a folder, or no place. Raises as `parse_place`."""
    found = None if place is None else parse_place(place)
    return found if isinstance(found, str) else None


def resolve_word(word: str) -> str:
    """Word of a command line with its place as `parse_place` has it, if it is a URL, or one follows an option's "=".

    Raises as `parse_place`."""
    match = _WORD.fullmatch(word)
    return word if match is None else f"{match[1] or ''}{parse_place(match[2])}"


def check_engine(engine: str) -> None:
    """Check the name of a cluster of claiming workers. Raises DeviceError."""
    if _ENGINE.fullmatch(engine) is None:
        raise DeviceError(f"--engine is {engine}; allowed: ray, or ray://HOST:PORT of a Ray Client, such as ray://head:10001")
