"""Ring of batches: consumers read after the rendering, and the renderer waits for them, also on streams of their own; and `render`."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp

import synpick_warp
from synpick_warp.configs.calibration.lens import make_lens_map
from synpick_warp.errors import ConfigError
from synpick_warp.online.render import SceneRenderer, render_scene
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.buffers import Snapshot, view_buffer_sizes
from synpick_warp.stages.online.batches import GPU_RING, BatchRing, DeviceArray, Gate, ViewBatch
from synpick_warp.stages.render.cameras import VIEW_CAMERAS
from synpick_warp.stages.view_ring import CameraGroup
from tests.harness.spin import SPINS, spin_kernel
from tests.online.conftest import tiny

BATCHES, VIEWS, ROOM = 12, 3, 2


class NumberingRenderer:
    """Fills the depth of its n-th batch with n, after some time."""

    def __init__(self, device: wp.Device) -> None:
        self.cameras = allocate_struct(VIEW_CAMERAS, {"view": VIEWS}, device)
        self.scene = SimpleNamespace(device=device, obj_id=wp.zeros(1, dtype=wp.int32, device=device))
        self.busy, self.count = wp.zeros(1, dtype=float, device=device), 0

    def render(self, snapshot, views, out, layers, placed) -> None:
        self.count += 1
        views.cameras = self.cameras
        wp.launch(spin_kernel, dim=1, inputs=[self.busy, SPINS], device=self.scene.device)
        out.depth.fill_(self.count)
        out.instance.fill_(1 + self.count % ROOM)


@pytest.fixture
def ring(device) -> BatchRing:
    sizes = view_buffer_sizes(VIEWS, 32, 16, ROOM)
    return BatchRing(CameraGroup((0,), sizes, NumberingRenderer(device)), (), 0.1)  # type: ignore[arg-type]


def render(ring: BatchRing) -> ViewBatch:
    device = ring.device
    worlds = {"world": 1, "instance": ROOM, "fixture": 3}
    arrays = {item.name: item.metadata["array"] for item in dataclasses.fields(Snapshot)}
    snapshot = Snapshot(**{n: wp.zeros([worlds[d] for d in spec.shape], dtype=spec.dtype, device=device) for n, spec in arrays.items()})
    zeros = np.zeros(VIEWS, np.int32)
    return ring.render(snapshot, zeros, zeros, {}, {})


def test_slow_consumers_on_their_own_stream_read_each_batch_whole(ring):
    """A batch is rendered ahead, the consumer's queue is behind: nothing waits on the host, and every copy has its batch's number."""
    device = ring.device
    consumer = wp.Stream(device) if device.is_cuda else None
    kept = [wp.zeros((VIEWS, 16, 32), dtype=wp.uint16, device=device) for _ in range(BATCHES)]
    masks = [wp.zeros((VIEWS, ROOM, 16, 32), dtype=wp.bool, device=device) for _ in range(BATCHES)]
    busy = wp.zeros(1, dtype=float, device=device)
    assert len(ring.slots) == (GPU_RING if device.is_cuda else 1)
    if device.is_cuda:
        wp.synchronize_device(device)
    ahead: ViewBatch | None = None
    for index in range(BATCHES):
        batch = ahead if ahead is not None else render(ring)
        ahead = render(ring) if device.is_cuda else None
        with wp.ScopedStream(consumer, sync_enter=False):
            imported = wp.from_dlpack(batch.depth)
            wp.launch(spin_kernel, dim=1, inputs=[busy, 5 * SPINS], device=device)
            wp.copy(kept[index], imported)
            wp.copy(masks[index], wp.from_dlpack(batch.visible_masks(), dtype=wp.bool))
        batch.expire()
    assert [np.unique(values.numpy()).tolist() for values in kept] == [[1 + index] for index in range(BATCHES)]
    assert [values.numpy().all(axis=(0, 2, 3)).argmax() for values in masks] == [(1 + index) % ROOM for index in range(BATCHES)]


def test_what_an_array_says_of_itself(device):
    gate = Gate(device)
    array = DeviceArray(wp.zeros((2, 3), dtype=wp.transformf, device=device), gate)
    matrices = DeviceArray(wp.zeros(4, dtype=wp.mat44, device=device), gate)
    assert (array.shape, array.dtype, array.device) == ((2, 3, 7), np.float32, device.alias)
    assert (matrices.shape, len(matrices)) == ((4, 4, 4), 4)
    assert array.numpy().shape == np.asarray(array).shape == (2, 3, 7)
    assert np.asarray(array, dtype=np.float64).dtype == np.float64
    assert repr(array) == f"DeviceArray(float32, (2, 3, 7), {device.alias})"
    assert array.__dlpack_device__() == ((2, device.ordinal) if device.is_cuda else (1, 0))
    with pytest.raises(BufferError, match="import it there"):
        array.__dlpack__(dl_device=(99, 0))
    gate.expire()
    with pytest.raises(BufferError, match="expired"):
        array.__dlpack__(stream=None)


def test_jax_reads_every_batch_if_its_results_are_awaited():
    """JAX computes after the call has returned, on a CPU, too; see the README of `synpick_warp.online`."""
    jax = pytest.importorskip("jax", exc_type=ImportError)

    @jax.jit
    def add(image, matrix):
        # Work before the image is read, during which the buffer must not change.
        matrix = jax.lax.fori_loop(0, 40, lambda _, value: jax.numpy.tanh(value @ value), matrix)
        image, matrix = jax.lax.optimization_barrier((image, matrix))
        return image.astype(jax.numpy.float32).sum() + 0.0 * matrix.sum()

    count, matrix = 0, jax.numpy.eye(600)
    with synpick_warp.stream(tiny(bake__episodes=1)) as stream:
        for batch in stream:
            expected = batch.color.numpy().astype(np.float64).sum()
            total = add(jax.numpy.from_dlpack(batch.color), matrix)
            total.block_until_ready()
            assert float(total) == pytest.approx(expected, rel=1e-5)
            count += 1
    assert count > 3


# ---- meshes of anyone at given poses, without simulation ----

SIDE, HEIGHT = 0.1, 0.5
K = [[64.0, 0.0, 32.0], [0.0, 64.0, 24.0], [0.0, 0.0, 1.0]]
DOWN = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera.at(K, (64, 48), DOWN)
BOX = trimesh.creation.box([SIDE] * 3)
CUBE = (BOX.vertices, BOX.faces)


def at(x: float) -> np.ndarray:
    return trimesh.transformations.translation_matrix((x, 0.0, 0.0))


def test_depth_mask_and_normals_of_a_cube():
    views = synpick_warp.render([(CUBE, at(0.0))], [CAMERA, CAMERA], layers=("normals",), device="cpu")
    half = 64.0 * SIDE / 2 / (HEIGHT - SIDE / 2)
    rows, columns = (np.abs(np.arange(size) + 0.5 - size / 2) < half for size in (48, 64))
    expected = np.outer(rows, columns)
    for view in range(2):
        assert np.array_equal(views["instance"][view], expected.astype(np.uint8))
        assert np.allclose(views["depth"][view], np.where(expected, HEIGHT - SIDE / 2, 0.0), atol=1e-4)
        assert np.array_equal(views["normals"][view][expected], np.broadcast_to([0.0, 0.0, -1.0], (expected.sum(), 3)))
    assert views["color"].shape == (2, 48, 64, 3)
    assert views["color"][0][expected].min() > 20


def test_two_instances_share_a_mesh(tmp_path):
    file = tmp_path / "cube.stl"
    BOX.export(file)
    views = synpick_warp.render([(file, at(-0.1)), (str(file), at(0.1))], [CAMERA], device="cpu")
    left, right = (np.argwhere(views["instance"][0] == number)[:, 1] for number in (1, 2))
    assert left.max() < 32 <= right.min()
    assert len(left) == len(right) > 100


def test_a_lens_moves_the_edges_of_the_cube():
    """A point at a slope s is at 64 s (1 + 20 s²) px from the centre."""
    lens = make_lens_map("pinhole", (20.0, 0.0, 0.0, 0.0), (64.0, 64.0, 32.0, 24.0), (64, 48))
    views = synpick_warp.render([(CUBE, at(0.0))], [CAMERA, dataclasses.replace(CAMERA, lens=lens)], device="cpu")
    slope = SIDE / 2 / (HEIGHT - SIDE / 2)
    for view, edge in enumerate((64.0 * slope, 64.0 * slope * (1 + 20.0 * slope**2))):
        assert np.array_equal(views["instance"][view][24], np.abs(np.arange(64) + 0.5 - 32) < edge)


@pytest.mark.parametrize("mode", ["fast", "reference"])
def test_views_of_a_shared_scene_are_those_of_scenes_of_their_own(mode):
    """Worlds of one to three objects, before cameras of several poses, one with a lens, with noise and drawn looks: bit by bit the same
    images alone and in a batch, among other meshes. So what is not in a view neither shows nor shades."""
    plate = trimesh.creation.box((0.3, 0.2, 0.01))
    other, lid = (plate.vertices, plate.faces), (BOX.vertices + np.array([0.0, 0.0, 0.15]), BOX.faces)
    lens = make_lens_map("pinhole", (20.0, 0.0, 0.0, 0.0), (64.0, 64.0, 32.0, 24.0), (64, 48))
    worlds = [[(CUBE, at(0.0))], [(lid, at(0.02)), (other, at(-0.05)), (CUBE, at(0.1))], [(other, at(0.0))], [(CUBE, at(0.0))]]
    cameras = [CAMERA, Camera.at(K, (64, 48), DOWN @ at(0.03)), dataclasses.replace(CAMERA, lens=lens), CAMERA]
    looks = {"effects.read_noise": [0.01, 0.01], "effects.blur": [0.5, 0.5], "randomize.object_hue": {"uniform": [-90.0, 90.0]}}
    more = {"render.table": False, "render.mode": mode, "render.samples": 2}
    config = synpick_warp.load_config(None, looks | more)
    batch = SceneRenderer([CUBE, lid, other], cameras, ("normals",), 1.0, "cpu", config).render(worlds, cameras)
    for view, (objects, camera) in enumerate(zip(worlds, cameras, strict=True)):
        alone = render_scene(objects, [camera], ("normals",), 1.0, "cpu", config)
        assert {key: array.numpy()[view].tobytes() for key, array in batch.items()} == {
            key: array.numpy()[0].tobytes() for key, array in alone.items()
        }
    assert len({batch["color"].numpy()[view].tobytes() for view in range(4)}) == 3
    assert (batch["instance"].numpy().max(axis=(1, 2)) == [1, 3, 1, 1]).all()


@pytest.mark.parametrize(
    ("objects", "options", "expected"),
    [
        ([], {}, "render has 0 objects; allowed: 1 to 251"),
        ([(CUBE, at(0.0))], {"layers": ("normal",)}, "render has no layer normal; allowed: normals, "),
        ([(CUBE, at(0.0))], {"backend": "jax"}, 'backend is "jax"; allowed: numpy, torch'),
    ],
)
def test_mistakes_are_named(objects, options, expected):
    with pytest.raises(ConfigError, match=expected):
        synpick_warp.render(objects, [CAMERA], device="cpu", **options)
