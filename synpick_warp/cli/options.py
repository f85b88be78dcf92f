"""Shared parts of the commands: option parsers, range checks, an exit code, errors in one line, examples for `--help`, default paths.

A data set is a folder with manifest.json and manifest/. Commands take the current folder if it is one, else that of a bake without --out.
"""

from __future__ import annotations

import errno
import os
import re
import resource
import stat
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import CycloptsError, MissingArgumentError, Parameter, Token, UnusedCliTokensError

from synpick_warp.errors import ConfigError, DatasetError, OutputError, escape, format_value
from synpick_warp.system.inputs.urls import check_engine, store_url

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

EXIT_INCOMPLETE = 1
"""Exit code if a data set is incomplete or damaged."""
MAX_DIGITS = 100
"""Maximum number of digits of an integer option; its range is checked by the setting."""
MAX_THREADS = 1024
"""Upper bound of options such as --threads, in processes or threads."""
MAX_WORKERS, MAX_PRICE = 100_000, 1e6
"""Upper bounds of --workers and --price."""
MAX_LINE = 2000
"""Length to which messages are truncated [characters]: names of files and keys may be of any length."""
_WHOLE = re.compile(rf"[+-]?[0-9]{{1,{MAX_DIGITS}}}")
_SHARD = re.compile(r"([0-9]{1,9})/([0-9]{1,9})")
_RESOLUTION = re.compile(r"([0-9]{1,9})[xX]([0-9]{1,9})")


def parse_whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """Parse an integer option of decimal digits; raises ConfigError for any other form, such as 1e3 or 0x10, instead of converting it."""
    text = tokens[0].value
    if _WHOLE.fullmatch(text) is None:
        option = tokens[0].keyword or "the number"
        raise ConfigError(f"{option} is {format_value(text)}; allowed: a whole number in decimal digits, such as 8")
    return int(text)


def parse_count(kind: Any, tokens: Sequence[Token]) -> int:
    """Parse a count option: an integer, or `auto`, which is 0. Errors as in `parse_whole_number`."""
    return 0 if tokens[0].value == "auto" else parse_whole_number(kind, tokens)


WholeNumber = Annotated[int, Parameter(converter=parse_whole_number)]
"""Type of integer options."""
Count = Annotated[int, Parameter(converter=parse_count)]
"""Type of count options that accept `auto`."""

DataSetArgument = Annotated[
    Path | None, Parameter(name="DIR", help="A data set (default: the current folder if it is one, or synpick-data in it).")
]
EpisodesOfOption = Annotated[str | None, Parameter(name="--split", help="Only the episodes of this split (default: all splits).")]
PaperOption = Annotated[
    bool | None,
    Parameter(help="Show the numbers of the SynPick paper beside these, or don't (default: if the objects are those of the paper)."),
]
"""Type of the option for the comparison with the paper."""


def one_line(text: str) -> str:
    """Format a message as one line: lines joined, unprintable characters escaped (terminal sequences in file names), truncated."""
    line = escape(" ".join(text.split()))
    return line if len(line) <= MAX_LINE else f"{line[: MAX_LINE - 1]}…"


