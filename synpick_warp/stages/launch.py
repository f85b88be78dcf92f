"""Kernel launches: arguments by name; over pixels and views in blocks of whole tiles on the GPU, in several threads on the CPU."""

import functools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.kernels.tuning import CPU_PIECE_PIXELS, CPU_PIECES, PIXEL_BLOCK
from synpick_warp.stages.arrays import ArrayGroup, bundle
from synpick_warp.system.hardware.cores import PIXELS, count_cores

_limit = 0
"""Maximum number of threads that render pixels on the CPU, set by `limit_threads`; 0: one per usable core."""


def limit_threads(count: int) -> None:
    """Set the number of threads that render pixels on the CPU, for processes that share its cores. Results do not depend on it."""
    global _limit
    _limit = count
    _cores.cache_clear()
    _pool.cache_clear()


@functools.cache
def _cores() -> int:
    """Number of threads that render pixels on the CPU."""
    return _limit or count_cores()


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Thread pool that launches on the CPU, started at the first call."""
    return ThreadPoolExecutor(_cores(), thread_name_prefix=PIXELS)


# Threads do not survive a fork: a child process creates its own pool.
os.register_at_fork(after_in_child=_pool.cache_clear)


def launch(
    kernel: wp.Kernel, dim: int | tuple[int, ...], *sources: object, out: object = None, block_dim: int = 256, **given: object
) -> None:
    """Launch a kernel with arguments by the names of its parameters, without their suffixes `_out` and `_inout`.

    The argument of a struct parameter that no source has is the `ArrayGroup` of this struct, or a bundle of the sources' attributes.
    `dim`: number of threads. `sources`: objects with attributes of these names, such as groups of device arrays; each
    name is that of one of them. `out`: object with the parameters that end in `_out`; None: they are looked for like the others.
    `block_dim`: threads of a block on the GPU. `given`: arguments that no object has under the parameter's name, by this name, with or
    without suffix. Raises TypeError: no source has an argument, or several have it, or an argument is none of the kernel's."""
    arguments = _find_arguments(kernel, sources, out, given)
    device = next(array.device for array in _arrays(arguments))
    wp.launch(kernel_for(kernel, *arguments), dim=dim, inputs=arguments, device=device, block_dim=block_dim)


def launch_images(kernel: wp.Kernel, pixels: int, *sources: object, out: object = None, **given: object) -> None:
    """Launch a kernel as `launch_pixels` does, with arguments by the names of its parameters as of `launch`."""
    arguments = _find_arguments(kernel, sources, out, {"first": 0, **given})
    first = [name for name, *_ in _parameters(kernel)].index("first")
    launch_pixels(kernel, pixels, arguments[:first], arguments[first + 1 :], next(array.device for array in _arrays(arguments)))


def _find_arguments(kernel: wp.Kernel, sources: Sequence[object], out: object, given: dict[str, object]) -> list[Any]:
    """Arguments of a kernel, as of `launch`."""
    arguments = []
    for parameter, name, kind in _parameters(kernel):
        if given.keys() & {parameter, name}:
            arguments.append(given.pop(parameter if parameter in given else name))
            continue
        owners = [out] if out is not None and parameter.endswith("_out") else [source for source in sources if hasattr(source, name)]
        if hasattr(kind, "cls") and not any(hasattr(owner, name) for owner in owners):
            arguments.append(_find_bundle(kernel, kind, (*sources, out)))
            continue
        if len(owners) != 1:
            raise TypeError(f"{kernel.key}: {len(owners)} sources have {name}")
        arguments.append(getattr(owners[0], name))
    if given:
        raise TypeError(f"{kernel.key} has no parameter {', '.join(given)}")
    return arguments


def _find_bundle(kernel: wp.Kernel, struct: Any, sources: Sequence[object]) -> Any:
    """Struct of the group of arrays that is declared by it, or of attributes of the sources."""
    group = next((source for source in sources if isinstance(source, ArrayGroup) and source.struct is struct), None)
    if group is not None:
        return group.bundle
    try:
        return bundle(struct, *sources)
    except TypeError as error:
        raise TypeError(f"{kernel.key}: {error}") from None


def _arrays(arguments: Sequence[Any]) -> Iterator[wp.array]:
    """Yield the arrays of arguments: those of structs last."""
    yield from (argument for argument in arguments if isinstance(argument, wp.array))
    for argument in arguments:
        if hasattr(argument, "_cls"):
            yield from _arrays([getattr(argument, name) for name in argument._cls.vars])


@functools.cache
def _parameters(kernel: wp.Kernel) -> list[tuple[str, str, Any]]:
    """Parameters of a kernel, their names without suffix, and their types."""
    return [(name, name.removesuffix("_out").removesuffix("_inout"), kind) for name, kind in kernel.adj.arg_types.items()]


def launch_pixels(kernel: wp.Kernel, pixels: int, inputs: list[Any], outputs: list[Any], device: wp.Device) -> None:
    """Launch a kernel over a flat range of pixels; no two tiles may write the same element.

    The kernel's last input is the index of the first pixel. On the CPU, Warp runs a launch in the calling thread and releases the
    interpreter lock; so pieces of whole tiles run in parallel in a thread pool, which does not change the result. Kernels launched so must
    not use Warp's tile functions, whose CPU storage is found by one static pointer per module; its debug mode follows that pointer always.
    """
    size = pixels
    if device.is_cpu and _cores() > 1:
        tiles = -(-pixels // (CPU_PIECES * _cores() * int(TILE_PIXELS)))
        size = max(CPU_PIECE_PIXELS, tiles * int(TILE_PIXELS))
    _launch_pieces(kernel, range(0, pixels, size or 1), pixels, inputs, outputs, device)


def launch_views(
    kernel: wp.Kernel, views: int, threads: int, inputs: list[Any], outputs: list[Any], device: wp.Device, first_view: int = 0
) -> None:
    """Launch a kernel over `threads` threads for each of `views` views from `first_view` on.

    Threads of one view may write the same elements by atomic operations. The kernel's last input is the index of the first thread. On the
    CPU, where Warp's atomic operations are not atomic, the threads of a view run sequentially, and views in parallel.
    """
    first, end = first_view * threads, (first_view + views) * threads
    starts = range(first, end, (views * threads if device.is_cuda else threads) or 1)
    _launch_pieces(kernel, starts, end, inputs, outputs, device)


def _launch_pieces(kernel: wp.Kernel, starts: range, end: int, inputs: list[Any], outputs: list[Any], device: wp.Device) -> None:
    """Launch a kernel in consecutive ranges of threads that begin at `starts`, the last of which ends at `end`; by a thread pool if there
    are several."""
    kernel = kernel_for(kernel, *inputs)

    def launch_piece(first: int) -> None:
        dim = min(starts.step, end - first)
        wp.launch(kernel, dim=dim, inputs=[*inputs, first], outputs=outputs, device=device, block_dim=PIXEL_BLOCK)

    if len(starts) > 1:
        # Loading a module from several threads at once is not safe.
        kernel.module.load(device, 1)
        for _ in _pool().map(launch_piece, starts):
            pass
    elif starts:
        launch_piece(starts[0])
