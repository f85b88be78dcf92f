"""Static check (linter) of device code: prints file:line: rule for each violation, and exits with 1 if there are any.

Kernels: named `foo_kernel`; at most 16 parameters, each annotated, none with a default; `_out` or `_inout` ends the names of written arrays
and structs, and of no others; a docstring. Arrays beside structs: a comment behind each names its dimensions, and all parameters are in
groups headed `# Scene:`, `# State:`, `# In:`, `# Out:`, in this order (the owner may follow).
Kernel modules: a docstring, no backward passes, no postponed annotations, no imports but Warp and other kernels.
Everywhere: `wp.launch` in synpick_warp/{stages,newton_patches} only, with arguments named as the parameters at their positions: Warp checks
dtypes and dimensions, so two arrays of the same type can be swapped silently. Arguments are read from list literals in the call, or from
lists built in the same function by `inputs = [...]` and `inputs += [...]`. An argument's name is the last part of its expression
(`state.phase` is `phase`); a parameter's is its own without `_out` or `_inout`.

    python -m tools.checks.kernels
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

MAX_PARAMETERS = 16
GROUPS = ("Scene", "State", "In", "Out")
WRITTEN = ("_out", "_inout")
"""Suffixes of parameters that a kernel writes to."""
KERNEL_PACKAGE = "synpick_warp.kernels"
CODES = "synpick_warp.codes"
TYPES = ("typing", "collections")
"""Modules whose names annotations have."""
LAUNCHING = ("synpick_warp/stages", "synpick_warp/newton_patches")
HOST_FOLDERS = ("synpick_warp", "tools")
_GROUP = re.compile(rf"\s*#\s*({'|'.join(GROUPS)}):")
_ARRAY = re.compile(r"wp\.array(?:([234])d)?\[")
_SHAPE = re.compile(r"#\s*\(([^)]*)\)")
_WRITING_CALL = re.compile(r"wp\.(atomic_\w+|tile_store|tile_atomic_\w+)")
LAUNCH_OFFSET = "first"
"""Parameter that the launchers of `stages.launch` append to the inputs."""
LAUNCHERS = ("wp.launch", "wp.launch_tiled", "launch_pixels", "launch_views")
"""Functions that launch with exactly the given arguments; launch methods of a class may prepend inputs."""

Fault = tuple[Path, int, str]
Writes = dict[str, set[int]]
"""Name of a device function -> positions of the parameters it writes to."""
Parameters = dict[str, list[str]]
"""Kernel name -> names of its parameters."""
Position = tuple[int, int]
"""Line and column."""
Lists = dict[str, list[tuple[Position, list[ast.expr], bool]]]
"""Variable -> (position, elements, whether they are appended) of each list literal assigned to it."""


def main(root: Path) -> int:
    """Check the tree under `root`; return the exit code."""
    modules = {path: ast.parse(path.read_text()) for path in sorted((root / "synpick_warp" / "kernels").rglob("*.py"))}
    writes = function_writes(modules)
    faults = [fault for path, tree in modules.items() for fault in check_module(path, tree, writes)]
    faults += [fault for folder in HOST_FOLDERS for fault in check_launches(root, folder)]
    launching = sorted(path for folder in LAUNCHING for path in (root / folder).rglob("*.py"))
    parameters = kernel_parameters(modules)
    faults += [fault for path in launching for fault in check_launch_arguments(path, parameters)]
    for path, line, rule in faults:
        print(f"{path.relative_to(root)}:{line}: {rule}")
    return 1 if faults else 0


def check_module(path: Path, tree: ast.Module, writes: Writes) -> Iterator[Fault]:
    """Yield the faults of one kernel module."""
    if ast.get_docstring(tree) is None:
        yield path, 1, "a kernel module needs a docstring"
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [function for function in functions if decorated(function, "kernel")]
    if kernels and not any(disables_backward(node) for node in tree.body):
        yield path, 1, 'missing: wp.set_module_options({"enable_backward": False})'
    for line, name in imports(tree):
        if name == "__future__.annotations":
            yield path, line, "Warp reads annotations: no `from __future__ import annotations` here"
        elif name.split(".")[0] not in ("warp", *TYPES) and not name.startswith((KERNEL_PACKAGE, CODES)):
            yield path, line, f"kernels import Warp, codes and other kernels only, not {name}"
    lines = path.read_text().splitlines()
    for kernel in kernels:
        for line, rule in check_kernel(kernel, lines, writes):
            yield path, line, rule
    for function in functions:
        if function.name.endswith("_kernel") and function not in kernels:
            yield path, function.lineno, f"{function.name} is not a kernel"


def check_kernel(kernel: ast.FunctionDef, lines: list[str], writes: Writes) -> Iterator[tuple[int, str]]:
    """Yield the faults of one kernel as (line, rule)."""
    parameters = kernel.args.args
    if not kernel.name.endswith("_kernel"):
        yield kernel.lineno, f"the kernel {kernel.name} must end in _kernel"
    if ast.get_docstring(kernel) is None:
        yield kernel.lineno, f"{kernel.name} needs a docstring: its law, with units"
    if len(parameters) > MAX_PARAMETERS:
        yield kernel.lineno, f"{kernel.name} has {len(parameters)} parameters; at most {MAX_PARAMETERS}: use a struct, or two kernels"
    others = kernel.args
    if others.defaults or others.kw_defaults or others.kwonlyargs or others.posonlyargs or others.vararg or others.kwarg:
        yield kernel.lineno, f"{kernel.name} can only have plain parameters without defaults"
    if any(parameter.annotation is not None and _ARRAY.match(ast.unparse(parameter.annotation)) for parameter in parameters):
        yield from check_groups(kernel, lines)
    yield from check_shapes(kernel, lines)
    certain, possible = written_names(kernel, writes)
    for parameter in parameters:
        name = parameter.arg
        if parameter.annotation is None:
            yield parameter.lineno, f"{name} needs an annotation"
        if name in certain and not name.endswith(WRITTEN):
            yield parameter.lineno, f"{kernel.name} writes to {name}; its name must end in _out or _inout"
        if name.endswith(WRITTEN) and name not in certain | possible:
            yield parameter.lineno, f"{kernel.name} never writes to {name}"


def check_groups(kernel: ast.FunctionDef, lines: list[str]) -> Iterator[tuple[int, str]]:
    """Faults of parameter groups: no group comment, groups out of order, `_out` parameters outside of the group Out."""
    group = ""
    line = kernel.lineno
    for parameter in kernel.args.args:
        for comment_line in range(line, parameter.lineno + 1):
            match = _GROUP.match(lines[comment_line - 1])
            if match:
                if group and GROUPS.index(match[1]) <= GROUPS.index(group):
                    yield comment_line, f"groups come once, in the order {', '.join(GROUPS)}"
                group = match[1]
        line = parameter.lineno
        if not group:
            yield parameter.lineno, f"{parameter.arg} has no group; put it below a comment: # Scene:, # State:, # In: or # Out:"
        elif parameter.arg.endswith("_out") != (group == "Out") and not parameter.arg.endswith("_inout"):
            yield (
                parameter.lineno,
                f"{parameter.arg} is in the group # {group}:; names ending in _out, and no others, belong to the group # Out:",
            )


def check_shapes(kernel: ast.FunctionDef, lines: list[str]) -> Iterator[tuple[int, str]]:
    """Array parameters whose line does not end in a comment with a name for each of their dimensions, such as `# (world, instance) [m]`."""
    for parameter in kernel.args.args:
        match = _ARRAY.match(ast.unparse(parameter.annotation)) if parameter.annotation is not None else None
        if match is None:
            continue
        shape = _SHAPE.search(lines[parameter.lineno - 1])
        dimensions = int(match[1] or 1)
        if shape is None:
            yield parameter.lineno, f"{kernel.name}: {parameter.arg} needs a comment with the names of its {dimensions} dimensions"
        elif len(shape[1].split(",")) != dimensions:
            yield parameter.lineno, f"{kernel.name}: {parameter.arg} has {dimensions} dimensions, its comment names ({shape[1]})"


def written_names(function: ast.FunctionDef, writes: Writes) -> tuple[set[str], set[str]]:
    """Names the function certainly writes to, and names it passes to functions, which might write to them."""
    certain: set[str] = set()
    possible: set[str] = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AugAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Subscript | ast.Attribute):
                    certain.add(base_name(target))
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if _WRITING_CALL.fullmatch(called) and node.args:
                certain.add(base_name(node.args[0]))
            elif not called.startswith("wp."):
                possible |= {base_name(argument) for argument in node.args}
                certain |= {base_name(node.args[position]) for position in writes.get(called, ()) if position < len(node.args)}
    return certain, possible


def function_writes(modules: dict[Path, ast.Module]) -> Writes:
    """Parameters each device function writes to, directly or through calls (fixed point over the call graph)."""
    nodes = [node for tree in modules.values() for node in ast.walk(tree)]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef) and decorated(node, "func")]
    writes: Writes = {function.name: set() for function in functions}
    changed = True
    while changed:
        changed = False
        for function in functions:
            certain, _ = written_names(function, writes)
            arrays = {
                position
                for position, parameter in enumerate(function.args.args)
                if parameter.arg in certain and parameter.annotation is not None and "array" in ast.unparse(parameter.annotation)
            }
            changed = changed or not arrays <= writes[function.name]
            writes[function.name] |= arrays
    return writes


def check_launches(root: Path, folder: str) -> Iterator[Fault]:
    """Yield the faults of host modules in `folder`: kernel launches outside the stages."""
    for path in sorted((root / folder).rglob("*.py")):
        if path.relative_to(root).as_posix().startswith(LAUNCHING) or path.is_relative_to(root / "synpick_warp" / "kernels"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and re.fullmatch(r"(wp|warp)\.launch(_tiled)?", ast.unparse(node.func)):
                yield path, node.lineno, f"kernels are launched in {' and '.join(LAUNCHING)} only"


def decorated(function: ast.FunctionDef, kind: str) -> bool:
    """Whether the function has the decorator @wp.KIND or @KIND_of_views, with or without arguments."""
    names = (f"wp.{kind}", f"warp.{kind}", f"{kind}_of_views")
    return any(ast.unparse(decorator).split("(")[0] in names for decorator in function.decorator_list)


def disables_backward(node: ast.stmt) -> bool:
    """Whether the statement is wp.set_module_options({"enable_backward": False, ...})."""
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Call):
        return False
    call = node.value
    if ast.unparse(call.func) != "wp.set_module_options" or not call.args or not isinstance(call.args[0], ast.Dict):
        return False
    pairs = zip(call.args[0].keys, call.args[0].values, strict=True)
    return any(ast.unparse(key) == "'enable_backward'" and ast.unparse(value) == "False" for key, value in pairs if key is not None)


def imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield (line, full name) of each import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.lineno, f"{node.module}.{name.name}") for name in node.names)


def base_name(node: ast.expr) -> str:
    """Variable at the root of an expression such as a[i].b[j]; empty: none."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


