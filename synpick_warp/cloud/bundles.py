"""Archive format of index files, the inputs of the indices over all episodes: one tar.gz per episode, and their concatenation per block.

A shard is reduced to its size and its lines in the index of its split, which its worker makes: the last worker only joins them.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import tarfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from synpick_warp.dataset.commit.manifest import episode_entry, read_checksums
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop.shards.tar_files import key_lines, known_keys
from synpick_warp.system.inputs.paths import path_inside

SIZE, KEYS = "size/", "keys/"
"""Prefixes of the names of shards in an index file, of which it has the size and the `key_lines`."""
MAX_BUNDLE = 1 << 30
"""Limit of an episode's index file, unpacked [B]: guards against decompression bombs."""
_SIZE = struct.Struct("<Q")
"""Size of a shard [B]."""
_LENGTH = struct.Struct("<Q")
"""In a block: length prefix of each index file [B]."""


def make_bundle(folder: Path, episode: int, indexed: re.Pattern[str]) -> bytes:
    """Pack an episode's index file; deterministic on one machine (another zlib may compress otherwise).

    Args:
        folder: Data set with the committed episode.
        episode: Its index.
        indexed: Pattern of the names of files that indices are made of.
    """
    entry = episode_entry(episode)
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        _add(archive, f"{entry}.json", (folder / f"{entry}.json").read_bytes())
        for name in filter(indexed.fullmatch, read_checksums(folder, entry)):
            if name.endswith(".tar"):
                _add(archive, SIZE + name, _SIZE.pack((folder / name).stat().st_size))
                _add(archive, KEYS + name, key_lines(folder / name))
            else:
                _add(archive, name, (folder / name).read_bytes())
    return gzip.compress(packed.getvalue(), 6, mtime=0)


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    """Append a member to a tar archive."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    archive.addfile(info, io.BytesIO(data))


def _restore(name: str, data: bytes, path: Path) -> None:
    """Restore a member of an index file: a shard as a hole of its size, others as they are."""
    if name.startswith(SIZE):
        with path.open("wb") as file:
            file.truncate(_SIZE.unpack(data)[0])
    else:
        (known_keys(path) if name.startswith(KEYS) else path).write_bytes(data)


def unpack_bundle(data: bytes, folder: Path, indexed: re.Pattern[str], source: str) -> None:
    """Unpack an episode's index file into a folder; `source` is its object, for messages.

    Raises:
        DatasetError: It is damaged, too large, or has files that no index is made of.
        OutputError: The folder cannot be written.
    """
    try:
        stream = zlib.decompressobj(31)
        plain = stream.decompress(data, MAX_BUNDLE)
        if not stream.eof:
            raise DatasetError(f"{source} is damaged: it is cut off or too large; delete it and its block's mark, and resume the bake")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as archive:
            for info in archive:
                name = info.name.removeprefix(SIZE).removeprefix(KEYS)
                content = archive.extractfile(info)
                if content is None or not (indexed.fullmatch(name) or re.fullmatch(r"manifest/[0-9]{6,12}\.json", name)):
                    raise DatasetError(f"{source} is damaged: it has {name[:80]!r}; delete it and its block's mark, and resume the bake")
                path = path_inside(folder, name, source, DatasetError)
                path.parent.mkdir(parents=True, exist_ok=True)
                _restore(info.name, content.read(), path)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; set TMPDIR to a folder with more space") from None
    except (zlib.error, tarfile.TarError, struct.error, OverflowError, ValueError, RecursionError) as error:
        raise DatasetError(f"{source} is damaged: {error}; delete it and its block's mark, and resume the bake") from None


def join_bundles(bundles: Iterable[bytes], target: BinaryIO) -> None:
    """Concatenate the index files of a block's episodes, each with a length prefix."""
    for data in bundles:
        target.write(_LENGTH.pack(len(data)))
        target.write(data)


def split_bundles(blocks: Iterable[bytes], episodes: Sequence[int], source: str) -> Iterator[tuple[int, bytes]]:
    """Split a block's content into index files, lazily, each after its episode.

    Args:
        blocks: The content, in pieces of any size.
        episodes: Episodes whose index files it must have, in this order.
        source: Its object, for messages.

    Raises:
        DatasetError: It is truncated, or has another number.
    """
    held, count = bytearray(), 0
    for block in blocks:
        held += block
        while len(held) >= _LENGTH.size and len(held) >= (end := _LENGTH.size + _LENGTH.unpack_from(held)[0]):
            if count < len(episodes):
                yield episodes[count], bytes(held[_LENGTH.size : end])
            count += 1
            del held[:end]
    if held or count != len(episodes):
        raise DatasetError(f"{source} is damaged: it is cut off, or has another number of episodes; delete it, and resume the bake")
