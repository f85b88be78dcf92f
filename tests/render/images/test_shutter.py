"""Motion blur and rolling shutter: edges of bodies that move at a known speed, cameras that move, and what stays as it was."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.types import Glass
from synpick_warp.stages.buffers import allocate_view_buffers
from synpick_warp.stages.render.cameras import allocate_view_cameras, place_cameras
from synpick_warp.stages.render.postprocess import plan_sub_frames
from tests.worlds.shapes import UPRIGHT, box, camera, distorted, entry, sheet, surface
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot, views_of, with_render

TICK = Config().physics.tick_time
WIDTH, HEIGHT, FOCAL, TOP = 64, 24, 64.0, 1.0
VIEW = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, TOP))
BENT = distorted(VIEW, -0.1, 0.05, 0.0, 0.0)
SPEED = 16.0
"""Image-space displacement per frame [px] of a point at depth `TOP`."""
STEP = SPEED * TOP / FOCAL
"""The same [m]."""
SAMPLES = 32


def scene(mode: str = UNOCCLUDED, worlds: int = 1, view=VIEW, sub_frames: int = SAMPLES, **settings) -> ToyScene:
    """A white sheet, whose right edge is in the middle of the image, over a black one."""
    entries = [entry(sheet(3.0, 2.0), surface()), entry(sheet(9.0, 9.0), surface((0.0, 0.0, 0.0)))]
    placed = [(0, (-1.5, 0.0, 0.0, *UPRIGHT)), (1, (0.0, 0.0, -0.001, *UPRIGHT))]
    config = with_render(mode, shutter_samples=sub_frames, **settings)
    return ToyScene(entries, [placed] * worlds, (view,), config=config)


def expose(toy: ToyScene, device, shutter, step=(STEP, 0.0, 0.0), worlds=(0,), carried=None, histories=0, frames=1):
    """Colour images and radiance of views, in which instance 0 of `worlds` moved by a step; `carried`: the camera's step [m]."""
    render_scene, views = build_scene(toy, device), views_of(toy, device)
    times = tuple(share * TICK for share in shutter)
    renderer = make_renderer(toy.settings(), render_scene, toy.instances, views.count, times, histories=histories)
    out = allocate_view_buffers(views.count, render_scene.width, render_scene.height, toy.instances, device)
    world = snapshot(toy, device)
    last = world.pose.numpy().copy()
    last[list(worlds), 0, :3] -= step
    world.last_pose.assign(last)
    for name in ("catalog_index", "fixture_pose", "fixture_visible"):
        getattr(world, f"last_{name}").assign(getattr(world, name))
    world.follows.fill_(1)
    placed = None
    if carried is not None:
        one = toy.cameras[0]
        placed = tuple(allocate_view_cameras(views.count, device, render_scene.cameras) for _ in range(2))
        for made, moved in zip(placed, (0.0, 1.0), strict=True):
            poses = {"matrix": one.matrix, "rotation": one.rotation, "translation": one.translation + moved * one.rotation @ carried}
            place_cameras(made, render_scene.cameras, np.zeros(views.count, np.int32), {key: each[None] for key, each in poses.items()})
    for frame in range(frames):
        world.frame.fill_(frame)
        renderer.render(world, views, out, placed=placed)
    return out, renderer.image.radiance.numpy()


def ramp(width: float, middle: np.ndarray | float = WIDTH / 2) -> np.ndarray:
    """Share of light in columns at a white surface's right edge, blurred over a width [px] about its middle."""
    edges = np.arange(WIDTH + 1) - np.reshape(middle, (-1, 1))
    # Antiderivative of the ramp from 1 to 0 over the width.
    inside = np.clip(edges, -width / 2, width / 2)
    area = np.minimum(edges, -width / 2) + inside / 2 - inside**2 / (2 * width) + width / 2 + width / 8
    return np.diff(area)


def share_of(radiance: np.ndarray) -> np.ndarray:
    """Share of the white surface's light in each pixel (row, column); the black one has the light of its coat."""
    white, black = radiance[0, HEIGHT // 2, 0, 0], radiance[0, HEIGHT // 2, -1, 0]
    return (radiance[0, ..., 0] - black) / (white - black)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_edges_of_moving_bodies_are_ramps_of_their_motion(device, share):
    _, sharp = expose(scene(), device, (0.0, 0.0))
    _, blurred = expose(scene(), device, (share, 0.0))
    np.testing.assert_allclose(share_of(blurred), np.broadcast_to(ramp(share * SPEED), (HEIGHT, WIDTH)), atol=1.0 / SAMPLES)
    # Coverage rays find an edge to a quarter of a pixel.
    np.testing.assert_allclose(share_of(blurred).mean(), share_of(sharp).mean(), atol=0.25 / WIDTH)


@pytest.mark.parametrize("exposure", [0.0, 0.2])
def test_rows_of_a_rolling_shutter_follow_one_another(device, exposure):
    """The first row is exposed first, when the edge was farther to the left; the middle one at the instant of the frame."""
    readout = 0.8
    _, rolled = expose(scene(), device, (exposure, readout))
    middle = WIDTH / 2 + readout * SPEED * np.linspace(-0.5, 0.5, HEIGHT)
    width = max(exposure, readout / (SAMPLES - 1)) * SPEED
    np.testing.assert_allclose(share_of(rolled), ramp(width, middle), atol=0.6 * SPEED * readout / SAMPLES)


def test_weights_of_each_row_sum_to_one():
    for exposure, readout, count, rows in ((0.3, 0.0, 8, 5), (0.0, 0.5, 2, 480), (0.1, 0.9, 7, 1), (0.5, 0.5, 8, 33)):
        times, weights = plan_sub_frames(exposure, readout, count, rows)
        np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-6)
        np.testing.assert_allclose(times + times[::-1], 0.0, atol=1e-12)
        np.testing.assert_allclose(
            (weights * times[:, None]).sum(axis=0), readout * (np.linspace(-0.5, 0.5, rows) if rows > 1 else 0.0), atol=1e-6
        )