def describe_misuse(error: CycloptsError) -> str:
    """Error message for a command line that does not parse: names the unexpected word, or the option that is missing or lacks a value."""
    command, words = " ".join(error.command_chain or ()), list(error.unused_tokens or [])
    extra = f"{format_value(words[0])} is neither an option nor the value of one" if words else ""
    if isinstance(error, UnusedCliTokensError) and words:
        return f"{extra}; see synpick-warp {command} --help"
    if not isinstance(error, MissingArgumentError) or error.argument is None:
        return str(error)
    if error.keyword is None:
        return f"{command} needs {error.argument.name}{', and ' if extra else ''}{extra}; see synpick-warp {command} --help"
    value = next(iter(words[words.index(error.keyword) + 1 :]), "") if error.keyword in words else ""
    return f"{error.keyword} has no value" + (f"; if {value} is one, write {error.keyword}={value}" if value.startswith("-") else "")


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raise ConfigError unless the value of a numeric option lies in [low, high]."""
    if not low <= value <= high:
        shown = f"{value:g}" if isinstance(value, float) else value
        raise ConfigError(f"{option} is {shown}; allowed: {low} to {high}")


def parse_resolution(text: str) -> list[int]:
    """Parse "640x360" into width and height [px]; raises ConfigError if the text has another form."""
    match = _RESOLUTION.fullmatch(text)
    if match is None:
        raise ConfigError(f"--resolution is {format_value(text)}; allowed: WIDTHxHEIGHT in pixels, such as 640x360")
    return [int(match[1]), int(match[2])]


def parse_splits(text: str | None) -> tuple[str, ...]:
    """Parse "train,test" into names; None: no names."""
    return () if text is None else tuple(name.strip() for name in text.split(","))


def parse_devices(devices: str | None, device: str | None, profile: bool) -> tuple[str, ...]:
    """Parse "cuda:0,cuda:1" into names; None: no names. Raises ConfigError if another option cannot be beside it."""
    if devices is None:
        return ()
    if device is not None:
        raise ConfigError("--device and --devices are both given; name one device by --device, or several by --devices")
    if profile:
        raise ConfigError("--profile records the process of one device; name it by --device, not by --devices")
    return tuple(name.strip() for name in devices.split(","))


def check_engine_options(engine: str | None, workers: int, price: float, out: Path | None, beside: str | None, claims: bool) -> None:
    """Check --engine, --workers and --price. `beside`: value of an option that an engine excludes; `claims`: --claim is given, so that
    workers on --devices have a price, too. Raises ConfigError if an option is out of range, or does not go with the others, and DeviceError
    if there is no such engine."""
    if engine is None and (workers or (price and not (claims and beside))):
        raise ConfigError("--workers and --price go with --engine; name one, such as ray. --price also goes with --claim --devices")
    check_range("--workers", workers, 0, MAX_WORKERS)
    check_range("--price", price, 0.0, MAX_PRICE)
    if engine is None:
        return
    check_engine(engine)
    if store_url(out) is None:
        raise ConfigError("--engine has workers claim episodes of a prefix in an object store; name one by --out, as s3://bucket/prefix")
    if beside is not None:
        raise ConfigError("--engine has workers claim episodes; drop --devices and --shard")


def check_store_options(out: Path | None, *, claim: bool, shard: str | None, profile: bool) -> None:
    """Check that options fit the output, a folder or a prefix in an object store; raises ConfigError."""
    url = store_url(out)
    if claim and url is None:
        raise ConfigError("--claim shares out the episodes of a prefix in an object store; name one by --out, as s3://bucket/prefix")
    if claim and shard is not None:
        raise ConfigError("--claim and --shard both share out the episodes; drop one of them")
    if url is not None and profile:
        raise ConfigError(f"--profile writes beside a data set, and --out is {url}; profile a bake into a folder")


def parse_shard(text: str) -> tuple[int, int]:
    """Parse "0/4" into shard index and number of shards; raises ConfigError if the text has another form."""
    match = _SHARD.fullmatch(text)
    if match is None:
        raise ConfigError(f"--shard is {format_value(text)}; allowed: i/n with i from 0 to n - 1, such as 0/4")
    return int(match[1]), int(match[2])


EXAMPLES = {
    "bake": (
        "bake --config smoke --episodes 1 --out DATA",
        "bake --worlds 512 --mode mixed --models YCB --lights HDRI",
        "bake --config cell/cell.toml --formats bop,zarr --set 'render.layers=[normals]'",
        "bake --worlds 512 --dry-run",
        "bake --devices all --out DATA",
    ),
    "merge": ("merge PART0 PART1 --out DATA",),
    "doctor": ("doctor", "doctor --config cell/cell.toml --memory"),
    "warmup": ("warmup --mode mixed --models YCB",),
    "config": ("config --presets", "config --config smoke", "config --config smoke --set move.force=12"),
    "new-cell": (
        "new-cell cell --calibration left.yaml --bin 600x400x220mm --part bracket.stl --unit mm",
        "new-cell cell --bin bin.stl --bin-unit mm",
    ),
    "preview": ("preview DATA --out sheet.png", "preview --cell cell/cell.toml --out cell.png"),
    "explain": ("explain DATA --episode 3", "explain DATA --state 0"),
    "eval": ("eval DATA --results results.csv",),
    "estimate": ("estimate DATA --method refine --out results.csv",),
    "convert": ("convert DATA --to usd,coco --out MORE",),
    "stats": ("stats DATA", "stats DATA --paper"),
    "validate": ("validate DATA", "validate REAL --tolerance 5,2"),
    "verify": ("verify DATA",),
    "prove": ("prove DATA --share 0.01",),
    "report": ("report DATA",),
}
"""Example command lines by name of the command, without the program's name, which `--help` prints below the options."""


