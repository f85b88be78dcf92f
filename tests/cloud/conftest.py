"""An S3 server in this process, on 127.0.0.1, that fails on request; settings of a tiny set, and what a local bake makes of them."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from synpick_warp.system.hardware.cores import SETUP
from synpick_warp.system.stores import store
from synpick_warp.system.stores import store as store_module
from synpick_warp.system.stores.store import CONTROL, open_store
from tests.builders import once
from tests.harness import scripted_bake
from tests.harness.scripted_bake import tiny


class Server:
    """Moto's S3 behind a gate: `fault(method, path)` names what happens to a request, None: nothing."""

    def __init__(self) -> None:
        server = pytest.importorskip("moto.server")
        serving = pytest.importorskip("werkzeug.serving")
        self.fault: Callable[[str, str], str | None] = lambda method, path: None
        self._moto = server.DomainDispatcherApplication(server.create_backend_app)
        self._server = serving.make_server("127.0.0.1", 0, self.serve, threaded=True, request_handler=_quiet(serving.WSGIRequestHandler))
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        # A name of threads that launch no kernels: beside others, the bakes of this process would not capture their physics.
        self._thread = threading.Thread(target=self._server.serve_forever, name=f"{SETUP}_0", daemon=True)
        self._thread.start()

    def serve(self, environ: dict[str, Any], start: Callable[..., Any]) -> Any:
        """WSGI application."""
        fault = self.fault(environ["REQUEST_METHOD"], environ["PATH_INFO"])
        if fault == "truncated" and environ["REQUEST_METHOD"] == "PUT":
            body = environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            environ |= {"wsgi.input": io.BytesIO(body[: len(body) // 2]), "CONTENT_LENGTH": str(len(body) // 2)}
        elif fault == "lost":  # Done, but the answer does not arrive.
            list(self._moto(environ, lambda *_: None))
            start("500 Internal Server Error", [])
            return [b""]
        elif fault == "late clock":
            return self._moto(environ, lambda status, headers, *rest: start(status, [_hour_ago(each) for each in headers]))
        elif fault and fault != "truncated":
            code, _, reason = fault.partition(" ")
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start(f"{code} {reason}", [("Content-Type", "application/xml")])
            return [f"<Error><Code>{reason}</Code></Error>".encode()]
        return self._moto(environ, start)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _quiet(kind: type) -> type:
    return type("Quiet", (kind,), {"log_request": lambda *_: None})


def _hour_ago(header: tuple[str, str]) -> tuple[str, str]:
    return (header[0], "Mon, 02 Jan 2023 00:00:00 GMT") if header[0].lower() == "last-modified" else header


@pytest.fixture(scope="session")
def one_server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


@pytest.fixture
def server(one_server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A healthy server, and variables by which clients find it."""
    given = {"ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret", "REGION": "us-east-1", "ENDPOINT_URL": one_server.address}
    for name, value in given.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setattr(store_module, "FIRST_PAUSE", 0.01)
    yield one_server
    one_server.fault = lambda method, path: None


@pytest.fixture
def prefix(server: Server) -> str:
    """A new bucket, and a prefix in it."""
    import urllib.request

    name = f"b{uuid4().hex[:12]}"
    urllib.request.urlopen(urllib.request.Request(f"{server.address}/{name}", method="PUT")).close()
    return f"s3://{name}/sets/one"


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> str:
    """URL of an empty store in this process's memory."""
    return keep_in_memory(monkeypatch)


def keep_in_memory(monkeypatch: pytest.MonkeyPatch) -> str:
    """A new bucket; all prefixes below it are stores in memory, each by itself."""
    bucket, stores, real = f"s3://memory-{uuid4().hex[:12]}", {}, store.connect
    kind = pytest.importorskip("obstore.store").MemoryStore
    monkeypatch.setattr(store, "connect", lambda url: stores.setdefault(url, kind()) if url.startswith(bucket) else real(url))
    return bucket


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a local bake of `tiny`."""
    folder, _ = once(tmp_path_factory, "cloud-local", lambda out: scripted_bake.bake(out, tiny()))
    return files(folder)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stored(url: str) -> dict[str, bytes]:
    """Files of the data set in a store."""
    store = open_store(url)
    return {key: store.get(key, 1 << 30) for key, _ in store.list("") if not key.startswith(f"{CONTROL}/")}
