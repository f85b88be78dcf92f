"""Object store: whole objects by key, listed in order, written always, if absent, or if unchanged (compare-and-swap by ETag, Google's by
generation). Objects are neither renamed nor appended to. Keys are relative to the data set's prefix, with "/" between their parts.

By obstore, the Python binding of the Rust crate object_store. Stores are opened by URL, and probed: rights, difference of the clocks,
conditional writes.
"""

import contextlib
import datetime
import functools
import importlib
import os
import random
import re
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import urlsplit

from synpick_warp.errors import StoreError, shorten
from synpick_warp.system import clock
from synpick_warp.system.inputs.files import describe_bytes
from synpick_warp.system.inputs.urls import store_url

TRIES = 6
"""Attempts of a request that may succeed when it is repeated."""
FIRST_PAUSE, MAX_PAUSE = 0.2, 20.0
"""Exponential back-off: pause before the second attempt, doubled for each further one, and its limit [s]. Jitter: each pause is drawn from
50 to 100 % of that, so that workers whose requests failed together do not repeat them together."""
BLOCK_BYTES = 8 << 20
"""Size of the blocks in which large objects are read [B]."""
PART_BYTES, PARTS_AT_ONCE = 16 << 20, 4
"""Size of the parts in which larger files are uploaded [B], each a request that counts and costs, and parts of a file at a time."""
PAGE = 1000
"""Keys of a page of a listing: as many as S3 answers with."""
SMALL = 1 << 20
"""Largest control object, such as a lease or a list of ranges [B]."""
_SET_CREDENTIALS = "the store does not accept the credentials; set them, such as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
_ADVICE = (
    (
        re.compile("NoSuchBucket|bucket does not exist|NoSuchContainer|ContainerNotFound"),
        "there is no such bucket; make it first, or correct its name",
    ),
    (
        re.compile("RequestTimeTooSkewed"),
        "the clock of this machine differs from the store's by more than the store allows; set it (NTP)",
    ),
    (
        re.compile("InvalidAccessKeyId|SignatureDoesNotMatch|InvalidToken|ExpiredToken|status code: 401|Unauthenticated"),
        _SET_CREDENTIALS,
    ),
    (
        re.compile("AccessDenied|status code: 403|PermissionDenied|Permission denied"),
        "the credentials may not do that; give them the right to read, list and write there, or set those that have it",
    ),
    (re.compile("credentials|169\\.254\\.169\\.254"), _SET_CREDENTIALS),
)
"""Patterns in error messages, and the advice for each; the first match counts. Responses to HEAD requests contain only a status code."""
_PASSING = re.compile("status code: (?:5|429)|slowdown|timed out|timeout|connection|error sending request|incompletebody|error decoding")
"""Signs of transient errors in their text, in lower case. They go before advice, whose signs may be in a key or an answer."""
_LASTING = ("status code: 401", "status code: 403", "status code: 404", "status code: 501", "169.254.169.254")
"""Signs that an error is not transient, whatever else its text has; the last is the metadata service, which only some machines have."""
_SECRETS = re.compile(r"(?:AWS|AZURE|GOOGLE)_.*(?:KEY|SECRET|TOKEN|SAS|PASSWORD|CREDENTIAL).*")
"""Variables whose values no message shows."""
_SHORT = 4
"""Length of a variable's value from which on it is a secret [characters]."""
_IN_URL = re.compile(r"(?<=//)[^/\s]*@|\?[^\s)\"]*")
"""Parts of the URLs in an error's text that may be secrets: user and password, and the query, which may be signed."""

_Result = TypeVar("_Result")


class Stat(NamedTuple):
    """Metadata of an object: its size, and when the store received it, by the store's clock."""

    size: int
    """Size [B]."""
    modified: datetime.datetime


class TransientError(Exception):
    """Transient failure of a request, which `persist` repeats: the answer was 5xx, late or lost, or the object arrived incomplete."""


def persist(request: Callable[[], _Result], what: str, tries: int = TRIES) -> _Result:
    """Retry a request, which must be safe to repeat, while it raises `TransientError`, with exponential back-off and jitter; returns its
    result. `what` it does is for the message: "write s3://bucket/key". Raises StoreError: no attempt succeeded."""
    pause = FIRST_PAUSE
    for attempt in range(1, tries + 1):
        try:
            return request()
        except TransientError as error:
            if attempt == tries:
                raise StoreError(f"cannot {what}: {error}; {tries} attempts failed; the same command resumes") from error
        clock.sleep(pause * random.uniform(0.5, 1.0))
        pause = min(2.0 * pause, MAX_PAUSE)
    raise AssertionError("unreachable")


