"""Segmentation of images of ids: components, contours, distances, grasp points and visible areas; known answers, then OpenCV and SciPy.
The images: G-buffers of camera 0 without the gripper, and the number of views of a batch."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import MAX_INSTANCES, Segment
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.kernels.perception.components import STRIP
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Catalog, Fixture
from synpick_warp.stages.perception import images
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.render.scene import build_render_scene
from tests.harness.trace_probe import trace_gbuffer
from tests.twins import perception
from tests.twins.perception import SegmenterHarness
from tests.twins.planning import mosaic
from tests.worlds.shapes import GREY, UPRIGHT, ball, box, entry
from tests.worlds.toy_scene import ToyScene, build_scene, render, snapshot

WIDTH, HEIGHT, INSTANCES = 75, 48, 4
"""A row has two full strips and part of a third."""
NOTHING = {"grasp_pixel": [-1, -1], "visible": 0, "visible_fraction": 0.0, "depth": 0.0}
"""What is observed of an instance that is not visible."""


@pytest.fixture(scope="module")
def shared(device):
    return SegmenterHarness(device, WIDTH, HEIGHT, worlds=2, instances=INSTANCES)


@pytest.fixture
def harness(shared):
    """Each instance has a mass of 0.1 kg and an expected area of 0.01 m² unless a test changes them."""
    shared.mass[:], shared.area[:] = 0.1, 0.01
    return shared


def draw(*parts: tuple[int, Any]) -> np.ndarray:
    """Ids (H, W) of parts (id, index of pixels), each above those before."""
    segments = np.zeros((HEIGHT, WIDTH), np.uint8)
    for code, place in parts:
        segments[place] = code
    return segments


def check(harness: SegmenterHarness, segments: np.ndarray, depth: np.ndarray | float = 2.0) -> None:
    """Compare what is found in view 0 with the reference."""
    harness.observe(segments, depth=depth)
    labels = perception.label_components(segments, len(harness.mass))
    np.testing.assert_array_equal(harness.image("component"), labels)
    np.testing.assert_array_equal(harness.image("area").ravel(), np.bincount(labels[labels >= 0], minlength=labels.size))
    distance = np.zeros(segments.shape)
    for instance, largest in enumerate(harness.image("largest")):
        assert largest == perception.largest_label(labels, segments, instance)
        found = {name: harness.result(name, instance) for name in (*NOTHING, "pole", "centroid", "midpoint", "distances")}
        if largest < 0:
            assert {name: found[name].tolist() for name in NOTHING} == NOTHING
            assert len(harness.contour(instance)) == 0
            continue
        mask = labels == largest
        distance += np.sqrt(perception.squared_distance(mask))
        np.testing.assert_array_equal(harness.contour(instance), perception.contour(mask))
        assert found["visible"] == mask.sum()
        area = np.square(np.broadcast_to(depth, mask.shape)[mask], dtype=float).sum() / harness.focal.prod()
        assert found["visible_fraction"] == pytest.approx(area / harness.area[instance], rel=1e-5)
        column, row = found["grasp_pixel"]
        assert found["depth"] == np.broadcast_to(np.float32(depth), mask.shape)[row, column]
        expected = perception.choose_grasp_point(mask, harness.mass[instance], harness.config.perception)
        assert found["pole"].tolist() == expected["pole"].tolist()
        np.testing.assert_allclose(found["centroid"], expected["centroid"], atol=1e-4)
        # Rounding may assign a point that lies between two pixels to either.
        parts = np.concatenate([expected["centroid"], expected["midpoint"]]) % 1.0
        if (np.abs(parts - 0.5) > 1e-4).all():
            np.testing.assert_allclose(found["distances"], expected["distances"], rtol=1e-6)
            assert found["grasp_pixel"].tolist() == expected["grasp_pixel"].tolist()
    np.testing.assert_array_equal(harness.image("distance"), distance.astype(np.float32))


def noise_and_patches(rng: np.random.Generator, scale: float) -> np.ndarray:
    """Ids of instances and the tote; `scale` is the size of features [px]; noise at 0, large patches at 8."""
    segments = rng.choice(np.array([*range(INSTANCES + 1), Segment.TOTE], np.uint8), size=(HEIGHT, WIDTH))
    if scale == 0.0:
        return segments
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    first, second = rng.uniform(0, 6, 2)
    rows = np.clip(rows / scale + 2 * np.sin(columns / scale + first), 0, HEIGHT - 1).astype(int)
    columns = np.clip(columns / scale + 2 * np.cos(rows / scale + second), 0, WIDTH - 1).astype(int)
    return segments[rows, columns]


def blobs(rng: np.random.Generator, scale: float) -> np.ndarray:
    """Ids of instances with irregular borders and holes; `scale` is the size of the blobs [px]."""
    noise = rng.uniform(size=(INSTANCES, HEIGHT, WIDTH)).astype(np.float32)
    noise = np.stack([cv2.blur(layer, (1 + int(scale),) * 2) for layer in noise])
    return np.where(noise.max(axis=0) > np.quantile(noise.max(axis=0), 0.4), noise.argmax(axis=0) + 1, 0).astype(np.uint8)


def ellipses(rng: np.random.Generator, scale: float) -> np.ndarray:
    """Instance 0 is a union of ellipses, partly covered by one of instance 1."""
    image = draw()
    for code in (1, 1, 1, 2):
        middle = rng.integers((8, 8), (WIDTH - 8, HEIGHT - 8))
        cv2.ellipse(image, middle.tolist(), rng.integers(3, 16, 2).tolist(), float(rng.uniform(0, 180)), 0, 360, code, -1)
    return image


@given(
    seed=st.integers(0, 2**32 - 1),
    picture=st.sampled_from([noise_and_patches, blobs, ellipses]),
    scale=st.sampled_from([0.0, 1.5, 3.0, 8.0]),
    mass=st.sampled_from([0.1, 1.0]),
)
def test_random_images_are_segmented_as_by_the_reference(seed, picture, scale, mass, shared):
    """On a harness that has seen other images before."""
    rng = np.random.default_rng(seed)
    shared.mass[:], shared.area[:] = mass, 0.01
    check(shared, picture(rng, scale), rng.uniform(0.5, 3.0, (HEIGHT, WIDTH)).astype(np.float32))


def test_many_instances_are_segmented_as_by_the_reference(device):
    width, height = 240, 160
    harness = SegmenterHarness(device, width, height, instances=MAX_INSTANCES)
    ids = mosaic(MAX_INSTANCES, width, height, 1)
    ids[:20, :40][ids[:20, :40] >= 0] = MAX_INSTANCES - 1
    check(harness, (ids + 1).astype(np.uint8))
    assert (harness.image("largest") >= 0).sum() > 200
    assert not harness.observation.overflow.numpy().any()


# ---- components ----


@pytest.mark.parametrize(
    ("parts", "largest", "visible"),
    [
        pytest.param([(1, np.s_[2:5, 3:7]), (1, np.s_[10:15, 20:70])], {0: (10, 20)}, {0: 250}, id="the larger of two"),
        pytest.param([(3, np.s_[20, 1:4]), (3, np.s_[4:7, 60])], {2: (4, 60)}, {2: 3}, id="ties go to the smallest label"),
        pytest.param([(2, (5, int(STRIP) - 1)), (2, (6, int(STRIP)))], {1: (5, int(STRIP) - 1)}, {1: 2}, id="a corner between strips"),
        pytest.param([(2, (5, int(STRIP))), (2, (6, int(STRIP) - 1))], {1: (5, int(STRIP))}, {1: 2}, id="the other corner between strips"),
        pytest.param([(2, (5, 40)), (2, (6, 41))], {1: (5, 40)}, {1: 2}, id="a corner"),
        pytest.param([(2, (5, 40)), (2, (6, 39))], {1: (5, 40)}, {1: 2}, id="the other corner"),
        pytest.param([(1, np.s_[:, :37]), (2, np.s_[:, 37:])], {0: (0, 0), 1: (0, 37)}, {0: 37 * HEIGHT, 1: 38 * HEIGHT}, id="touching"),
        pytest.param([(Segment.TOTE, np.s_[:8]), (Segment.TABLE, np.s_[8:16]), (5, np.s_[16:])], {}, {}, id="no instances"),
        pytest.param([(1, np.s_[5:10, 5:10]), (1, np.s_[20:30, 20:30])], {0: (20, 20)}, {0: 100}, id="the smaller has no distance"),
    ],
)
def test_known_components(harness, parts, largest, visible):
    """First pixel and size of each instance's largest component."""
    check(harness, draw(*parts))
    labels = {instance: row * WIDTH + column for instance, (row, column) in largest.items()}
    assert harness.image("largest").tolist() == [labels.get(instance, -1) for instance in range(INSTANCES)]
    assert [harness.result("visible", i) for i in range(INSTANCES)] == [visible.get(i, 0) for i in range(INSTANCES)]


