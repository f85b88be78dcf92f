"""Cache folders: compiled kernels (WARP_CACHE_PATH) and collision shapes (XDG_CACHE_HOME), and what stands in for one that is unusable.

Both lie in the user's cache directory (XDG base directory specification) unless a variable moves them. A home that is missing, a file,
read-only or full is common in containers and batch systems, and no reason to fail.
"""

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

from synpick_warp.errors import SynpickError
from synpick_warp.system.inputs.files import make_folder

KERNEL_VARIABLE = "WARP_CACHE_PATH"
"""Moves the cache of compiled kernels."""
USER_VARIABLE = "XDG_CACHE_HOME"
"""Moves all caches of a user, as far as no other variable does."""
MIN_FREE = 2**27
"""Free space below which a cache counts as full [bytes]; all kernels of a bake take some 50 MB."""
_PROBE = b"\0" * 4096


class CacheError(SynpickError):
    """Neither the cache nor the temporary folder can be written."""


def user_cache() -> Path | None:
    """The user's cache directory; None: the user has no home."""
    base = os.environ.get(USER_VARIABLE, "")
    if os.path.isabs(base):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return None


def kernel_cache(version: str) -> Path | None:
    """Folder of the kernels that a version of Warp compiles, as Warp chooses it itself."""
    base = os.environ.get(KERNEL_VARIABLE)
    if base is not None:
        return Path(os.path.realpath(base), version)
    user = user_cache()
    return None if user is None else user / "warp" / version


def usable_kernel_cache(version: str) -> Path | None:
    """Check the kernel cache; make a temporary one, with a note on the standard error, if it cannot be written.

    Kernels that the unusable cache has are linked into the temporary one, which is removed when the process ends.
    Returns the temporary folder; None: Warp's own choice can be written. Raises CacheError: there is no room for a temporary folder either.
    """
    cache = kernel_cache(version)
    reason = "the user has no home" if cache is None else find_fault(cache)
    if reason is None:
        return None
    try:
        folder = Path(tempfile.mkdtemp(prefix="synpick-warp-kernels-"))
    except OSError as fault:
        raise CacheError(
            f"the kernel cache cannot be used ({cache or '~/.cache'}: {reason}), nor can a temporary folder ({fault.strerror}); "
            f"set {KERNEL_VARIABLE} to a folder that can be written"
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if cache is not None:
        link_files(cache, folder / version)
    print(
        f"synpick-warp: note: the kernel cache {cache or '~/.cache/warp'} cannot be used ({reason}); kernels are compiled into {folder}, "
        f"for this run only; set {KERNEL_VARIABLE} to a folder that can be written",
        file=sys.stderr,
    )
    return folder


def find_fault(folder: Path) -> str | None:
    """Find out why a folder cannot be written, by writing into it; it is created if missing. None: it can."""
    try:
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(_PROBE)
            probe.flush()
        space = os.statvfs(folder)
    except (OSError, ValueError) as fault:  # ValueError: a null byte in a variable.
        return getattr(fault, "strerror", None) or str(fault)
    free = space.f_bavail * space.f_frsize
    return f"only {free // 2**20} MiB are free" if space.f_blocks and free < MIN_FREE else None


def link_files(source: Path, target: Path) -> None:
    """Mirror a folder: folders are made, files are symbolic links. Stops silently where something cannot be read or written."""
    with contextlib.suppress(OSError):
        for parent, _, names in os.walk(source):
            folder = target / Path(parent).relative_to(source)
            make_folder(folder)
            for name in names:
                (folder / name).symlink_to(Path(parent, name))