_REMEDIES = {
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "close other programs: the system has too many files open",
    errno.ENOMEM: "free memory, or raise its limit (ulimit -v)",
    errno.EAGAIN: "close other programs, or raise the limit of processes (ulimit -u)",
}
_MEMORY = ("memory", "failed to map segment", "unable to allocate")
"""Parts of the messages of other libraries that ran out of memory, in lower case."""
_NO_ERROR = "without exception set"
"""What the interpreter says of an extension, or of itself, that ran out of memory without raising `MemoryError`."""
_FILES = "too many open files"
_NO_THREAD = "can't start new thread"


def describe_limit(error: BaseException) -> str | None:
    """Describe the resource that ran out, according to an error or its causes, and the remedy; None: none did."""
    for each in _chain(error):
        text = " ".join(str(each).split())
        low = text.lower()
        foreign = isinstance(each, ImportError) or type(each).__module__ == "cv2"
        if isinstance(each, OSError) and each.errno in _REMEDIES:
            return f"{text}; {_REMEDIES[each.errno]}"
        if isinstance(each, RuntimeError) and _NO_THREAD in low:
            return f"no thread can be started; {_REMEDIES[errno.EAGAIN]}"
        if isinstance(each, MemoryError) or (foreign and any(part in low for part in _MEMORY)):
            return f"memory is exhausted{f' ({text})' if text else ''}; {_REMEDIES[errno.ENOMEM]}"
        if isinstance(each, SystemError) and _NO_ERROR in low and resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY:
            return f"a library failed without a reason, as some do without memory ({text}); {_REMEDIES[errno.ENOMEM]}"
        if foreign and _FILES in low:
            return f"{text}; {_REMEDIES[errno.EMFILE]}"
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Exception chain: an error, then its causes and contexts."""
    following: BaseException | None = error
    while following is not None:
        yield following
        following = following.__cause__ or following.__context__


DEFAULT_NAME = "synpick-data"
"""Folder of a bake without --out."""
OWN_SUFFIXES = (".png", ".jpg", ".jpeg", ".html", ".htm", ".csv")
"""File suffixes of pictures, pages and tables. No data format writes such files at the top of a data set, so outputs may lie there."""


def is_data_set(folder: Path | str) -> bool:
    """Whether a folder contains a data set's manifest and its folder of entries; neither is read."""
    return _has(f"{folder}/manifest.json", stat.S_ISREG) and _has(f"{folder}/manifest", stat.S_ISDIR)


def _has(path: str, kind: Callable[[int], bool]) -> bool:
    """Whether the path exists and has this file type; symbolic links are not followed."""
    try:
        return kind(os.lstat(path).st_mode)
    except (OSError, ValueError):
        return False


# ---- which data set is read ----


def find_data_set(named: Path | None, usage: str) -> Path:
    """Return the data set that is named, which is not checked, or else the current folder or `DEFAULT_NAME` in it, which is announced on
    the standard error. `usage`: how the command is called with a folder. Raises DatasetError if there is none."""
    if named is not None:
        url = store_url(named)
        return named if url is None else _fetch(url)
    found = next(filter(is_data_set, (".", DEFAULT_NAME)), None)
    if found is None:
        raise DatasetError(f"there is no data set in the current folder; name one ({usage}), or make one first (synpick-warp bake)")
    folder = Path.cwd() if found == "." else Path(found)
    print(one_line(f"synpick-warp: data set: {folder} ({usage} takes another)"), file=sys.stderr)
    return folder