def test_a_spiral_is_one_component(harness):
    """Its arms meet late, so labels must propagate through many rows and strips."""
    segments = draw()
    top, left, bottom, right = 0, 0, HEIGHT - 1, WIDTH - 1
    while top < bottom and left < right:
        segments[top, left : right + 1], segments[top : bottom + 1, right] = 1, 1
        segments[bottom, left + 2 : right + 1], segments[top + 2 : bottom + 1, left + 2] = 1, 1
        top, left, bottom, right = top + 2, left + 2, bottom - 2, right - 2
    check(harness, segments)
    assert set(np.unique(harness.image("component"))) == {-1, 0}


def test_results_go_to_the_world_of_each_view_and_unused_views_write_nothing(harness):
    segments, other = draw((1, np.s_[3:9, 3:9])), draw((1, np.s_[12:15, 3:9]))
    harness.observe(segments, segments)
    before = harness.image("component", 1)
    harness.observe(other, np.full_like(segments, 2), worlds=[1])
    assert [harness.result("visible", 0, world) for world in range(2)] == [36, 18]
    assert harness.result("visible", 1, world=0) == 0
    assert (harness.image("component", 1) == before).all()
    assert (harness.image("largest", 1) == -1).all()
    assert (harness.image("contour_length", 1) == 0).all()


