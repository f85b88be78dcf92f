"""Random numbers on device and host, and low-discrepancy sequences; nothing depends on the kind of processor: the same bits with other
kernels of BLAS, other SIMD, other variants of the C library."""

import ast
import itertools
import json
import os
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Stream
from synpick_warp.kernels import rng as kernels
from synpick_warp.system import linear_algebra
from synpick_warp.system.random_numbers import r2_points, sample_triangles
from tests.harness.fingerprints import fingerprints
from tests.harness.probe import probe
from tests.harness.processes import module_command
from tests.twins import rng

# A test below fails by chance once in 10⁵ fixed seeds, so never.
SIGMA = 4.5


@wp.func
def sample_all(seed: wp.uint64, episode: int, arrangement: int, stream: int, index: int, count: int):
    """One sample of each type."""
    key = kernels.stream_key(seed, episode, arrangement, stream)
    return key, kernels.uniform(key, index), kernels.uniform_index(key, index, count), kernels.uniform_rotation(key, index)


sample = probe(sample_all)


def draw(device, seeds, stream_indices, count: int = 21):
    """Keys, uniforms, indices and rotations from the device."""
    stream_indices = np.atleast_2d(np.asarray(stream_indices, np.int32))
    seeds = np.broadcast_to(np.asarray(seeds, np.uint64), len(stream_indices))
    return sample(seeds, *stream_indices.T, count, device=device)


def stream(device, length: int, seed: int = 0, episode: int = 0, arrangement: int = 0, stream: int = Stream.DROP, step: int = 1):
    index = step * np.arange(length)
    return draw(device, seed, np.stack([np.full(length, episode), np.full(length, arrangement), np.full(length, stream), index], axis=1))


def chi_square(counts: np.ndarray) -> float:
    """Deviations of chi-square from its mean, in standard deviations; of n degrees of freedom its variance is 2 n."""
    expected = counts.sum() / counts.size
    return float((((counts - expected) ** 2 / expected).sum() - (counts.size - 1)) / np.sqrt(2 * (counts.size - 1)))


def test_the_twin_is_splitmix64():
    """The first numbers from state 1234567, as in the generator's published test vector."""
    numbers = [int(rng.bits(np.uint64(1234567), index)) for index in range(5)]
    assert numbers == [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]


def test_every_address_gives_the_twins_numbers_to_the_bit(device):
    numbers = np.random.default_rng(0)
    seeds = np.append(numbers.integers(0, 2**63, 2000, dtype=np.uint64), [0, 1, 2**63 - 1])
    stream_indices = numbers.integers(0, 2**20, (len(seeds), 4), dtype=np.int32)
    stream_indices[:10] = np.array([-1, 2**31 - 1, 0, 1, 2, 3, 4, 5, 6, 7])[:, None]
    key, uniform, index, rotation = draw(device, seeds, stream_indices, 21)
    expected = np.array(
        [rng.stream_key(seed, *stream_index[:3]) for seed, stream_index in zip(seeds, stream_indices, strict=True)], np.uint64
    )
    np.testing.assert_array_equal(key, expected)
    np.testing.assert_array_equal(uniform, rng.uniform(expected, stream_indices[:, 3]))
    np.testing.assert_array_equal(index, rng.uniform_index(expected, stream_indices[:, 3], 21))
    np.testing.assert_allclose(rotation[10:], rng.uniform_rotation(expected, stream_indices[:, 3])[10:], atol=2e-6)


@given(
    seed=st.integers(0, 2**63 - 1),
    stream_index=st.tuples(st.integers(-1, 2**31 - 1), st.integers(0, 1000), st.integers(1, 5), st.integers(0, 2**31 - 4)),
    count=st.integers(1, 2**20),
)
def test_numbers_stay_in_range(seed, stream_index, count, device):
    _, uniform, index, rotation = draw(device, seed, stream_index, count)
    assert 0.0 <= uniform[0] < 1.0
    assert 0 <= index[0] < count
    assert np.linalg.norm(rotation[0]) == pytest.approx(1.0, abs=1e-5)


def test_numbers_are_even(device):
    """Low bits as well: a float has 24, of which the least must be random, too."""
    _, uniform, index, _ = stream(device, 40_000)
    assert abs(chi_square(np.histogram(uniform, 100, (0.0, 1.0))[0])) < SIGMA
    assert abs(chi_square(np.bincount(index, minlength=21))) < SIGMA
    assert abs(chi_square(np.bincount((uniform * 2.0**24).astype(np.int64) % 64, minlength=64))) < SIGMA
    pairs = np.histogram2d(uniform[::2], uniform[1::2], 20, ((0.0, 1.0), (0.0, 1.0)))[0]
    assert abs(chi_square(pairs)) < SIGMA


