"""Probe kernels: device functions called from tests, one thread a row of arguments."""

import inspect
from typing import Any

import numpy as np
import warp as wp
from warp._src.codegen import Struct
from warp._src.types import is_array, type_to_warp

from tests.harness.environment import default_device

_probes: "dict[str, list[Probe]]" = {}
"""Probes by the folder that declares them. They share a Warp module: a folder of tests compiles once."""


class Probe:
    """Vectorised call of a Warp function, in a kernel that is generated when the first probe of its folder is called."""

    def __init__(self, func: wp.Function, owner: str) -> None:
        self.func, self.owner = func, owner
        self.kernel: wp.Kernel | None = None
        self.outputs: list[Any] = []
        self.inputs = {name: type_to_warp(kind) for name, kind in func.input_types.items()}
        _probes.setdefault(owner, []).append(self)

    def __call__(self, *arguments: Any, device: Any = None) -> Any:
        """Values of the function at rows of arguments, which broadcast as NumPy arrays. `arguments`: arrays, and structs that have some,
        which all rows share; all else by rows: NumPy arrays (..., components), structured for structs, or one value for all. `device`: the
        tests' default device if None. Returns array (..., components) of what the function returns, structured for a struct; several
        values: a list of arrays."""
        if self.kernel is None:
            for each in _probes[self.owner]:
                if each.kernel is None:
                    each._make_kernel()
        device = wp.get_device(device or default_device())
        values, rows = list(arguments), {}
        for index, (kind, value) in enumerate(zip(self.inputs.values(), arguments, strict=True)):
            if not _shared(kind):
                rows[index] = kind, _numpy(kind, value)
        shape = np.broadcast_shapes(*(values.shape[: values.ndim - len(_components(kind))] for kind, values in rows.values()))
        count = int(np.prod(shape))
        for index, (kind, row) in rows.items():
            components = _components(kind)
            values[index] = wp.array(np.broadcast_to(row, shape + components).reshape(count, *components), dtype=kind, device=device)
        outputs = [wp.empty(count, dtype=kind, device=device) for kind in self.outputs]
        wp.launch(self.kernel, dim=count, inputs=values, outputs=outputs, device=device)
        results = [output.numpy() for output in outputs]
        results = [result.reshape(shape + result.shape[1:]) for result in results]
        return results[0] if len(results) == 1 else results

    def _make_kernel(self) -> None:
        if self.func.value_func is None:
            self.func.build(None)
        kinds = self.func.value_func(self.inputs, None)
        self.outputs = [type_to_warp(kind) for kind in (kinds if isinstance(kinds, list | tuple) else [kinds] if kinds else [])]
        outputs = [f"out_{index}" for index in range(len(self.outputs))]
        call = ", ".join(name if _shared(kind) else f"{name}[thread_row]" for name, kind in self.inputs.items())
        results = [f"result_{index}" for index in range(len(outputs))]
        lines = [f"def probe_kernel({', '.join([*self.inputs, *outputs])}):", "thread_row = wp.tid()"]
        lines += [f"{', '.join(results)} = func({call})" if results else f"func({call})"]
        lines += [f"{output}[thread_row] = {result}" for output, result in zip(outputs, results, strict=True)]
        space: dict[str, Any] = {"wp": wp, "func": self.func}
        source = "\n    ".join(lines) + "\n"
        exec(source, space)
        types = {name: kind if _shared(kind) else wp.array(dtype=kind) for name, kind in self.inputs.items()}
        space["probe_kernel"].__annotations__ = types | {n: wp.array(dtype=kind) for n, kind in zip(outputs, self.outputs, strict=True)}
        module = wp.get_module(f"{self.owner}.probes")
        module.options["enable_backward"] = False
        self.kernel = wp.Kernel(space["probe_kernel"], key=f"probe_{self.func.key}", source=source, module=module)


def probe(func: wp.Function, **kinds: Any) -> Probe:
    """Wrap a Warp function, to be called with NumPy arrays; `kinds` are the types of its generic parameters."""
    if kinds:
        func = func.get_overload([kinds.get(name, kind) for name, kind in func.input_types.items()], {})
    frame = inspect.currentframe()
    assert frame is not None
    assert frame.f_back is not None
    return Probe(func, frame.f_back.f_globals["__name__"].rpartition(".")[0])


def _shared(kind: Any) -> bool:
    """Arrays, and structs that have some, are the same for all rows."""
    return is_array(kind) or (isinstance(kind, Struct) and any(_shared(member.type) for member in kind.vars.values()))


def _numpy(kind: Any, value: Any) -> np.ndarray:
    if isinstance(kind, Struct):
        return value if isinstance(value, np.ndarray) else wp.array([value], dtype=kind, device="cpu").numpy()[0]
    return np.asarray(value).astype(wp.dtype_to_numpy(getattr(kind, "_wp_scalar_type_", kind)))


def _components(kind: Any) -> tuple[int, ...]:
    return getattr(kind, "_shape_", ())