def test_a_batch_without_worlds_writes_nothing(device):
    harness = SegmenterHarness(device, WIDTH, HEIGHT, worlds=2)
    harness.observe(worlds=[])
    assert (harness.observation.grasp_pixel.numpy() == 0).all()


# ---- contours and distances ----


def test_the_contour_and_the_distances_of_a_rectangle(harness):
    check(harness, draw((1, np.s_[4:7, 10:15])))
    around = [(10, 4), (10, 5), (10, 6), (11, 6), (12, 6), (13, 6), (14, 6), (14, 5), (14, 4), (13, 4), (12, 4), (11, 4)]
    assert [tuple(point) for point in harness.contour()] == around
    assert harness.result("centroid").tolist() == [12.0, 5.0]
    assert (harness.image("distance")[4:7, 10:15] == [[1, 1, 1, 1, 1], [1, 2, 2, 2, 1], [1, 1, 1, 1, 1]]).all()


@pytest.mark.parametrize("steps", [np.arange(5), np.arange(1)], ids=["line", "pixel"])
@pytest.mark.parametrize(("row", "column"), [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_a_line_is_traversed_in_both_directions(harness, steps, row, column):
    check(harness, draw((1, (8 + row * steps, 20 + column * steps))))
    points, last = harness.contour(), len(steps) - 1
    assert len(points) == max(1, 2 * last)
    assert (points[: last + 1] == np.stack([20 + column * steps, 8 + row * steps], axis=1)).all()
    # The ends count once and all other points twice; the mean is still the centre.
    assert harness.result("centroid").tolist() == [20.0 + column * last / 2, 8.0 + row * last / 2]
    assert harness.image("distance").max() == 1.0


def test_a_hole_changes_the_distance_and_not_the_centroid(harness):
    whole, hole = (1, np.s_[5:26, 10:31]), (0, np.s_[13:16, 16:19])
    for parts, expected in (((whole,), 6.0), ((whole, hole), 1.0)):
        check(harness, draw(*parts))
        assert harness.result("centroid").tolist() == [20.0, 15.0]
        assert len(harness.contour()) == 80
        assert harness.image("distance")[15, 15] == expected
    assert harness.image("distance")[14, 17] == 0.0
    assert harness.image("distance")[17, 15] == pytest.approx(np.sqrt(5.0), rel=1e-6)


def test_pixels_beyond_the_border_and_of_touching_instances_are_outside(harness):
    check(harness, draw((2, np.s_[:])))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    assert (harness.image("distance") == np.minimum.reduce([rows + 1, HEIGHT - rows, columns + 1, WIDTH - columns])).all()
    assert len(harness.contour(1)) == 2 * (WIDTH + HEIGHT) - 4
    check(harness, draw((1, np.s_[6:20, :20]), (2, np.s_[6:20, 20:])))
    assert harness.image("distance")[12, 17:22].tolist() == [3.0, 2.0, 1.0, 1.0, 2.0]
    assert [harness.contour(0)[:, 0].max(), harness.contour(1)[:, 0].min()] == [19, 20]


def test_a_contour_beyond_the_capacity_is_truncated_and_flagged(device):
    short = SegmenterHarness(device, WIDTH, HEIGHT, worlds=2, instances=2, contour_points=16)
    small, large = draw((2, np.s_[4:9, 4:9])), draw((2, np.s_[4:9, 4:10]), (1, np.s_[20:29, 20:29]))
    short.observe(small, large)
    assert short.observation.overflow.numpy().tolist() == [0, 1]
    assert len(short.contour(1, view=0)) == 16
    expected = perception.contour(large == 2)
    assert len(expected) == 18
    assert (short.contour(1, view=1) == expected[:16]).all()
    # The next observation clears the flag.
    short.observe(small, worlds=[1])
    assert short.observation.overflow.numpy().tolist() == [0, 0]


# ---- grasp points and visible areas ----

TAIL = [(1, np.s_[4:25, 4:25]), (1, np.s_[12:17, 25:63])]
"""A large square with a thin tail that shifts the centroid."""


@pytest.mark.parametrize(
    ("parts", "mass", "expected"),
    [
        pytest.param(
            [(1, np.s_[10:31, 20:41])],
            0.1,
            {"pole": [30, 20], "centroid": [30, 20], "midpoint": [30, 20], "distances": [11, 11, 11], "grasp_pixel": [30, 20]},
            id="a square at its centre",
        ),
        pytest.param(
            [(1, np.s_[10:21, 5:46])],
            0.1,
            {"pole": [10, 15], "centroid": [25, 15], "distances": [6, 6, 6], "grasp_pixel": [25, 15]},
            id="of a bar's row of poles the first is kept, and the centroid is preferred",
        ),
        pytest.param(
            [(1, np.s_[4:44, 4:13]), (1, np.s_[39:44, 4:60])],
            0.1,
            {"pole": [8, 8], "distances": [5, 0, 0], "grasp_pixel": [8, 8]},
            id="an L at its pole, as its centroid and the midpoint lie outside",
        ),
        pytest.param(TAIL, 0.1, {"pole": [14, 14], "grasp_pixel": [14, 14]}, id="a light tail at its pole"),
        pytest.param(TAIL, 0.8, {"pole": [14, 14], "grasp_pixel": [14, 14]}, id="a tail at the limit of mass"),
        pytest.param(TAIL, 0.9, {"pole": [14, 14], "grasp_pixel": [18, 14]}, id="a heavy tail at the midpoint"),
        pytest.param(
            [(1, np.s_[4:45, 10:51]), (0, np.s_[22:27, 28:33])], 0.1, {"centroid": [30, 24]}, id="a hole moves the pole off the centroid"
        ),
    ],
)
def test_known_grasp_points(harness, parts, mass, expected):
    harness.mass[0] = mass
    check(harness, draw(*parts))
    assert {name: harness.result(name).tolist() for name in expected} == expected


def test_visible_fraction_of_a_sheet_is_its_area_over_the_expected_area(harness):
    """Half of the expected area is visible, at a distance of 1.5 m."""
    fx, fy = harness.focal
    harness.area[0] = 2.0 * (30 * 1.5 / fx) * (20 * 1.5 / fy)
    harness.observe(draw((1, np.s_[8:28, 10:40])), depth=1.5)
    assert harness.result("visible_fraction") == pytest.approx(0.5, rel=1e-5)
    assert harness.result("depth") == 1.5


# ---- images ----

RESOLUTION = (96, 54)


@pytest.fixture
def toy() -> ToyScene:
    """Two worlds with boxes and balls in a tote, and a hidden gripper in front of them."""
    config = Config()
    config = replace(config, cameras=replace(config.cameras, resolution=RESOLUTION))
    tote = Fixture(box(0.5, 0.3, 0.02), GREY)
    first = [(0, (0.05, 0.02, 0.06, 0.1, 0.2, 0.0, 0.97)), (1, (-0.08, 0.03, 0.05, *UPRIGHT))]
    second = [(1, (0.0, 0.0, 0.05, *UPRIGHT)), (0, (0.04, 0.0, 0.1, *UPRIGHT)), (0, (-0.1, -0.05, 0.05, *UPRIGHT))]
    gripper = (Fixture(box(0.1, 0.1, 0.3), GREY), Fixture(box(0.04, 0.04, 0.05), GREY))
    poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.4, *UPRIGHT), (0.0, 0.0, 0.2, *UPRIGHT))
    return ToyScene(
        [entry(box(0.1, 0.06, 0.04)), entry(ball(0.04, 3))],
        [first, second],
        make_cameras(config.rig)[:1],
        fixtures=(tote, *gripper),
        fixture_poses=poses,
        fixtures_visible=(1, 0, 0),
        config=config,
        table=True,
    )


