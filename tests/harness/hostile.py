"""Hostile copies of JSON files: truncated, of other types, nested too deeply, with a wrong value at each leaf. Fuzz tests: number of
examples, short in the suite, longer by SYNPICK_FUZZ_EXAMPLES; what does not count as an input's time."""

import copy
import json
import os
from collections.abc import Iterator
from typing import Any

from synpick_warp.system.processes import isolation

DEPTH = 100_000
WHOLE = {
    "empty": b"",
    "list": b"[]",
    "number": b"3",
    "string": b'"x"',
    "null": b"null",
    "object": b"{}",
    "nan": b"NaN",
    "nested": b"[" * DEPTH,
    "nested objects": b'{"a":' * DEPTH,
    "many digits": b"9" * 5000,
    "not utf-8": b'{"\xff": "\xfe"}',
    "byte order mark": b"\xef\xbb\xbf{}",
    "binary": bytes(range(256)),
}
"""Contents that replace a whole file."""
LEAVES = ("x", None, [], {}, -1, 10**30, 1.5, True, [[]], "../../evil", "\x00", "\ud800")
"""Values that replace a leaf or a branch."""


def hostile_contents(data: bytes) -> Iterator[tuple[str, bytes]]:
    """(description, content) of hostile replacements of a JSON file; the number of leaves times LEAVES, and some."""
    yield from WHOLE.items()
    for fraction in (0.25, 0.5, 0.99):
        yield f"truncated to {fraction}", data[: int(fraction * len(data))]
    document = json.loads(data)
    for place in places(document):
        for value in LEAVES:
            yield f"{place} = {value!r}", json.dumps(replaced(document, place, value)).encode()
        yield f"{place} = NaN", json.dumps(replaced(document, place, float("nan"))).encode()
        yield f"{place} removed", json.dumps(removed(document, place)).encode()


def places(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all branches and leaves; of long lists and objects the first two and the last."""
    if path:
        yield path
    keys = list(document) if isinstance(document, dict) else list(range(len(document))) if isinstance(document, list) else []
    for key in dict.fromkeys([*keys[:2], *keys[-1:]] if len(keys) > 12 else keys):
        yield from places(document[key], (*path, key))


def replaced(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at one place; it shares what lies beside the place."""
    changed, parent = _copied(document, place)
    parent[place[-1]] = value
    return changed


def removed(document: Any, place: tuple[Any, ...]) -> Any:
    """A copy without one key or element; it shares what lies beside the place."""
    changed, parent = _copied(document, place)
    del parent[place[-1]]
    return changed


def _copied(document: Any, place: tuple[Any, ...]) -> tuple[Any, Any]:
    """A copy of the branches on the way to a place, and the last of them."""
    parent = changed = copy.copy(document)
    for key in place[:-1]:
        parent[key] = copy.copy(parent[key])
        parent = parent[key]
    return changed, parent


def fuzz_examples(default: int) -> int:
    """Examples of a fuzz test: `default`, or the environment variable SYNPICK_FUZZ_EXAMPLES."""
    return int(os.environ.get("SYNPICK_FUZZ_EXAMPLES", default))


def start_isolation() -> None:
    """Start the server of isolated processes, if it does not run: its start does not count as time that an input takes."""
    worker = isolation._server._worker
    if worker is None or worker.process.poll() is not None:
        list(isolation.run_isolated(abs, [(1,)], isolation.Limits(60.0, 2**30)))
