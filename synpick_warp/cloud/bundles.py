"""Archives of index files in an object store: a tar.gz per episode with the inputs of the indices over all episodes.

What an episode adds to lists of lines is made by its worker: the last worker only appends it to the parts of the lists, below LINES.
"""

import gzip
import io
import os
import re
import struct
import tarfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.dataset.commit.manifest import episode_entry, read_checksums, read_entry
from synpick_warp.dataset.commit.writing import list_lines
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.base import Exporter
from synpick_warp.exporters.formats import indexed_files
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.system.inputs.files import make_folder, path_inside

MAX_BUNDLE = 1 << 30
"""Limit of an episode's index file, unpacked [B]: guards against decompression bombs."""
_LINES = re.compile(rf"{re.escape(LINES)}(?:/[^./][^/]*)+")
"""Names of lines in an index file: inside of LINES, which only `unpack_bundle` fills."""
_ADVICE = "delete it and its episode's done mark, manifest/NUMBER.json, and resume the bake without --claim"


def make_bundle(folder: Path, episode: int, settings: ExportSettings, kinds: Sequence[type[Exporter]]) -> bytes:
    """Pack the index file of an episode that is committed in a data set with exporters of these kinds; deterministic on one machine
    (another zlib may compress otherwise). Raises OutputError: the episode was removed."""
    entry = read_entry(folder, episode_entry(episode))
    if entry is None:
        raise OutputError(f"{folder / episode_entry(episode)}.json was removed while it was uploaded; resume the bake")
    packed, names = io.BytesIO(), list(read_checksums(folder, episode_entry(episode)))
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name, lines in list_lines(entry).items():
            _add(archive, f"{LINES}/{name}/0", lines)
        for name, lines in (line for kind in kinds for line in kind.index_lines(folder, settings, names)):
            _add(archive, f"{LINES}/{name}", lines)
        for name in filter(indexed_files(settings.layout.formats).fullmatch, names):
            _add(archive, name, (folder / name).read_bytes())
    return gzip.compress(packed.getvalue(), 6, mtime=0)


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    """Append a member to a tar archive."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    archive.addfile(info, io.BytesIO(data))


def unpack_bundle(data: bytes, folder: Path, indexed: re.Pattern[str], source: str) -> None:
    """Unpack an episode's index file into a folder: files, and lines, which are appended to those of the episodes before.

    Args:
        data: The index file.
        indexed: Pattern of the names of files that indices are made of.
        source: Its object, for messages.

    Raises DatasetError: it is damaged, too large, or has files that no index is made of; OutputError: the folder cannot be written."""
    try:
        stream = zlib.decompressobj(31)
        plain = stream.decompress(data, MAX_BUNDLE)
        if not stream.eof:
            raise DatasetError(f"{source} is damaged: it is cut off or too large; {_ADVICE}")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as archive:
            for info in archive:
                is_lines, content = _LINES.fullmatch(info.name), archive.extractfile(info)
                if content is None or not (is_lines or indexed.fullmatch(info.name)):
                    raise DatasetError(f"{source} is damaged: it has {info.name[:80]!r}; {_ADVICE}")
                path = folder / info.name if is_lines else path_inside(folder, info.name, source, DatasetError)
                if not os.path.exists(path):
                    make_folder(path.parent)
                with open(path, "ab" if is_lines else "wb") as file:
                    file.write(content.read())
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; set TMPDIR to a folder with more space") from None
    except (zlib.error, tarfile.TarError, struct.error, OverflowError, ValueError, RecursionError) as error:
        raise DatasetError(f"{source} is damaged: {error}; {_ADVICE}") from None
