"""Generated CUDA source of kernels without their names: what a checkout compiles, whatever its modules, functions and kernels are called.

Runs in a checkout, as a script that imports nothing of `tools`, and writes a JSON file: {kernel key: [canonical source, ...]}. Without a
command, the kernels are those of all modules of `synpick_warp.kernels` and those that are composed for a GPU only. With one, `synpick_warp`
runs it, and they are those of the modules that it has loaded: Newton's, with the overloads and device functions that we give them.

    python kernel_sources.py OUT.json [COMMAND OF synpick_warp ...]

The canonical source of a kernel is its own and that of all functions and structs it uses, in the order of their first use. Comments are
left out, and definitions and parameters are numbered instead of named. No GPU and no compiler are needed.
"""

import importlib
import json
import pkgutil
import re
import runpy
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ARCHITECTURE = 90
"""CUDA compute capability of the source."""
ROWS, DOFS, BODIES = 96, 16, 5
"""Compile-time constants of the composed solver kernel: capacities of a small world."""
PACKAGE = "synpick_warp"
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_DEFINITION = re.compile(r'^(?:extern "C" |(?:struct|static|CUDA_CALLABLE|template|inline)\b)', re.MULTILINE)
_KERNEL = re.compile(r"(\w+)_cuda_kernel_(?:forward|backward)")
_NAME = re.compile(r"[A-Za-z_]\w*")
_HASH = re.compile(r"_[0-9a-f]{8}\b")
_PARAMETER = re.compile(r"\b(?:adj_|var_|ret_)+[A-Za-z]\w*")

Sources = dict[str, list[str]]
"""Kernel key -> canonical source of each kernel of that key."""


def main() -> None:
    """Write the generated sources of all kernels as JSON to the first argument; further ones are a command whose modules are taken."""
    out, *command = sys.argv[1:]
    modules = list(run_command(command)) if command else [*package_modules(), *composed_modules()]
    sources: Sources = defaultdict(list)
    for module in dict.fromkeys(modules):
        for key, source in kernels_of(module):
            sources[key].append(source)
    Path(out).write_text(json.dumps({key: sorted(set(found)) for key, found in sorted(sources.items())}))


