"""Kernel permutations: the default's kernels have no code for lens distortion and randomized materials; cells that use these get theirs.

A branch that is never taken still costs registers, and changes which products the compiler fuses with sums: the last bits of a picture.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

VARIANTS: dict[str, tuple[Any, ...]] = {}
"""Structs that a generic kernel parameter (annotated `Any`) accepts, by parameter name, the default first. Modules register theirs."""
_parameters: dict[wp.Kernel, dict[str, tuple[Any, ...]]] = {}
"""Generic parameters of each kernel template, with the structs they accept."""
_templates: dict[wp.Kernel, wp.Kernel] = {}
"""Template of each default kernel."""
_kernels: dict[tuple[wp.Kernel, frozenset[Any]], wp.Kernel] = {}
"""Permutations of each default kernel, by the set of structs that are not the default; filled by module."""


def variant_of(struct: Any, name: str, **members: Any) -> Any:
    """Define a struct type with the members of another, some of which are replaced or added by `members`."""
    body = {"__annotations__": struct.cls.__annotations__ | members, "__module__": struct.cls.__module__, "__doc__": f"As `{struct.key}`."}
    return wp.struct(type(name, (), body))


def kernel_of_views(function: Callable[..., None] | None = None, *, name: str = "", drawn: bool = False, **options: Any) -> Any:
    """Decorate a generic kernel whose parameters annotated `Any` are listed in `VARIANTS`, as `wp.kernel` does; returns its default
    permutation. `name`: kernel name of a closure. `drawn`: the kernel is never launched with the default scene, whose struct is skipped."""
    if function is None:
        return lambda decorated: kernel_of_views(decorated, name=name, drawn=drawn, **options)
    function.__qualname__ = name or function.__qualname__
    template: Any = wp.kernel(function, **options)
    generic = [name for name, given in template.func.__annotations__.items() if given is Any]
    _parameters[template] = {name: VARIANTS[name][drawn and name == "scene" :] for name in generic}
    kernel = wp.overload(template, {name: plain for name, (plain, *_) in _parameters[template].items()})
    _templates[kernel] = template
    return kernel


def kernel_for(kernel: wp.Kernel, *arguments: Any) -> wp.Kernel:
    """Select the permutation of a kernel for its arguments, by the types of the structs among them."""
    if kernel not in _templates:
        return kernel
    structs = {special for _, *specials in _parameters[_templates[kernel]].values() for special in specials}
    given = frozenset(special for special in structs if any(isinstance(argument, special.cls) for argument in arguments))
    if not given:
        return kernel
    if (kernel, given) not in _kernels:
        # All of the module at once: a further kernel compiles its module again.
        for plain, template in _templates.items():
            variable = _parameters[template]
            if plain.module is kernel.module and given <= {special for _, *specials in variable.values() for special in specials}:
                types = {name: next((each for each in specials if each in given), one) for name, (one, *specials) in variable.items()}
                _kernels[plain, given] = wp.overload(template, types)
    return _kernels[kernel, given]