_fetched: dict[Path, tuple[str, TemporaryDirectory[str]]] = {}
"""Temporary copies of data sets in object stores: folder -> URL and its finalizer."""


def _fetch(url: str) -> Path:
    """Copy a data set in an object store into a temporary folder, which `drop_fetched` deletes; returns the copy's folder."""
    from synpick_warp.cli.display import count_on_stderr
    from synpick_warp.cloud.reading import copy_set

    place = TemporaryDirectory(prefix="synpick-read-")
    folder = Path(place.name) / url.rpartition("/")[2]
    _fetched[folder] = url, place
    with count_on_stderr() as counter:
        copy_set(url, folder, report=counter.report)
    return folder


def drop_fetched() -> None:
    """Delete the copies of data sets in object stores."""
    while _fetched:
        _fetched.popitem()[1][1].cleanup()


def name_fetched(text: str) -> str:
    """Replace folders of temporary copies in a message by the URLs of their data sets."""
    for folder, (url, _) in _fetched.items():
        text = text.replace(str(folder), url)
    return text


# ---- where outputs go ----


def beside(folder: Path, ending: str) -> Path:
    """Path of an output beside a data set: its folder's name with an ending; in the current folder, if the set is in an object store."""
    if folder in _fetched:
        return Path(f"{folder.name}{ending}")
    place = folder if folder.name not in ("", "..") else folder.resolve()
    return place.with_name(f"{place.name or 'data-set'}{ending}")


def check_output_file(
    out: Path, option: str, data_set: Path | None = None, inputs: Sequence[Path] = (), *, is_folder: bool = False
) -> None:
    """Raise OutputError if an output replaces a file of a data set, or one that the command reads; call it before anything is read.

    In the folder of a data set itself files, but no folders, may have the suffixes OWN_SUFFIXES; in its subfolders there are no outputs.
    `data_set` is the one that the command reads, which may be one of other programs; `inputs` are other files that it reads.
    """
    from synpick_warp.exporters.writing.files import check_local

    check_local(out, option)
    try:
        place = out.parent.resolve() / out.name
        roots = [folder for folder in place.parents if is_data_set(folder)]
        if data_set is not None and data_set.resolve() in place.parents:
            roots.append(data_set.resolve())
        same = next((path for path in inputs if path.resolve() in (place, out.resolve())), None)
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"{option} is {out}: {getattr(error, 'strerror', None) or error}") from None
    if same is not None:
        raise OutputError(f"{option} is {out}, which the command reads; name another file")
    for root in roots:
        if is_folder or place.parent != root or place.suffix.lower() not in OWN_SUFFIXES:
            kind = "folder" if is_folder else "file"
            raise OutputError(f"{option} is {out}, among the files of the data set {root}; name a {kind} outside of it")


def check_new_folder(folder: Path, option: str) -> None:
    """Check that an output folder is new or empty and that its parent exists; raises OutputError. Permissions are not tested."""
    try:
        if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{option} is {folder}; allowed: a new or an empty folder")
        parent = next(path for path in folder.absolute().parents if os.path.lexists(path))
    except (OSError, ValueError) as error:
        raise OutputError(f"{option} is {folder}: {getattr(error, 'strerror', None) or error}; name another folder") from error
    if not parent.is_dir():
        raise OutputError(f"{option} is {folder}, but {parent} is a file; name another folder")


def open_split(folder: Path, split: str | None) -> DataSet:
    """Open a data set, or one of its splits.

    Raises DatasetError if a baked one lacks its settings or manifest, these are damaged, or it has no such split.
    """
    from synpick_warp.dataset.commit.manifest import read_manifest
    from synpick_warp.dataset.reading import open_data_set

    data_set = open_data_set(folder)
    if data_set.found is None and not (folder / "config.toml").exists():
        raise DatasetError(f"{folder} has no config.toml; name the folder of a data set that synpick-warp baked")
    if (folder / "manifest").is_dir():
        read_manifest(folder)
    return data_set if split is None else data_set.split(split)
