"""Parallel ahead-of-time compilation of Warp modules: a dry run lists the modules that launches need, and a thread pool compiles them.

Warp compiles each module when one of its kernels is first launched, one after the other. Listing them first gives their number, for
progress, and lets compilers run in parallel; Warp generates their source code under a lock.

Cache folders: compiled kernels (WARP_CACHE_PATH) and collision shapes (XDG_CACHE_HOME) lie in the user's cache directory (XDG base
directory specification) unless a variable moves them. A home that is missing, a file, read-only or full is common in containers and batch
systems, and no reason to fail.
"""

import atexit
import contextlib
import fcntl
import inspect
import os
import shutil
import sys
import tempfile
import threading
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import warp as wp
from warp._src import codegen, context

from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.inputs.files import make_folder

KERNEL_VARIABLE = "WARP_CACHE_PATH"
"""Moves the cache of compiled kernels."""
USER_VARIABLE = "XDG_CACHE_HOME"
"""Moves all caches of a user, as far as no other variable does."""
MIN_FREE = 2**27
"""Free space below which a cache counts as full [bytes]; all kernels of a bake take some 50 MB."""
_PROBE = b"\0" * 4096


class CacheError(SynpickError):
    """Neither the cache nor the temporary folder can be written."""


def user_cache() -> Path | None:
    """The user's cache directory; None: the user has no home."""
    base = os.environ.get(USER_VARIABLE, "")
    if os.path.isabs(base):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return None


def kernel_cache(version: str) -> Path | None:
    """Folder of the kernels that a version of Warp compiles, as Warp chooses it itself."""
    base = os.environ.get(KERNEL_VARIABLE)
    if base is not None:
        return Path(os.path.realpath(base), version)
    user = user_cache()
    return None if user is None else user / "warp" / version