NEIGHBOURS = [{}, {"stream": Stream.OBJECTS}, *({name: step} for name in ("seed", "episode", "arrangement") for step in (1, 2))]


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(NEIGHBOURS, 2)))
def test_streams_of_neighbouring_addresses_are_independent(device, one, other):
    """Neither a common number nor a correlation, at any small shift."""
    a, b = stream(device, 4000, **one)[1], stream(device, 4000, **other)[1]
    for shift in range(-3, 4):
        x, y = a[3:-3], b[3 + shift : len(b) - 3 + shift]
        assert (x == y).sum() <= 3
        assert abs(np.corrcoef(x, y)[0, 1]) < SIGMA / np.sqrt(len(x))


def test_the_first_number_is_even_over_episodes_and_attempts(device):
    """What each episode draws first must not depend on how episodes are counted."""
    episode, arrangement = np.divmod(np.arange(20_000), 4)
    stream_indices = np.stack([episode, arrangement, np.full(20_000, Stream.OBJECTS), np.zeros(20_000)], axis=1)
    _, _, index, _ = draw(device, 7, stream_indices)
    assert abs(chi_square(np.bincount(index, minlength=21))) < SIGMA
    following = np.bincount(21 * index[:-1] + index[1:], minlength=441)
    assert abs(chi_square(following)) < SIGMA


def test_rotations_are_uniform(device):
    """Of uniform rotations, the mean matrix is 0, each turned axis is even over the sphere, and angles have density (1 - cos t) / π."""
    count = 30_000
    x, y, z, w = stream(device, count, step=3)[3].astype(np.float64).T
    np.testing.assert_allclose(x * x + y * y + z * z + w * w, 1.0, atol=1e-5)
    turned = {
        "x": np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
        "y": np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
        "z": np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
    }
    for axis in turned.values():
        # Each entry has the variance 1/3.
        assert np.abs(axis.mean(axis=1)).max() < SIGMA / np.sqrt(3 * count)
        for component in axis:
            assert abs(chi_square(np.histogram(component, 40, (-1.0001, 1.0001))[0])) < SIGMA
    angle = 2 * np.arccos(np.minimum(1.0, np.abs(w)))
    assert abs(chi_square(np.histogram((angle - np.sin(angle)) / np.pi, 40, (0.0, 1.0))[0])) < SIGMA


def test_first_points_of_r2():
    """Fractional parts of multiples of the root p of p³ = p + 1: 1 / p = p² - 1 and 1 / p² = p - 1 / p."""
    plastic = np.roots([1.0, 0.0, -1.0, -1.0])[0].real
    steps = np.array([plastic**2 - 1.0, plastic - 1.0 / plastic])
    np.testing.assert_allclose(r2_points(np.arange(3)), np.stack([np.zeros(2), steps, 2.0 * steps - 1.0]), atol=1e-12)
    np.testing.assert_allclose(r2_points(np.arange(1), start=0.5), [[0.5, 0.5]])


def test_each_cell_of_a_grid_gets_about_its_part():
    cells = (8 * r2_points(np.arange(6400))).astype(int)
    counts = np.bincount(8 * cells[:, 0] + cells[:, 1], minlength=64)
    assert abs(counts - 100).max() <= 5


def test_triangles_get_points_by_their_area():
    areas = np.array([1.0, 0.0, 3.0, 6.0])
    face, weights = sample_triangles(areas, 1000)
    np.testing.assert_allclose(np.bincount(face, minlength=4), [100, 0, 300, 600], atol=3)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert weights[face == 3].mean(axis=0) == pytest.approx([1 / 3] * 3, abs=0.02)


# ---- kinds of processors ----


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
    "Prescott": {
        "NPY_DISABLE_CPU_FEATURES": " ".join(SIMD),
        "GLIBC_TUNABLES": SCALAR,
        "OPENCV_CPU_DISABLE": "AVX2,AVX,FP16",
        "OPENCV_IPP": "disabled",
    },
}
"""By OpenBLAS's kernels (OPENBLAS_CORETYPE): what else such a processor lacks."""


def on_core(core: str, folder: Path) -> dict[str, str]:
    command = [*module_command("tests.harness.fingerprints"), str(folder / core)]
    environment = os.environ | {"OPENBLAS_CORETYPE": core} | PROCESSORS[core]
    return json.loads(subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True).stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="kinds of x86-64 processors")
def test_no_bit_depends_on_the_kind_of_processor(tmp_path):
    """Shapes, masses, symmetries, lights, cameras and each file of a bake: on this processor as it is, and as two older kinds."""
    own = fingerprints(tmp_path / "own")
    with ThreadPoolExecutor(2) as threads:
        for core, other in zip(PROCESSORS, threads.map(partial(on_core, folder=tmp_path), PROCESSORS), strict=True):
            assert own.keys() == other.keys()
            assert {name for name in own if own[name] != other[name]} == set(), core


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
    for turn in (*turns, *Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity()):
        np.testing.assert_allclose(abs(linear_algebra.quaternion(turn.as_matrix()) @ turn.as_quat()), 1.0, atol=1e-14)
    vector = turns.as_rotvec()[0]
    angle = float(linear_algebra.norm(vector))
    np.testing.assert_allclose(linear_algebra.rotation(vector / angle, angle), turns[0].as_matrix(), atol=2e-12)
