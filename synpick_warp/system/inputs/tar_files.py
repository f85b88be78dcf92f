"""Members of tar files (webdataset shards), listed by their headers alone."""

import re
import tarfile
from pathlib import Path
from typing import BinaryIO

from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import check_regular_file, describe_bytes
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE

MAX_SHARD = 2**44
"""Largest shard [bytes]: the limit of a file on ext4."""
_EXTENDED = (tarfile.XHDTYPE, tarfile.XGLTYPE)
_MAX_EXTENDED = 2**16
"""Largest extended header that is looked at [bytes]; one of times has some 30."""
_CHANGES = re.compile(rb"\d+ (?:path|size|GNU\.sparse[^=]*)=")
"""Records of an extended header that say otherwise than the member's own header."""
_ADVICE = "restore the file, or bake the data set again"


def list_members(shard: Path, advice: str = _ADVICE, *, extended: bool = False) -> list[tuple[str, int, int]]:
    """List the members of a tar file: name, offset and size [B]. Only headers are read; members must be regular files, as in shards.

    Python's tarfile calls itself for each extended header, and so ends in a RecursionError on a chain of them. `shard`: the file. `advice`:
    what to do if it is damaged. `extended`: whether extended headers (POSIX.1-2001) are passed over, which shards of others have for times
    of fractions of a second; those that rename or resize a member are never taken. Raises DatasetError: the file cannot be read, is
    truncated, or has another member: a link, a device, a sparse file, an extended header."""
    check_regular_file(shard, MAX_SHARD, DatasetError)
    members = []
    try:
        with shard.open("rb") as file:
            end = shard.stat().st_size
            while any(block := file.read(tarfile.BLOCKSIZE)):
                info = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
                start = file.tell()
                if (
                    extended
                    and info.type in _EXTENDED
                    and info.size <= _MAX_EXTENDED
                    and not _CHANGES.search(_read_blocks(file, info.size))
                ):
                    continue
                if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
                    raise DatasetError(f"{shard} has a member at byte {start - len(block)} that is not a regular file; {advice}")
                if not 0 <= info.size <= min(MAX_IMAGE_FILE, end - start):
                    raise DatasetError(
                        f"{shard} is damaged: the member at byte {start - len(block)} has {describe_bytes(info.size)}; {advice}"
                    )
                members.append((info.name, start, info.size))
                file.seek(start + -(-info.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE)
    except OSError as error:
        raise DatasetError(f"{shard} cannot be read: {error.strerror}") from None
    except (tarfile.TarError, ValueError) as error:  # Names that are not UTF-8 are ValueErrors.
        raise DatasetError(f"{shard} is damaged: {error}; {advice}") from None
    return members


def _read_blocks(file: BinaryIO, size: int) -> bytes:
    """Read the content of a tar member, and the padding of its last block."""
    return file.read(-(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE)