def run_command(arguments: list[str]) -> Iterator[Any]:
    """Run a command of the package; yields all modules of which it has loaded kernels. Raises SystemExit: the command has failed."""
    sys.argv = [PACKAGE, *arguments]
    try:
        runpy.run_module(PACKAGE, run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        if stop.code:
            raise
    from warp._src import context

    yield from (module for _, module in sorted(context.user_modules.items()) if module.execs)


def package_modules() -> Iterator[Any]:
    """Yield all Warp modules of the package's device code."""
    from warp._src import context

    import_all(f"{PACKAGE}.kernels")
    yield from (module for name, module in sorted(context.user_modules.items()) if name.startswith(PACKAGE))


def composed_modules() -> Iterator[Any]:
    """Warp modules of kernels that are composed for a GPU: the solver's iterations, and the narrow phase with our options.

    Their functions are found by name, wherever they lie; without one, its kernels are missing.
    """
    import_all(f"{PACKAGE}.stages")
    compose_kernel, compose_contacts, slow_builds = (find(name) for name in ("compose_kernel", "compose_contacts", "slow_builds"))
    if compose_kernel and compose_contacts:
        steel = importlib.import_module("newton._src.solvers.steel.solver_steel")
        phases = {"has_dense_velocity_limit_rows": False, "shared_metadata": True, "row_phases": True}
        joint_rows = steel._get_pgs_solve_mf_gs_kernel(ROWS, ROWS, DOFS, ARCHITECTURE, **phases)
        refresh = steel._get_refresh_propagation_tree_body_qd_warp_kernel(4, 2, ARCHITECTURE)
        propagate = steel._get_propagate_tree_impulses_revolute_kernel(4, 2, ARCHITECTURE, has_free_root=True)
        yield compose_kernel(joint_rows, refresh, compose_contacts(ROWS, BODIES), propagate).module
    if slow_builds:
        yield from (build.module for build in slow_builds(SimpleNamespace(is_cuda=True, alias="cuda:0")))


def import_all(package: str) -> None:
    """Import a package and all modules below it."""
    folder = importlib.import_module(package)
    for module in pkgutil.walk_packages(folder.__path__, f"{package}."):
        importlib.import_module(module.name)


def find(name: str) -> Any:
    """The object that a loaded module of the package calls `name`; None: no module does."""
    found = (vars(module).get(name) for key, module in sorted(sys.modules.items()) if key.startswith(PACKAGE))
    return next((each for each in found if each is not None), None)


def kernels_of(module: Any) -> Iterator[tuple[str, str]]:
    """(key, canonical source) of each kernel of a Warp module, after a line with the module's options."""
    from warp._src.context import ModuleBuilder, ModuleHasher

    options = dict(module.options)
    kernels = module._get_live_kernels()
    if not kernels:
        return
    block = {"output_arch": ARCHITECTURE, "block_dim": options.get("block_dim") or 256}
    builder = ModuleBuilder(module, options | block, hasher=ModuleHasher(kernels, options), target="cuda")
    definitions = split_definitions(builder.codegen("cuda"))
    heading = "\n".join(f"{name} = {options[name]}" for name in sorted(options))
    for name in definitions:
        if match := _KERNEL.fullmatch(name):
            yield _HASH.sub("", match[1]), f"{heading}\n{canonical(name, definitions)}"


def split_definitions(source: str) -> dict[str, str]:
    """Name -> text of each function and struct of a generated module, without comments and blank lines.

    Overloads, such as the sums of structs, are one text: sorted, as their order in a module follows hashes.
    """
    text = "\n".join(line for line in _COMMENT.sub("", source).splitlines() if line.strip() and not line.startswith("#"))
    definitions: dict[str, list[str]] = {}
    position = 0
    while match := _DEFINITION.search(text, position):
        position = _end(text, match.start())
        definition = text[match.start() : position]
        head = definition.split("{", 1)[0]
        kernel = _KERNEL.search(head)
        name = kernel[0] if kernel else _NAME.findall(head.split("(", 1)[0])[-1]
        definitions.setdefault(name, []).append(definition)
    return {name: "\n".join(sorted(texts, key=partial(_HASH.sub, ""))) for name, texts in definitions.items()}


def _end(text: str, start: int) -> int:
    """End of the definition that starts there: behind its closing brace, or behind the semicolon of a declaration."""
    depth = 0
    for match in re.compile(r"[{};]").finditer(text, start):
        depth += {"{": 1, "}": -1, ";": 0}[match[0]]
        if depth == 0:
            return match.end()
    return len(text)


def canonical(kernel: str, definitions: dict[str, str]) -> str:
    """Text of a kernel and of all definitions that it uses, in the order of their first use, with numbers instead of names."""
    order = {kernel: 0}
    for name in (queue := [kernel]):
        for used in _NAME.findall(definitions[name]):
            if used in definitions and used not in order:
                order[used] = len(order)
                queue.append(used)
    return "\n".join(_number(definitions[name], order) for name in order)


def _number(text: str, order: dict[str, int]) -> str:
    """Replace names of definitions by their numbers, and names of parameters by numbers of their own."""
    text = _NAME.sub(lambda match: f"D{order[match[0]]}" if match[0] in order else match[0], text)
    parameters: dict[str, int] = {}
    return _PARAMETER.sub(lambda match: f"p{parameters.setdefault(match[0], len(parameters))}", text)


def first_difference(old: Iterable[str], new: Iterable[str]) -> str:
    """First differing line of two lists of canonical sources, both ways round; empty: none."""
    lines = ("\n".join(sources).splitlines() for sources in (old, new))
    for number, (one, other) in enumerate(zip(*lines, strict=False), start=1):
        if one != other:
            return f"line {number}: {one.strip()} | {other.strip()}"
    return "" if list(old) == list(new) else "more lines"


if __name__ == "__main__":
    main()
