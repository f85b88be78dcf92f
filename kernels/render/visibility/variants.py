"""Permutations of kernels over views: without code for lenses, as all are for pinhole cameras, and with it, where a camera is distorted.

A branch that is never taken still costs registers, and changes which products the compiler fuses with sums: the last bits of a picture.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

from synpick_warp.kernels.render.visibility.camera import LensViews, Views

_templates: dict[wp.Kernel, wp.Kernel] = {}
"""Generic kernel of each kernel for pinhole cameras."""
_lens_kernels: dict[wp.Kernel, wp.Kernel] = {}
"""Kernel for distorted cameras of each kernel for pinhole cameras; filled by module."""


def kernel_of_views(function: Callable[..., None] | None = None, **options: Any) -> Any:
    """Decorate a kernel with a parameter of type `AnyViews`, as `wp.kernel` does; the result is the kernel for pinhole cameras."""
    if function is None:
        return lambda decorated: kernel_of_views(decorated, **options)
    template = wp.kernel(function, **options)
    kernel = wp.overload(template, {_views_of(template): Views})
    _templates[kernel] = template
    return kernel


def kernel_for(kernel: wp.Kernel, *arguments: Any) -> wp.Kernel:
    """Kernel to launch with these arguments: its variant if the struct `LensViews` is among them."""
    if kernel not in _templates or not any(isinstance(argument, LensViews.cls) for argument in arguments):
        return kernel
    if kernel not in _lens_kernels:
        # All of the module at once: a further kernel compiles its module again.
        for pinhole, template in _templates.items():
            if pinhole.module is kernel.module:
                _lens_kernels[pinhole] = wp.overload(template, {_views_of(template): LensViews})
    return _lens_kernels[kernel]


def _views_of(template: wp.Kernel) -> str:
    """Name of the parameter of type `AnyViews`."""
    return next(name for name in ("views", "views_inout") if name in template.arg_indices)