@pytest.mark.parametrize("view", [VIEW, BENT])
def test_pictures_of_moving_cameras_are_blurred_whole(device, view):
    """A camera's step to the right moves the picture to the left."""
    toy = scene(view=view)
    _, moved = expose(toy, device, (0.5, 0.0), carried=np.array([STEP, 0.0, 0.0]), step=(0.0, 0.0, 0.0))
    _, other = expose(toy, device, (0.5, 0.0), step=(-STEP, 0.0, 0.0))
    np.testing.assert_allclose(moved, other, atol=1e-3)
    _, none = expose(toy, device, (0.5, 0.0), carried=np.array([STEP, 0.0, 0.0]), step=(STEP, 0.0, 0.0))
    _, sharp = expose(toy, device, (0.0, 0.0), carried=np.array([STEP, 0.0, 0.0]))
    np.testing.assert_allclose(none[:, :, : WIDTH - 4], sharp[:, :, : WIDTH - 4], atol=1e-3)


@pytest.mark.parametrize(
    ("mode", "kind"), [(FAST, "plain"), (FAST, "glass"), (UNOCCLUDED, "bent"), (REFERENCE, "plain"), (REFERENCE, "glass")]
)
def test_views_in_which_nothing_moves_have_the_bytes_of_an_instant(device, mode, kind):
    """Others of the batch do not change them, and the truth stays."""
    toy = scene(mode, 3, BENT if kind == "bent" else VIEW, 2, history=8, samples=4)
    if kind == "glass":
        pane = replace(surface(roughness=0.1), glass=Glass(0.8, 1.5, 0.0))
        toy = replace(toy, entries=[entry(sheet(3.0, 2.0), pane), *toy.entries[1:]])
    given = {"histories": 3, "frames": 2}
    plain, _ = expose(toy, device, (0.0, 0.0), worlds=(1,), **given)
    blurred, _ = expose(toy, device, (0.5, 0.2), worlds=(1,), **given)
    alone, _ = expose(replace(toy, placed=toy.placed[:1]), device, (0.5, 0.2), histories=1, frames=2)
    np.testing.assert_array_equal(blurred.color.numpy()[[0, 2]], plain.color.numpy()[[0, 2]])
    np.testing.assert_array_equal(blurred.color.numpy()[1], alone.color.numpy()[0])
    assert (blurred.color.numpy()[1] != plain.color.numpy()[1]).any()
    for name in ("depth", "instance", "boxes", "pixels", "mask_words"):
        np.testing.assert_array_equal(getattr(blurred, name).numpy(), getattr(plain, name).numpy())


def test_first_frames_rest(device):
    toy = scene()
    render_scene, views = build_scene(toy, device), views_of(toy, device)
    shown = []
    for shutter in ((0.0, 0.0), (0.5 * TICK, 0.0)):
        renderer = make_renderer(toy.settings(), render_scene, toy.instances, 1, shutter=shutter)
        out = allocate_view_buffers(1, WIDTH, HEIGHT, toy.instances, device)
        renderer.render(snapshot(toy, device), views, out)
        shown.append(out.color.numpy())
    np.testing.assert_array_equal(*shown)


def test_turning_bodies_turn_about_their_origin(device):
    """Coverage of a black square that rotates by 45 degrees during the exposure, in front of a white background."""
    entries = [entry(box(0.2, 0.2, 0.01), surface((0.0, 0.0, 0.0)))]
    turned = (0.0, 0.0, 0.0, 0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8))
    toy = ToyScene(entries, [[(0, turned)]], (camera(48, 48, 128.0, (0.0, 0.0, TOP)),), config=with_render(UNOCCLUDED, shutter_samples=16))
    render_scene, views = build_scene(toy, device), views_of(toy, device)
    renderer = make_renderer(toy.settings(), render_scene, toy.instances, 1, shutter=(TICK, 0.0))
    out, world = allocate_view_buffers(1, 48, 48, toy.instances, device), snapshot(toy, device)
    last = world.pose.numpy().copy()
    last[0, 0] = (0.0, 0.0, 0.0, *UPRIGHT)
    world.last_pose.assign(last)
    world.last_catalog_index.assign(world.catalog_index)
    world.follows.fill_(1)
    renderer.render(world, views, out)
    # At mid-exposure a corner points upward, so the image is mirror-symmetric.
    light = renderer.image.radiance.numpy()[0, ..., 0]
    share = (light - light[0, 0]) / (light[24, 24] - light[0, 0])
    np.testing.assert_allclose(share, share[:, ::-1], atol=0.1)
    side, place = 128.0 * 0.1 / 0.995, 24 - 8.5  # Half the side, and a pixel's distance from the centre [px].
    passing = 2 * (45.0 - np.degrees(np.arccos(side / place))) / 45.0
    np.testing.assert_allclose(share[8, 23:25], passing, atol=1 / 16)
    assert abs(share[13, 34]) < 0.06  # As far from the centre, to the upper right, where no corner passes.
