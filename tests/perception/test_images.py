"""Perception images: G-buffers of camera 0 without the gripper, and the number of views of a batch."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Catalog, Fixture
from synpick_warp.stages.perception import images
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.render.scene import build_render_scene
from tests.harness.trace_probe import trace_gbuffer
from tests.worlds.shapes import GREY, UPRIGHT, ball, box, entry
from tests.worlds.toy_scene import ToyScene, build_scene, render, snapshot

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
