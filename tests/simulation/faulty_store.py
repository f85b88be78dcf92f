"""Object store in memory for simulations: requests take virtual time, are refused, lose their answers, arrive late, and are observed."""

import contextlib
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from synpick_warp.system.stores.store import Store
from tests.simulation.scheduler import Process, Simulation

LATENCY = 0.05
"""Longest virtual time to the store, and back [s]."""
LATE = 5.0
"""Longest delay of a request that its client took for lost [s]."""
REFUSED, LOST, DELAYED = "refused", "lost", "delayed"
"""Faults: the request is refused; it is carried out, but its answer is lost; the client gives it up, and it is carried out later."""


class _Error(Exception):
    """As obstore's BaseError."""


class _AlreadyExistsError(_Error):
    """As obstore's."""


class _PreconditionError(_Error):
    """As obstore's."""


class Write(NamedTuple):
    """Write that the store carried out: by whom, where, what, and what was there before."""

    process: Process
    key: str
    data: bytes | None
    before: bytes | None


class FaultyStore:
    """Objects with versions, in place of the module `obstore` and of a store of it: strongly consistent, as S3, GCS and Azure are."""

    def __init__(self, simulation: Simulation, faults: dict[str, float] | None = None) -> None:
        """`faults`: probability of each."""
        self.simulation, self.faults = simulation, faults or {}
        self.objects: dict[str, tuple[bytes, dict[str, Any]]] = {}
        """Content and metadata."""
        self.injected = dict.fromkeys((REFUSED, LOST, DELAYED), 0)
        """Number of faults so far."""
        self.observe: Callable[[Write], object] = lambda write: None
        """Called at each write that is carried out, before it is."""
        self._version = 0
        self._clients = Process("network")
        names = {"BaseError": _Error, "AlreadyExistsError": _AlreadyExistsError, "PreconditionError": _PreconditionError}
        self.exceptions = types.SimpleNamespace(**names)

    def open(self, process: Process, url: str = "s3://simulated") -> Store:
        """The product's store, by which a process uses this one."""
        store = object.__new__(Store)
        vars(store).update(url=url, _store=process, _obs=self, _errors=self.exceptions)
        return store

    def _request(self, carry_out: Callable[[], Any], *, may_delay: bool = False) -> Any:
        """Carry out a request, or inject a fault."""
        draw = self.simulation.draw
        late_answer = draw.random() < 0.5  # Not both of its ways take time, since each costs a change of threads.
        if not late_answer:
            self.simulation.wait(LATENCY * draw.random())
        number, fault = draw.random(), ""
        for name, share in self.faults.items():
            if number < share:
                fault = name if may_delay or name != DELAYED else ""
                break
            number -= share
        if fault:
            self.injected[fault] += 1
        if fault == REFUSED:
            raise _Error("status code: 503 SlowDown")
        if fault == DELAYED:
            self.simulation.start(self._clients, lambda: self._carry_out_late(carry_out, LATE * draw.random()))
            raise _Error("timed out")
        result = carry_out()
        if late_answer:
            self.simulation.wait(LATENCY * draw.random())
        if fault == LOST:
            raise _Error("connection reset")
        return result

    def _carry_out_late(self, carry_out: Callable[[], Any], seconds: float) -> None:
        self.simulation.wait(seconds)
        with contextlib.suppress(_Error, FileNotFoundError):
            carry_out()

    def put(self, process: Process, key: str, data: bytes | Path, *, mode: Any = "overwrite", **_: Any) -> dict[str, Any]:
        content = data if isinstance(data, bytes) else data.read_bytes()

        def carry_out() -> dict[str, Any]:
            found = self.objects.get(key)
            if mode == "create" and found is not None:
                raise _AlreadyExistsError(key)
            if isinstance(mode, dict) and (found is None or found[1]["e_tag"] != mode["e_tag"]):
                raise _PreconditionError(key)
            self.observe(Write(process, key, content, found and found[0]))
            self._version += 1
            meta = {"path": key, "size": len(content), "e_tag": str(self._version), "version": None, "last_modified": None}
            self.objects[key] = content, meta
            return meta

        return self._request(carry_out, may_delay=True)

    def _find(self, key: str) -> tuple[bytes, dict[str, Any]]:
        if key not in self.objects:
            raise FileNotFoundError(f"no object {key}")
        return self.objects[key]

    def head(self, _: Process, key: str) -> dict[str, Any]:
        return self._request(lambda: self._find(key)[1])

    def get(self, _: Process, key: str, options: dict[str, Any] | None = None) -> Any:
        def carry_out() -> Any:
            data, meta = self._find(key)
            start, end = (options or {}).get("range", (0, len(data)))
            return types.SimpleNamespace(meta=meta, bytes=lambda: data[start:end])

        return self._request(carry_out)

    def list(self, _: Process, folder: str | None, offset: str | None, chunk_size: int) -> Iterator[list[dict[str, Any]]]:
        def carry_out() -> list[dict[str, Any]]:
            prefix, after = f"{folder}/" if folder else "", offset or ""
            inside = sorted([key for key in self.objects if key > after and key.startswith(prefix)])
            return [self.objects[key][1] for key in inside[:chunk_size]]

        return iter([self._request(carry_out)])

    def delete(self, process: Process, key: str) -> None:
        def carry_out() -> None:
            self.observe(Write(process, key, None, self._find(key)[0]))
            del self.objects[key]

        self._request(carry_out, may_delay=True)