class SizeError(StoreError):
    """An object is larger than any of its kind."""


class Store:
    """Object store below a prefix. Thread-safe. Each method repeats requests that fail for a while, then raises StoreError."""

    def __init__(self, url: str, backend: Any) -> None:
        """Address of the prefix, without a slash at the end, and obstore's store there."""
        self.url, self._store = url, backend
        self._obs = importlib.import_module("obstore")
        self._errors = self._obs.exceptions

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
                text, small = str(error), str(error).lower()
                if _PASSING.search(small) and not any(sign in text for sign in _LASTING):
                    raise TransientError(describe_fault(error)) from None
                advice = next((said for signs, said in _ADVICE if signs.search(text)), "")
                if advice:
                    raise StoreError(f"cannot {what}: {advice}") from None
                if isinstance(error, FileNotFoundError):
                    raise FileNotFoundError(describe_fault(error)) from None
                raise StoreError(f"cannot {what}: {describe_fault(error)}") from None
            except BaseException as error:
                raise_panic(error, f"cannot {what}")
                raise

        return persist(attempt, what)

    def put(self, key: str, data: bytes) -> None:
        """Write an object atomically: readers see the old or the new one, whole."""
        self._write(key, lambda: self._obs.put(self._store, key, data, use_multipart=False))

    def put_file(self, key: str, path: Path) -> None:
        """Upload a file as an object, in several parts if it is large."""
        self._write(key, lambda: self._obs.put(self._store, key, path, chunk_size=PART_BYTES, max_concurrency=PARTS_AT_ONCE))

    def _write(self, key: str, request: Callable[[], object]) -> None:
        """Retry a request that writes an object; what it does not find is a StoreError."""
        try:
            self._try(request, f"write {self.url}/{key}")
        except FileNotFoundError as error:
            raise StoreError(f"cannot write {self.url}/{key}: {error}") from None

    def get(self, key: str, limit: int) -> bytes:
        """Read an object of at most `limit` bytes; raises FileNotFoundError, and SizeError if it is larger."""
        return self._get(key, limit)[0]

    def _get(self, key: str, limit: int) -> tuple[bytes, Any]:
        """Content and metadata of an object; as `get`."""

        def read() -> tuple[bytes, Any]:
            found = self._obs.get(self._store, key)
            self._check_size(key, found.meta, limit)
            return bytes(found.bytes()), found.meta

        return self._try(read, f"read {self.url}/{key}")

    def _check_size(self, key: str, meta: Any, limit: int) -> None:
        """Raise SizeError if an object is larger than `limit` bytes, by its metadata."""
        if meta["size"] > limit:
            raise SizeError(f"{self.url}/{key} is larger than {describe_bytes(limit)}, the limit for such files")

    def blocks(self, key: str, limit: int) -> Iterator[bytes]:
        """Stream an object of at most `limit` bytes in blocks of at most BLOCK_BYTES, one range request each.

        Raises FileNotFoundError, SizeError if it is larger, and StoreError if it is replaced meanwhile."""
        what = f"read {self.url}/{key}"
        meta = self._try(lambda: self._obs.head(self._store, key), what)
        self._check_size(key, meta, limit)

        def read(start: int) -> bytes:
            found = self._obs.get(self._store, key, options={"range": (start, min(start + BLOCK_BYTES, meta["size"]))})
            if found.meta["e_tag"] != meta["e_tag"]:
                raise StoreError(f"{self.url}/{key} was replaced while it was read; read it again")
            return bytes(found.bytes())

        for start in range(0, meta["size"], BLOCK_BYTES):
            yield self._try(lambda first=start: read(first), what)

    def stat(self, key: str) -> Stat | None:
        """Look up the metadata of an object; None: there is no such object."""
        try:
            found = self._try(lambda: self._obs.head(self._store, key), f"look up {self.url}/{key}")
        except FileNotFoundError:
            return None
        return Stat(found["size"], found["last_modified"])

    def list(self, folder: str, after: str = "") -> Iterator[tuple[str, int]]:
        """List the objects below a folder, which is the first parts of their keys (empty: all), sorted by key, page by page: yields key and
        size [B]. `after`: only keys that sort after this one."""
        last = after

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
        """Delete an object, if it is there."""
        try:
            self._try(lambda: self._obs.delete(self._store, key), f"delete {self.url}/{key}")
        except FileNotFoundError:
            return

    def create(self, key: str, data: bytes) -> str | None:
        """Write an object if absent; returns its tag. None: the key is taken, perhaps by an attempt of this call whose answer was lost."""
        return self._put_if(key, data, "create")

    def replace(self, key: str, data: bytes, tag: str) -> str | None:
        """Compare-and-swap: write an object if the one that is there has this tag; returns the new tag. None: it has another tag, perhaps
        that of an attempt of this call whose answer was lost, or was deleted."""
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
        """Read a control object and its tag, which identifies its version; None: there is no such object."""
        try:
            data, meta = self._get(key, SMALL)
        except FileNotFoundError:
            return None
        return data, _tag(meta)


