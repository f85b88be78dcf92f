"""Object store by obstore, the Python binding of the Rust crate object_store: S3, Google Cloud Storage, Azure, a folder, or memory.

It has conditional writes: create if absent, and compare-and-swap by ETag (Google: by generation). Folders lack the latter.
"""

from __future__ import annotations

import datetime
import functools
import importlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from synpick_warp.errors import StoreError
from synpick_warp.system.stores.base import BLOCK_BYTES, Stat, TransientError, persist

TIMEOUT = 60
"""Timeout of a request [s]."""
PART_BYTES, PARTS_AT_ONCE = 16 << 20, 4
"""Size of the parts in which larger files are uploaded [B], each a request that counts and costs, and parts of a file at a time."""
PAGE = 1000
"""Keys of a page of a listing: as many as S3 answers with."""
_INSTALL = "install it by pip install 'synpick-warp[cloud]'"
_SET_CREDENTIALS = "the store does not accept the credentials; set them, such as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
_ADVICE = (
    (
        ("NoSuchBucket", "bucket does not exist", "NoSuchContainer", "ContainerNotFound"),
        "there is no such bucket; make it first, or correct its name",
    ),
    (("RequestTimeTooSkewed",), "the clock of this machine differs from the store's by more than the store allows; set it (NTP)"),
    (
        ("InvalidAccessKeyId", "SignatureDoesNotMatch", "InvalidToken", "ExpiredToken", "status code: 401", "Unauthenticated"),
        _SET_CREDENTIALS,
    ),
    (
        ("AccessDenied", "status code: 403", "PermissionDenied", "Permission denied"),
        "the credentials may not do that; give them the right to read, list and write there, or set those that have it",
    ),
    (("credentials", "169.254.169.254"), _SET_CREDENTIALS),
)
"""Substrings of error messages, and the advice for each; the first match counts. Responses to HEAD requests contain only a status code."""
_PASSING = (
    "status code: 5",
    "status code: 429",
    "SlowDown",
    "timed out",
    "timeout",
    "connection",
    "error sending request",
    "IncompleteBody",
    "error decoding",
)
"""Signs of transient errors in their text, in upper or lower case. They go before advice, whose signs may be in a key or an answer."""
_LASTING = ("status code: 401", "status code: 403", "status code: 404", "status code: 501", "169.254.169.254")
"""Signs that an error is not transient, whatever else its text has; the last is the metadata service, which only some machines have."""

_Result = TypeVar("_Result")
_memories: dict[str, Any] = {}
"""Stores in memory by name, shared within the process."""
_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
"""Variables of S3 servers other than Amazon's, the first before the next."""