# ---- launches ----


def kernel_parameters(modules: dict[Path, ast.Module]) -> Parameters:
    """Parameter names of all kernels, by kernel name."""
    functions = (node for tree in modules.values() for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    return {function.name: [item.arg for item in function.args.args] for function in functions if function.name.endswith("_kernel")}


def check_launch_arguments(path: Path, kernels: Parameters) -> Iterator[Fault]:
    """Yield the faults of one host module: launches whose arguments contradict the kernel's parameter names."""
    for function in ast.walk(ast.parse(path.read_text())):
        if not isinstance(function, ast.FunctionDef):
            continue
        lists = _find_lists(function)
        for call in ast.walk(function):
            kernel = _launched_kernel(call, kernels)
            if kernel and isinstance(call, ast.Call):
                arguments = _arguments(call, lists)
                if arguments is not None:
                    launcher = ast.unparse(call.func)
                    offset = launcher not in ("wp.launch", "wp.launch_tiled")
                    names = [_base(name) for name in kernels[kernel] if not (offset and name == LAUNCH_OFFSET)]
                    if launcher not in LAUNCHERS:
                        names = names[max(0, len(names) - len(arguments)) :]
                    yield from ((path, line, rule) for line, rule in _compare(call.lineno, kernel, arguments, names))


def _compare(line: int, kernel: str, arguments: list[ast.expr], names: list[str]) -> Iterator[tuple[int, str]]:
    """Faults of one launch as (line, rule): a wrong count, or an argument with the name of another parameter."""
    if len(arguments) != len(names):
        yield line, f"{kernel} takes {len(names)} arguments, not {len(arguments)}"
        return
    given = [_argument_name(argument) for argument in arguments]
    for position, (argument, name) in enumerate(zip(given, names, strict=True)):
        if argument != name and argument in names and given.count(argument) <= names.count(argument):
            yield arguments[position].lineno, f"{kernel} takes {name} where {argument} is given; {argument} belongs elsewhere"


def _launched_kernel(call: ast.AST, kernels: Parameters) -> str:
    """Name of the kernel launched by a call; empty: none."""
    if not isinstance(call, ast.Call) or "launch" not in ast.unparse(call.func):
        return ""
    names = (_argument_name(argument) for argument in call.args[:1])
    return next((name for name in names if name in kernels), "")


def _find_lists(function: ast.FunctionDef) -> Lists:
    """List literals assigned or appended to variables of the function."""
    lists: Lists = {}
    for node in ast.walk(function):
        appended = isinstance(node, ast.AugAssign)
        targets = [node.target] if isinstance(node, ast.AugAssign) else node.targets if isinstance(node, ast.Assign) else []
        if targets and isinstance(node.value, ast.List) and isinstance(targets[0], ast.Name):  # type: ignore[union-attr]
            lists.setdefault(targets[0].id, []).append(((node.lineno, node.col_offset), node.value.elts, appended))  # type: ignore[union-attr]
    return lists


def _arguments(call: ast.Call, lists: Lists) -> list[ast.expr] | None:
    """Expressions of a launch's inputs and outputs; None if the source does not show them."""
    named = [keyword.value for keyword in call.keywords if keyword.arg in ("inputs", "outputs")]
    positional = [argument for argument in call.args[1:] if isinstance(argument, ast.List) or _argument_name(argument) in lists]
    if not named and call.args[-1] not in positional and ast.unparse(call.func) not in LAUNCHERS:
        positional.append(ast.List(elts=[call.args[-1]]))  # The only output of a class's launch method.
    elements: list[ast.expr] = []
    for value in named or positional:
        expanded = _expand(value, (call.lineno, call.col_offset), lists)
        if expanded is None:
            return None
        elements += expanded
    return elements


def _expand(value: ast.expr, at: Position, lists: Lists) -> list[ast.expr] | None:
    """Elements of a list literal, or of a variable with a list before a position; None: unknown.

    Lists within a list are those before its own assignment, as in `inputs = [*inputs, depth]`.
    """
    if isinstance(value, ast.Name):
        before = sorted((item for item in lists.get(value.id, []) if item[0] < at), key=lambda item: item[0])
        start = max((index for index, item in enumerate(before) if not item[2]), default=None)
        if start is None:
            return None
        parts = [(element, item[0]) for item in before[start:] for element in item[1]]
    elif isinstance(value, ast.List):
        parts = [(element, at) for element in value.elts]
    else:
        return None
    elements: list[ast.expr] = []
    for part, place in parts:
        expanded = _expand(part.value, place, lists) if isinstance(part, ast.Starred) else [part]
        if expanded is None:
            return None
        elements += expanded
    return elements


def _argument_name(argument: ast.expr) -> str:
    """Last name of an expression: `scene.layout` -> layout, `wp.uint64(seed)` -> seed, `buffers["code"]` -> code."""
    if isinstance(argument, ast.Call) and len(argument.args) == 1:
        return _argument_name(argument.args[0])
    if isinstance(argument, ast.Attribute):
        return argument.attr
    if isinstance(argument, ast.Subscript) and isinstance(argument.slice, ast.Constant) and isinstance(argument.slice.value, str):
        return argument.slice.value
    return argument.id if isinstance(argument, ast.Name) else ""


def _base(name: str) -> str:
    """Parameter name without "_out" or "_inout"."""
    return next((name.removesuffix(suffix) for suffix in WRITTEN if name.endswith(suffix)), name)


if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[2]))