def usable_kernel_cache(version: str) -> Path | None:
    """Check the kernel cache; make a temporary one, with a note on the standard error, if it cannot be written.

    Kernels that the unusable cache has are linked into the temporary one, which is removed when the process ends.
    Returns the temporary folder; None: Warp's own choice can be written. Raises CacheError: there is no room for a temporary folder either.
    """
    cache = kernel_cache(version)
    reason = "the user has no home" if cache is None else find_fault(cache)
    if reason is None:
        return None
    try:
        folder = Path(tempfile.mkdtemp(prefix="synpick-warp-kernels-"))
    except OSError as fault:
        raise CacheError(
            f"the kernel cache cannot be used ({cache or '~/.cache'}: {reason}), nor can a temporary folder ({fault.strerror}); "
            f"set {KERNEL_VARIABLE} to a folder that can be written"
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if cache is not None:
        link_files(cache, folder / version)
    print(
        f"synpick-warp: note: the kernel cache {cache or '~/.cache/warp'} cannot be used ({reason}); kernels are compiled into {folder}, "
        f"for this run only; set {KERNEL_VARIABLE} to a folder that can be written",
        file=sys.stderr,
    )
    return folder


def find_fault(folder: Path) -> str | None:
    """Why a folder, created if missing, cannot serve as a cache: not writable, or less than MIN_FREE is free. None: it can."""
    try:
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(_PROBE)
            probe.flush()
        space = os.statvfs(folder)
    except (OSError, ValueError) as fault:  # ValueError: a null byte in a variable.
        return getattr(fault, "strerror", None) or str(fault)
    free = space.f_bavail * space.f_frsize
    return f"only {free // 2**20} MiB are free" if space.f_blocks and free < MIN_FREE else None


def link_files(source: Path, target: Path) -> None:
    """Mirror a folder: folders are made, files are symbolic links. Stops silently where something cannot be read or written."""
    with contextlib.suppress(OSError):
        for parent, _, names in os.walk(source):
            folder = target / Path(parent).relative_to(source)
            make_folder(folder)
            for name in names:
                (folder / name).symlink_to(Path(parent, name))


MAX_COMPILERS = 16
"""Maximum number of compiling threads: the longest module of a bake takes as long as 16 threads need for all others."""
REPORT_INTERVAL = 5.0
"""Maximum time between two reports while a module is compiled [s]."""
_LOCK_FILE = ".synpick-warp.lock"
"""Lock file in Warp's kernel cache; see `compilation_lock`."""
BINARIES = ("*.cubin", "*.ptx", "*.o")
"""Compiled modules in Warp's kernel cache."""


def list_binaries() -> set[tuple[Path, int]]:
    """Paths and modification times [ns] of all compiled modules in the kernel cache."""
    found = (path for pattern in BINARIES for path in Path(wp.config.kernel_cache_dir or "").glob(f"*/{pattern}"))
    return {(path, path.stat().st_mtime_ns) for path in found if path.exists()}


class ModuleBuild(NamedTuple):
    """Build of a Warp module for one device and one block size."""

    module: wp.Module
    device: str
    block: int

    def names(self, architecture: int | None = None) -> tuple[str, str]:
        """File names of its binary and of its metadata, which Warp writes last. `architecture`: compute capability times ten of the GPUs to
        build for; None: its own device."""
        device = wp.get_device(self.device) if architecture is None else None
        binary = self.module._get_compile_output_name(device, architecture, block_dim=self.block)
        return binary, self.module._get_meta_name(block_dim=self.block)

    def is_cached(self) -> bool:
        """Whether the kernel cache has it."""
        return all((self._folder / name).exists() for name in self.names())

    def shipped_key(self) -> str:
        """Key of the module in the archive of precompiled modules: versions of Warp and of CUDA's compiler, and the hash of its sources and
        options. A module compiled from anything else has another key."""
        compiler = ".".join(map(str, context.runtime.toolkit_version or ()))
        return f"warp-{wp.config.version}-cuda-{compiler}/{self.module.get_module_hash(self.block).hex()}"

    def take_shipped(self, archive: Path) -> None:
        """Copy its files from an archive (zip) into the kernel cache, if it has them and the cache lacks them."""
        if self.is_cached():
            return
        absent = (OSError, KeyError, zipfile.BadZipFile, RuntimeError)  # RuntimeError: Python was built without LZMA.
        with contextlib.suppress(*absent), zipfile.ZipFile(archive) as shipped:
            files = {name: shipped.read(f"{self.shipped_key()}/{name}") for name in self.names()}
            make_folder(self._folder)
            for name, content in files.items():
                part = self._folder / f"{name}.{os.getpid()}"
                part.write_bytes(content)
                part.replace(self._folder / name)

    @property
    def _folder(self) -> Path:
        """Its folder in the kernel cache."""
        return Path(wp.config.kernel_cache_dir or "", self.module.get_module_identifier(self.block))


@contextlib.contextmanager
def compilation_lock(wait: Callable[[], None]) -> Iterator[None]:
    """Lock of Warp's kernel cache (flock): of several processes that start with a cold cache one compiles, and the others get its kernels.
    File systems without locks are used unlocked. `wait`: called before waiting for another process."""
    try:
        handle = os.open(Path(wp.config.kernel_cache_dir or "", _LOCK_FILE), os.O_CREAT | os.O_RDONLY | os.O_CLOEXEC, 0o666)
    except OSError:
        yield
        return
    try:
        if not _lock(handle, fcntl.LOCK_NB):
            wait()
            _lock(handle)
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # Closing alone would leave it to children that were forked meanwhile.
        os.close(handle)


def _lock(handle: int, flags: int = 0) -> bool:
    """Take a lock on a file; False: another process has it, and `flags` says not to wait."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | flags)
    except BlockingIOError:
        return False
    except OSError:
        pass  # A file system without locks.
    return True


def build_of(kernel: Any, device: wp.Device, block: int | None = None) -> ModuleBuild:
    """Identify the build that a launch of a kernel loads; `block`: its block size on a GPU, None: the default one."""
    return ModuleBuild(kernel.module, device.alias, (block or kernel.module.options["block_dim"]) if device.is_cuda else 1)


def split_modules(prefixes: tuple[str, ...]) -> None:
    """Give each kernel of a library's Warp modules a module of its own, without adjoints.

    A module is compiled as a whole when one of its kernels is launched, and again when a generic kernel gets a further overload: of the 130
    kernels of Newton's solver, in 50,000 lines of CUDA, a bake launches some twenty, with two block sizes. Modules of one kernel leave out
    what is not launched, and are compiled in parallel. Kernels that the library creates later stay in the modules that it names.
    `prefixes`: what the names of the modules begin with.
    """
    for name, module in list(context.user_modules.items()):
        if not name.startswith(prefixes):
            continue
        module.options["enable_backward"] = False
        for kernel in module._get_live_kernels() if len(module._get_live_kernels()) > 1 else ():
            own = wp.get_module(f"{name}.{kernel.key}")
            own.options = dict(module.options)
            module.kernels.pop(kernel.key, None)
            module._live_kernels.discard(kernel)
            kernel.module = own
            own.register_kernel(kernel)
        module.mark_modified()


def make_build(module: wp.Module, device: Any, block: int | None) -> ModuleBuild:
    """Identify the build that `wp.Module.load` with these arguments loads."""
    return ModuleBuild(module, wp.get_device(device).alias, module.options["block_dim"] if block is None else block)


def _find_references(module: wp.Module, adjoint: Any, find: Callable[..., None] = wp.Module._find_references) -> None:
    """Find the modules that a function uses, which Warp unloads with a module that is imported anew. No program imports Newton's or ours
    anew, and for their 2,900 functions the search takes a fifth of the CPU time of their imports."""
    if not module.name.startswith(("newton.", f"{__name__.partition('.')[0]}.")):
        find(module, adjoint)


_SOURCE = ("source", "source_lines", "fun_lineno", "fun_name", "tree", "_shared_source")
"""Attributes of `warp.codegen.Adjoint`, which represents a function, that depend on its parsed source code."""


def _make_adjoint(adjoint: Any, func: Any, *given: Any, make: Callable[..., None] = codegen.Adjoint.__init__, **options: Any) -> None:
    """Initialize an adjoint; functions of Newton are parsed lazily, when their module is hashed or compiled (`_read_source`).

    A bake uses a fifth of Newton's 1,500 functions; parsing all of them takes 3 of 10 s of CPU time of its imports. Functions with
    `wp.static` expressions are parsed at once, as these are evaluated at definition."""
    lazy = (func.__module__ or "").startswith("newton.") and "static" not in inspect.unwrap(func).__code__.co_names
    lazy = lazy and not (options.get("source") or options.get("transformers"))
    make(adjoint, func, *given, **options | ({"source": "def stub(): ..."} if lazy else {}))
    for name in _SOURCE if lazy else ():
        delattr(adjoint, name)


def _read_source(adjoint: Any, name: str) -> Any:
    """Parse the source code of an adjoint from `_make_adjoint` at the first access (`__getattr__`); adjoints of the same code share it."""
    if name not in _SOURCE:
        raise AttributeError(f"an adjoint has no {name}")
    code = inspect.unwrap(adjoint.func).__code__
    shared = codegen._shared_source_for_code(code) or codegen._SharedFunctionSource(*adjoint.extract_function_source(adjoint.func))
    codegen._store_shared_source(code, shared)
    source, tree = shared.source, shared.tree
    vars(adjoint).update(zip(_SOURCE, (source, source.splitlines(), shared.fun_lineno, tree.body[0].name, tree, shared), strict=True))
    return vars(adjoint)[name]


wp.Module._find_references = _find_references  # type: ignore[method-assign]
codegen.Adjoint.__init__, codegen.Adjoint.__getattr__ = _make_adjoint, _read_source  # type: ignore[method-assign]


@contextlib.contextmanager
def dry_launches() -> Iterator[dict[ModuleBuild, None]]:
    """Dry run of kernel launches, by replacing `wp.Module.load`: in all threads kernels neither load nor run; copies and fills do run. The
    value has the modules that the launches need, in the order of their first launch."""
    load, builds = wp.Module.load, dict[ModuleBuild, None]()

    def record(module: wp.Module, device: Any, block_dim: int | None = None, *_: object, **__: object) -> None:
        builds[make_build(module, device, block_dim)] = None

    wp.Module.load = record  # type: ignore[method-assign]
    try:
        yield builds
    finally:
        wp.Module.load = load  # type: ignore[method-assign]


class Compiler:
    """Thread pool that compiles and loads Warp modules ahead of their launches.

    While it is entered, a launch whose module is being compiled waits for it, and modules that launches compile themselves are counted as
    well. Leaving it waits for all modules, and then compiles the last one. Reports come from the thread that entered it.

    Attributes:
        compiled: Number of modules that were compiled.
    """

    def __init__(self, report: Callable[[int, int], None], last: ModuleBuild | None = None) -> None:
        """Start no thread yet. `report`: progress callback (ready, total): whenever a module begins or is ready, and every
        `REPORT_INTERVAL` meanwhile; not called if the kernel cache has all. `last`: a module that is compiled after all others, so that the
        kernel cache has all if it has this one."""
        self.compiled = 0
        self._last = last
        self._report = report
        self._tasks: dict[ModuleBuild, Future[Any]] = {}
        self._seen: set[ModuleBuild] = set()
        self._owner = threading.current_thread()
        self._load = wp.Module.load
        self._pool = ThreadPoolExecutor(min(count_cores(), MAX_COMPILERS), thread_name_prefix="compile")
        # Modules that launches wait for do not queue behind the others.
        self._urgent = ThreadPoolExecutor(1, thread_name_prefix="compile-urgent")

    def __enter__(self) -> Self:
        compiler, self._load = self, wp.Module.load

        def load(module: wp.Module, device: Any, block_dim: int | None = None, *others: Any, **options: Any) -> Any:
            if threading.current_thread() is compiler._owner:
                compiler._await(make_build(module, device, block_dim))
            return compiler._load(module, device, block_dim, *others, **options)

        wp.Module.load = load  # type: ignore[method-assign]
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if error is None:
                self._wait(self._tasks.values())
                if self._last is not None:
                    self._last.module.load(self._last.device, self._last.block)
                self._say()
        finally:
            wp.Module.load = self._load  # type: ignore[method-assign]
            self._pool.shutdown(cancel_futures=True)
            self._urgent.shutdown(cancel_futures=True)

    def submit(self, builds: Iterable[ModuleBuild]) -> None:
        """Start to compile those modules that the kernel cache lacks, in this order."""
        # All are looked up before the first is compiled: names of modules are hashes of kernels, and compiling threads change these.
        missing = [build for build in builds if build not in self._tasks and build != self._last and not build.is_cached()]
        for build in missing:
            self._tasks[build] = self._pool.submit(self._compile, build)
        self._say()

    def _compile(self, build: ModuleBuild) -> None:
        """Compile and load a module, in a thread of the pool."""
        try:
            self._load(build.module, build.device, build.block)
        except KeyError:
            # Another thread has registered an overload of a kernel, so Warp has dropped the hashes of the module; the binary is cached.
            self._load(build.module, build.device, build.block)

    def _await(self, build: ModuleBuild) -> None:
        """Wait until the module of a launch is compiled; start that, ahead of the queue, if nothing has asked for it yet."""
        if build not in self._tasks and build not in self._seen:
            self._seen.add(build)
            if not build.is_cached():
                self._say(1)
                self._tasks[build] = self._urgent.submit(self._compile, build)
        if task := self._tasks.get(build):
            self._wait([task])

    def _wait(self, tasks: Collection[Future[Any]]) -> None:
        """Wait for compile tasks, and report their progress."""
        pending = {task for task in tasks if not task.done()}
        while pending:
            _, pending = wait(pending, REPORT_INTERVAL, FIRST_COMPLETED)
            self._say()
        for task in tasks:
            task.result()

    def _say(self, begun: int = 0) -> None:
        """Report progress; `begun` modules are about to be compiled."""
        self.compiled = sum(task.done() for task in self._tasks.values())
        if total := begun + len(self._tasks):
            self._report(self.compiled, total)