class ObjectStore:
    """`Store` of obstore."""

    def __init__(self, url: str) -> None:
        """Open the store without a request. Raises StoreError: obstore is not installed or refuses the URL, or there are no credentials."""
        try:
            self._obs = importlib.import_module("obstore")
            self._kinds = importlib.import_module("obstore.store")
        except ImportError:
            raise StoreError(f"{url} needs the package obstore; {_INSTALL}") from None
        self.url, self.conditional = url.rstrip("/"), not url.startswith("file:")
        self._errors = self._obs.exceptions
        try:
            self._store = self._open(self.url)
        except (self._errors.BaseError, ValueError, OSError) as error:
            raise StoreError(f"{url} cannot be opened: {_first_line(error)}") from None

    def _open(self, url: str) -> Any:
        """Construct obstore's store of a URL."""
        scheme, _, rest = url.partition("://")
        if scheme == "memory":
            return _memories.setdefault(rest, self._kinds.MemoryStore())
        if scheme == "file":
            return self._kinds.LocalStore(rest, mkdir=True, automatic_cleanup=True)
        if scheme in ("s3", "s3a"):
            _check_credentials(url)
        endpoint = _find_endpoint() if scheme in ("s3", "s3a") else ""
        client = {"timeout": f"{TIMEOUT}s", "allow_http": endpoint.startswith("http://")}
        retries = {"max_retries": 3, "retry_timeout": datetime.timedelta(seconds=TIMEOUT)}
        return self._kinds.from_url(url, client_options=client, retry_config=retries)

    def _try(self, request: Callable[[], _Result], what: str) -> _Result:
        """Retry a request while its errors are transient; others become StoreError, but for failed conditions and missing objects."""

        if _process() != os.getpid():
            advice = "start workers by spawn or forkserver, such as by multiprocessing_context of a DataLoader"
            raise StoreError(f"cannot {what}: obstore has no threads in the fork of a process that used it; {advice}")

        def attempt() -> _Result:
            try:
                return request()
            except (self._errors.AlreadyExistsError, self._errors.PreconditionError):
                raise
            except (self._errors.BaseError, OSError, NotImplementedError) as error:
                text = str(error)
                if any(sign.lower() in text.lower() for sign in _PASSING) and not any(sign in text for sign in _LASTING):
                    raise TransientError(_first_line(error)) from None
                advice = next((said for signs, said in _ADVICE if any(sign in text for sign in signs)), "")
                if advice:
                    raise StoreError(f"cannot {what}: {advice}") from None
                if isinstance(error, FileNotFoundError):
                    raise
                raise StoreError(f"cannot {what}: {_first_line(error)}") from None

        return persist(attempt, what)

    def put(self, key: str, data: bytes) -> None:
        """See `Store`."""
        self._write(key, lambda: self._obs.put(self._store, key, data, use_multipart=False))

    def put_file(self, key: str, path: Path) -> None:
        """See `Store`."""
        self._write(key, lambda: self._obs.put(self._store, key, path, chunk_size=PART_BYTES, max_concurrency=PARTS_AT_ONCE))

    def _write(self, key: str, request: Callable[[], object]) -> None:
        """Retry a request that writes an object; what it does not find is a StoreError."""
        try:
            self._try(request, f"write {self.url}/{key}")
        except FileNotFoundError as error:
            raise StoreError(f"cannot write {self.url}/{key}: {_first_line(error)}") from None

    def get(self, key: str) -> bytes:
        """See `Store`."""
        return self._try(lambda: bytes(self._obs.get(self._store, key).bytes()), f"read {self.url}/{key}")

    def blocks(self, key: str) -> Iterator[bytes]:
        """See `Store`."""
        what = f"read {self.url}/{key}"
        meta = self._try(lambda: self._obs.head(self._store, key), what)

        def read(start: int) -> bytes:
            found = self._obs.get(self._store, key, options={"range": (start, min(start + BLOCK_BYTES, meta["size"]))})
            if found.meta["e_tag"] != meta["e_tag"]:
                raise StoreError(f"{self.url}/{key} was replaced while it was read; read it again")
            return bytes(found.bytes())

        for start in range(0, meta["size"], BLOCK_BYTES):
            yield self._try(lambda first=start: read(first), what)

    def stat(self, key: str) -> Stat | None:
        """See `Store`."""
        try:
            found = self._try(lambda: self._obs.head(self._store, key), f"look up {self.url}/{key}")
        except FileNotFoundError:
            return None
        return Stat(found["size"], found["last_modified"])

    def list(self, folder: str, after: str = "") -> Iterator[tuple[str, int]]:
        """See `Store`."""
        last = after
        if self.url.startswith("file:"):  # In the order of the file system, with the files that are being written.
            found = self._try(lambda: [each for chunk in self._obs.list(self._store, folder or None) for each in chunk], f"list {self.url}")
            yield from sorted((each["path"], each["size"]) for each in found if each["path"] > after and "#" not in each["path"])
            return

        def read(after: str) -> Any:
            """First page after a key. The stream is made for each attempt: one that has failed says that it is at its end."""
            return next(iter(self._obs.list(self._store, folder or None, offset=after or None, chunk_size=PAGE)), None)

        while True:
            page = self._try(lambda after=last: read(after), f"list {self.url}/{folder}") or []
            for each in page:
                yield each["path"], each["size"]
            if len(page) < PAGE:
                return
            last = page[-1]["path"]

    def delete(self, key: str) -> None:
        """See `Store`."""
        try:
            self._try(lambda: self._obs.delete(self._store, key), f"delete {self.url}/{key}")
        except FileNotFoundError:
            return

    def create(self, key: str, data: bytes) -> str | None:
        """See `Store`."""
        return self._put_if(key, data, "create")

    def replace(self, key: str, data: bytes, tag: str) -> str | None:
        """See `Store`."""
        version, _, e_tag = tag.partition(" ")
        return self._put_if(key, data, {"e_tag": e_tag} | ({"version": version} if version else {}))

    def _put_if(self, key: str, data: bytes, mode: Any) -> str | None:
        """Conditional write; returns the tag of the new object. None: the condition does not hold."""
        try:
            request = lambda: self._obs.put(self._store, key, data, mode=mode, use_multipart=False)  # noqa: E731
            return _tag(self._try(request, f"write {self.url}/{key}"))
        except (self._errors.AlreadyExistsError, self._errors.PreconditionError):
            return None
        except FileNotFoundError:  # Compared with an object that was deleted.
            return None

    def get_tagged(self, key: str) -> tuple[bytes, str] | None:
        """See `Store`."""
        try:
            found = self._try(lambda: self._obs.get(self._store, key), f"read {self.url}/{key}")
            return self._try(lambda: bytes(found.bytes()), f"read {self.url}/{key}"), _tag(found.meta)
        except FileNotFoundError:
            return None


@functools.cache
def _process() -> int:
    """Id of the process that sent the first request and so started obstore's threads; forked processes lack them and would hang."""
    return os.getpid()


def _find_endpoint() -> str:
    """Endpoint URL of S3 by the environment variables; empty: Amazon's. Unsets empty variables, which make obstore panic.

    Raises:
        StoreError: A variable is not an HTTP URL.
    """
    found = {name: os.environ[name] for name in _ENDPOINTS if name in os.environ}
    for name, address in found.items():
        if not address:
            del os.environ[name]
        elif re.match(r"https?://[^/]", address) is None:
            raise StoreError(f"{name} is {address}; set it to the address of a server, such as http://127.0.0.1:9000, or unset it")
    return next(filter(None, found.values()), "")


def _check_credentials(url: str) -> None:
    """Check for credentials of S3: raises StoreError if no variable gives them and the machine's metadata service is disabled."""
    given = (
        "AWS_ACCESS_KEY_ID",
        "AWS_WEB_IDENTITY_TOKEN_FILE",
        "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
        "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    )
    disabled = os.environ.get("AWS_EC2_METADATA_DISABLED", "").lower() == "true"
    if disabled and not any(os.environ.get(name) for name in given):
        raise StoreError(f"there are no credentials for {url}; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")


def _tag(state: Any) -> str:
    """Tag of an object: its generation, which Google compares, a space, and its ETag, which the others compare."""
    return f"{state['version'] or ''} {state['e_tag']}"


def _first_line(error: BaseException) -> str:
    """First line of an error's text; the others describe the library's internals."""
    return (str(error).splitlines() or [type(error).__name__])[0][:300]