def make_images(toy: ToyScene, device: wp.Device, worlds: int = 4, views: int = 3) -> PerceptionImages:
    """Perception of the toy scene, whose other cameras have another resolution."""
    config = toy.settings()
    rig = Rig.of(replace(config.cameras, resolution=(192, 108)))
    settings = replace(config.perception, resolution=RESOLUTION, views=views)
    catalog = Catalog(tuple(toy.entries))
    scene = build_render_scene(config.render, -config.tote.wall, catalog, toy.fixtures, make_cameras(rig), toy.lights, device)
    return PerceptionImages(settings, rig, scene, worlds, toy.instances)


def test_gbuffer_equals_the_renderers_without_gripper(device, toy):
    expected = render(toy, device)
    assert set(np.unique(expected.instance)) == {1, 2, 3, Segment.TOTE, Segment.TABLE}
    made = make_images(toy, device)
    assert made.views.world.numpy().tolist() == [-1] * 3
    made.views.world.assign([1, -1, 0])
    made.gbuffer.segment.fill_(77)
    toy.fixtures_visible = (1, 1, 1)
    made.render(snapshot(toy, device))
    segment, depth = made.gbuffer.segment.numpy(), made.gbuffer.depth.numpy()
    for view, world in ((0, 1), (2, 0)):
        assert (segment[view] == expected.instance[world]).all()
        # Perception computes depths with the arithmetic of mesh queries, the renderer with that of the rasterizer.
        np.testing.assert_allclose(depth[view], expected.exact_depth[world], rtol=1e-6)
    assert (segment[1] == 77).all()
    assert made.views.camera.numpy().tolist() == [0, -1, 0]


