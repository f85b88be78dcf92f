"""Factory of object stores by URL, and a capability probe: rights, difference of the clocks, conditional writes."""

import contextlib
import datetime
import importlib
import os
import re
import uuid
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from synpick_warp.errors import StoreError, shorten
from synpick_warp.system.inputs.urls import store_url
from synpick_warp.system.stores.store import SMALL, Store, describe_fault, raise_panic

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
