"""Static check of kernel launches: each argument's name against the kernel parameter at its position.

Warp checks dtypes and dimensions of arguments, so two arrays of the same type can be swapped silently. Arguments are read from list
literals in the call, or from lists built in the same function by `inputs = [...]` and `inputs += [...]`. An argument's name
is the last part of its expression (`state.phase` is `phase`); a parameter's is its own without `_out` or `_inout`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

LAUNCH_OFFSET = "first"
"""Parameter that the launchers of `stages.launch` append to the inputs."""
LAUNCHERS = ("wp.launch", "wp.launch_tiled", "launch_pixels", "launch_views")
"""Functions that launch with exactly the given arguments; launch methods of a class may prepend inputs."""
SUFFIXES = ("_inout", "_out")
"""Suffixes of parameters that a kernel writes to."""

Parameters = dict[str, list[str]]
"""Kernel name -> names of its parameters."""
Fault = tuple[Path, int, str]
Position = tuple[int, int]
"""Line and column."""
Lists = dict[str, list[tuple[Position, list[ast.expr], bool]]]
"""Variable -> (position, elements, whether they are appended) of each list literal assigned to it."""


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
    return next((name.removesuffix(suffix) for suffix in SUFFIXES if name.endswith(suffix)), name)
