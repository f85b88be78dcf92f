"""Nothing depends on the kind of processor: the same bits with other kernels of BLAS, other SIMD, other variants of the C library."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from scipy.spatial.transform import Rotation

from synpick_warp.system import linear_algebra

ROOT = Path(__file__).resolve().parent.parent
ROOMS = tuple(f"synpick_warp/{name}" for name in ("scenes", "configs", "stages", "exporters"))
"""Where files and decisions are made."""
BLAS = {"dot", "inner", "vdot", "tensordot", "matmul", "convolve", "correlate", "cov", "corrcoef", "polyfit"}
OTHERS = {"from_rotvec", "from_euler", "from_matrix", "as_rotvec", "as_euler"}
"""Methods of SciPy's rotations with sines, cosines or a singular value decomposition."""
SIMD = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
SCALAR = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F,-AVX"
PROCESSORS = {
    "Haswell": {"NPY_DISABLE_CPU_FEATURES": " ".join(name for name in SIMD if name != "X86_V3")},
    "Zen": {},
    "Sandybridge": {"NPY_DISABLE_CPU_FEATURES": " ".join(SIMD), "OPENCV_IPP": "disabled"},
    "Prescott": {"NPY_DISABLE_CPU_FEATURES": " ".join(SIMD), "GLIBC_TUNABLES": SCALAR, "OPENCV_CPU_DISABLE": "AVX2,AVX,FP16"},
}
"""By OpenBLAS's kernels (OPENBLAS_CORETYPE): what else such a processor lacks."""


def fingerprints(folder: Path, core: str) -> dict[str, str]:
    command = [sys.executable, "-m", "tests.harness.fingerprints", str(folder / core)]
    environment = os.environ | {"OPENBLAS_CORETYPE": core} | PROCESSORS[core]
    return json.loads(subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True).stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="kinds of x86-64 processors")
def test_no_bit_depends_on_the_kind_of_processor(tmp_path):
    """Shapes, masses, symmetries, lights, cameras and each file of a bake."""
    with ThreadPoolExecutor(2) as threads:
        first, *others = threads.map(lambda core: fingerprints(tmp_path, core), PROCESSORS)
    for core, other in zip(list(PROCESSORS)[1:], others, strict=True):
        assert first.keys() == other.keys()
        assert {name for name in first if first[name] != other[name]} == set(), core


def machine_dependent(path: Path) -> Iterator[str]:
    """Calls whose results depend on the processor, and sorts whose order of ties does."""
    for node in ast.walk(ast.parse(path.read_text())):
        called = node.func if isinstance(node, ast.Call) else None
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            yield f"{path}:{node.lineno}: @"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "linalg":
            if node.attr != "norm":
                yield f"{path}:{node.lineno}: {node.attr}"
        elif isinstance(called, ast.Attribute):
            given = {keyword.arg for keyword in node.keywords}
            of_numpy = isinstance(called.value, ast.Name) and called.value.id == "np"
            tied = called.attr == "argsort" and "kind" not in given
            whole = called.attr == "norm" and "axis" not in given and ast.unparse(called.value) == "np.linalg"
            if tied or whole or called.attr in OTHERS or (of_numpy and called.attr in BLAS):
                yield f"{path}:{node.lineno}: {called.attr}"


def test_what_is_written_is_computed_without_blas():
    paths = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
    assert [fault for path in paths for fault in machine_dependent(path)] == []


def test_linear_algebra_agrees_with_lapack():
    random = np.random.default_rng(0)
    for size in (2, 3, 6):
        root, right = random.normal(size=(size, size)), random.normal(size=size)
        values, vectors = linear_algebra.eigh(root @ root.T)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(root @ root.T), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(vectors * values @ vectors.T, root @ root.T, atol=1e-12)
        np.testing.assert_allclose(linear_algebra.solve(root, right), np.linalg.solve(root, right), rtol=1e-9)
    stack = random.normal(size=(5, 3, 3))
    np.testing.assert_allclose(linear_algebra.det(stack), np.linalg.det(stack))
    np.testing.assert_allclose(linear_algebra.cofactors(stack), np.linalg.inv(stack).swapaxes(1, 2) * np.linalg.det(stack)[:, None, None])
    turns = Rotation.random(5, random_state=1)
    near = turns.as_matrix() + 1e-2 * stack
    np.testing.assert_allclose(linear_algebra.nearest_rotation(near), Rotation.from_matrix(near).as_matrix(), atol=1e-14)
    vector = turns.as_rotvec()[0]
    angle = float(linear_algebra.norm(vector))
    np.testing.assert_allclose(linear_algebra.rotation(vector / angle, angle), turns[0].as_matrix(), atol=2e-12)