@pytest.mark.parametrize("displacement", [0.0, 0.03])
def test_rasterized_hits_equal_traced_hits_pixel_by_pixel(device, toy, displacement):
    """The rasterizer and rays through BVHs agree, with the static background and, if the tote is displaced, without."""
    made = make_images(toy, device)
    state = snapshot(toy, device)
    tote = state.fixture_pose.numpy()
    tote[:, 0, 0] += displacement
    state.fixture_pose.assign(tote)
    made.views.world.assign([1, -1, 0])
    made.render(state)
    names = ("segment", "triangle", "barycentric", "depth")
    rasterized = {name: getattr(made.gbuffer, name).numpy().copy() for name in names}
    trace_gbuffer(made.scene, made.bodies, made.views, made.gbuffer, 3)
    traced = {name: getattr(made.gbuffer, name).numpy() for name in names}
    assert made.bodies.uses_background.numpy()[[0, 2]].tolist() == [int(displacement == 0.0)] * 2
    ours, expected = ({name: values[[0, 2]] for name, values in hits.items()} for hits in (rasterized, traced))
    assert (ours["segment"] == expected["segment"]).all()
    np.testing.assert_allclose(ours["depth"], expected["depth"], rtol=1e-6)
    has_triangle = ~np.isin(expected["segment"], (Segment.NOTHING, Segment.TABLE))
    assert has_triangle.any(axis=(1, 2)).all()
    # A ray through an edge may hit either of its triangles.
    same = has_triangle & (ours["triangle"] == expected["triangle"])
    assert same.sum() > 0.97 * has_triangle.sum()
    for name in ("depth", "barycentric"):
        if device.is_cpu:
            assert (ours[name][same] == expected[name][same]).all()
        else:
            # Compilers may contract products and sums differently in the two kernels.
            np.testing.assert_allclose(ours[name][same], expected[name][same], atol=1e-4)


def test_number_of_views():
    config = Config()
    cpu, cuda = SimpleNamespace(is_cuda=False), SimpleNamespace(is_cuda=True)
    assert images.count_views(config.perception, 64, 21, cpu) == images.CPU_VIEWS
    each = images.view_bytes(config.perception, 21)
    assert 1920 * 1080 * 38 < each < 1920 * 1080 * 48
    views = images.count_views(config.perception, 64, 21, cuda)
    assert views * each <= images.GPU_BYTES < (views + 1) * each
    asked = replace(config.perception, views=7)
    assert images.count_views(asked, 64, 21, cpu) == 7
    assert images.count_views(config.perception, 2, 21, cuda) == 2
    vast = replace(config.perception, resolution=(8192, 8192))
    assert images.count_views(vast, 64, 21, cpu) == 1


def test_more_pixels_than_31_bits_count_are_an_error(device, toy):
    settings = replace(Config().perception, resolution=(8192, 8192), views=32)
    scene = build_scene(toy, device)
    with pytest.raises(ConfigError, match=r"perception\.views is 32"):
        PerceptionImages(settings, Config().rig, scene, 32, toy.instances)