@functools.cache
def _process() -> int:
    """Id of the process that sent the first request and so started obstore's threads; forked processes lack them and would hang."""
    return os.getpid()


def _tag(state: Any) -> str:
    """Tag of an object: its generation, which Google compares, a space, and its ETag, which the others compare."""
    return f"{state['version'] or ''} {state['e_tag']}"


def describe_fault(error: BaseException) -> str:
    """First line of an error's text, as others describe internals, without secrets: keys, tokens, users, queries of URLs."""
    text = (str(error).splitlines() or [type(error).__name__])[0]
    for name, value in os.environ.items():
        if len(value) >= _SHORT and _SECRETS.fullmatch(name):
            text = text.replace(value, "…")
    return _IN_URL.sub("…", text)[:300]


def raise_panic(error: BaseException, what: str) -> None:
    """Raise StoreError if an error is a panic of Rust code, whose class is no Exception and has no module to import it from."""
    if type(error).__name__ == "PanicException":
        raise StoreError(f"{what}: obstore failed ({describe_fault(error)}); check the variables of the store's credentials") from None


CONTROL = ".store"
"""Folder of control objects, which are no part of a data set: marks, claims, probes. Hidden, so that local commands ignore it in a copy."""
MAX_SKEW = 300.0
"""Largest difference of this machine's clock from the store's [s]: stores refuse signed requests beyond 5 to 15 minutes."""
TIMEOUT = 60
"""Timeout of a request [s]."""
_ENDPOINTS = {
    "s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"),
    "az": ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"),
    "gs": ("GOOGLE_BASE_URL",),
}
"""Variables of other servers than the cloud's own by scheme, the first before the next."""
_ENDPOINT = re.compile(r"https?://(?:\[[0-9a-f:.]+\]|[a-z0-9](?:[a-z0-9._-]*[a-z0-9])?)(?::[0-9]+)?(?:/[a-z0-9/._~-]*)?", re.IGNORECASE)
_HEADERS = re.compile(
    r"AWS_(?:ACCESS_KEY_ID|SECRET_ACCESS_KEY|SESSION_TOKEN|TOKEN|(?:DEFAULT_)?REGION)|AZURE_STORAGE_(?:ACCOUNT_)?(?:NAME|KEY)"
)
"""Variables that become parts of requests, in which obstore panics about what is not printable ASCII."""
_ACCOUNTS = ("AZURE_STORAGE_ACCOUNT_NAME", "AZURE_STORAGE_ACCOUNT")
_CREDENTIALS = (
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
)
"""Variables of which one gives credentials of S3."""


class Probe(NamedTuple):
    """Result of a probe: offset of the clock, and whether conditional writes work."""

    offset: float
    """The store's clock less this machine's [s]."""
    conditional: bool
    """Whether the store has conditional writes and honours them."""


def open_store(url: str) -> Store:
    """Open the object store of a URL; it is sent no request. Raises StoreError: obstore or credentials are missing, a variable is
    malformed, or the URL is not that of a prefix."""
    found = store_url(url)
    if found is None:
        raise StoreError(f"{shorten(url)} is a folder of this machine; name a prefix in an object store, such as s3://bucket/prefix")
    return Store(found, connect(found))


def connect(url: str) -> Any:
    """Construct obstore's store of a URL as `parse_place` returns it. Raises as `open_store`."""
    try:
        kinds = importlib.import_module("obstore.store")
    except ImportError:
        raise StoreError(f"{url} needs the package obstore; install it by pip install 'synpick-warp[cloud]'") from None
    scheme, _, rest = url.partition("://")
    bucket, _, prefix = rest.partition("/")
    endpoint = _check_environment(scheme, url)
    options = {
        "prefix": prefix or None,
        "client_options": {"timeout": f"{TIMEOUT}s", "allow_http": endpoint.lower().startswith("http://")},
        "retry_config": {"max_retries": 3, "retry_timeout": datetime.timedelta(seconds=TIMEOUT)},
    }
    if scheme == "az":  # Which obstore does not read from the environment.
        options["account_name"] = next(filter(None, map(os.environ.get, _ACCOUNTS)), None)
    try:
        return {"s3": kinds.S3Store, "gs": kinds.GCSStore, "az": kinds.AzureStore}[scheme](bucket, **options)
    except Exception as error:  # Of obstore, ValueError, OSError.
        raise StoreError(f"{url} cannot be opened: {describe_fault(error)}") from None
    except BaseException as error:
        raise_panic(error, f"{url} cannot be opened")
        raise


def _check_environment(scheme: str, url: str) -> str:
    """Check the variables that obstore reads, of which malformed ones make it panic; returns the endpoint, empty: the cloud's own. Unsets
    variables that are empty. Raises StoreError: a variable is malformed, or there are no credentials."""
    for name, value in list(os.environ.items()):
        endpoint, header = name in _ENDPOINTS[scheme], _HEADERS.fullmatch(name) is not None
        if (endpoint or header) and not value:
            del os.environ[name]
        elif header and re.fullmatch("[!-~]+", value) is None:
            raise StoreError(f"{name} has a space, or what is not printable ASCII; set it anew")
        elif endpoint and not _is_endpoint(value):
            shown = "" if {"@", "?"}.intersection(value) else f" {shorten(value)}, which is"
            raise StoreError(
                f"{name} is{shown} no plain address; set it to the address of a server, such as http://127.0.0.1:9000, or unset it"
            )
    if scheme == "az" and not any(map(os.environ.get, _ACCOUNTS)):
        raise StoreError(f"there is no account for {url}; set {_ACCOUNTS[0]}, and AZURE_STORAGE_ACCOUNT_KEY or AZURE_STORAGE_SAS_KEY")
    disabled = os.environ.get("AWS_EC2_METADATA_DISABLED", "").lower() == "true"
    if scheme == "s3" and disabled and not any(map(os.environ.get, _CREDENTIALS)):
        raise StoreError(f"there are no credentials for {url}; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")
    return next(filter(None, map(os.environ.get, _ENDPOINTS[scheme])), "")


def _is_endpoint(address: str) -> bool:
    """Whether an address is an HTTP URL of a host, with a port or path or without, and nothing else."""
    try:
        return _ENDPOINT.fullmatch(address) is not None and urlsplit(address).port != 0
    except ValueError:  # A port beyond 65535, or brackets without an address of IPv6.
        return False


def probe(store: Store) -> Probe:
    """Probe a store's capabilities: write, look up, read and delete a small object below CONTROL. Raises StoreError: the store cannot be
    read and written, or this machine's clock is off by more than MAX_SKEW."""
    key, data = f"{CONTROL}/probe/{uuid.uuid4().hex}", b"probe"
    sent = datetime.datetime.now(datetime.UTC)
    store.put(key, data)
    state, found = store.stat(key), store.get_tagged(key)
    if state is None or found is None or found[0] != data:
        raise StoreError(f"{store.url} does not return what was written; name a store that reads what it has just acknowledged")
    offset = (state.modified - sent).total_seconds()
    if abs(offset) > MAX_SKEW:
        raise StoreError(f"the clock of this machine differs from that of {store.url} by {abs(offset):,.0f} s; set it (NTP)")
    conditional = _is_conditional(store, key, data)
    with contextlib.suppress(StoreError):  # The right to delete is not needed.
        store.delete(key)
    return Probe(offset, conditional)


def _is_conditional(store: Store, key: str, data: bytes) -> bool:
    """Test of conditional writes: whether the store refuses to create an object that exists and to replace one whose tag has changed, and
    replaces one whose tag has not."""
    try:
        if store.create(key, b"other") is not None:
            return False
        found = store.get_tagged(key)
        if found is None or found[0] != data:
            return False
        tag = store.replace(key, b"next", found[1])
        return tag is not None and store.replace(key, b"late", found[1]) is None and store.get(key, SMALL) == b"next"
    except (StoreError, FileNotFoundError):
        return False
