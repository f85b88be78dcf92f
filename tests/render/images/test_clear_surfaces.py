"""Depth sensors on transparent bodies: shares of holes, of the surface and of what is behind; patches; infrared images; and what stays as
it was."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.schema import FAST, REFERENCE
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Glass
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, allocate_view_buffers
from tests.render.images.test_depth_sensor import COUNT, PERFECT, TOP, VIEW, measure
from tests.render.images.test_stereo import NOISY, QUIET, see
from tests.worlds.shapes import UPRIGHT, entry, sheet, surface
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot, views_of

NEAR, FAR = 1.0, 1.08
"""Depth of a pane over the whole image, and of a wall behind it [m]."""
COAT = 0.04
"""Reflectance of the coat at normal incidence."""


def pane(transmission: float, worlds: int = 1, thickness: float = 0.0, **more) -> ToyScene:
    glass = replace(surface(roughness=0.1), glass=Glass(transmission, 1.5, thickness))
    placed = [(0, (0.0, 0.0, TOP - NEAR, *UPRIGHT)), (1, (0.0, 0.0, TOP - FAR, *UPRIGHT))]
    return ToyScene([entry(sheet(0.6, 0.4), glass), entry(sheet(4.0, 4.0))], [placed] * worlds, (VIEW,), **more)


def parts(depth: np.ndarray, behind: float = FAR) -> tuple[float, float, float]:
    """Shares of holes, of what is behind, and of the surface; nothing else is measured."""
    hole, back, front = np.isnan(depth), np.abs(depth - behind) < 2.0 * COUNT, np.abs(depth - NEAR) < 2.0 * COUNT
    assert (hole | back | front).all()
    return float(hole.mean()), float(back.mean()), float(front.mean())


@pytest.mark.parametrize(("transmission", "reach"), [(1.0, 0.1), (0.8, 0.1), (0.8, 0.03), (0.4, 1e3), (1.0, 1e3)])
def test_shares_follow_the_law(device, transmission, reach):
    hole, back, front = parts(measure(pane(transmission, worlds=24), device, **PERFECT, clear_reach=reach).depth)
    passing = transmission * (1.0 - COAT)
    own = (1.0 - passing) / (1.0 - passing + passing**2)
    seen = np.exp((NEAR - FAR) / reach)
    # Some 5,000 patches.
    np.testing.assert_allclose((hole, back, front), ((1.0 - own) * (1.0 - seen), (1.0 - own) * seen, own), atol=0.025)


def test_thick_bodies_lift_what_is_behind(device):
    """A slab by t (1 - 1 / n), as any observer sees who looks straight at it."""
    hole, back, front = parts(measure(pane(1.0, thickness=0.03), device, **PERFECT, clear_reach=1e3).depth, behind=FAR - 0.01)
    assert hole == 0.0
    assert back > 0.9 > front > 0.0


def test_what_is_opaque_has_the_bits_of_scenes_without_glass(device):
    """As does any transmission with a reach of 0; truth always has them."""
    opaque = measure(pane(0.0), device)
    drawn = Looks(Randomize(object_transmission=Distribution("fixed", ((0.0,),))), (), ())
    np.testing.assert_array_equal(measure(pane(0.9, looks=drawn), device).counts, opaque.counts)
    np.testing.assert_array_equal(measure(pane(0.9), device, clear_reach=0.0).counts, opaque.counts)
    clear = measure(pane(0.9), device)
    np.testing.assert_array_equal(clear.exact, opaque.exact)
    np.testing.assert_array_equal(clear.clean, opaque.clean)
    assert (clear.counts != opaque.counts).mean() > 0.5


def test_patches_stay_on_their_bodies_and_differ_between_episodes_and_cameras(device):
    toy = pane(1.0, worlds=2)
    toy.cameras = (VIEW, VIEW)
    holes = measure(toy, device, frames=2, **PERFECT).counts == 0
    np.testing.assert_array_equal(holes[:4], holes[4:])
    assert len({view.tobytes() for view in holes[:4]}) == 4
    # 1 cm to the right, 4 px.
    moved = pane(1.0)
    moved.placed = [[(0, (0.01, 0.0, TOP - NEAR, *UPRIGHT)), moved.placed[0][1]]]
    assert ((measure(moved, device, **PERFECT).counts == 0)[0, :, 4:] != holes[0, :, :-4]).mean() < 0.01
    # Neighbours 2 px, 5 mm, apart correlate; those 20 px apart do not.
    off = holes[0] - holes[0].mean()
    correlation = [(off[:, away:] * off[:, :-away]).mean() / off.var() for away in (2, 20)]
    assert correlation[0] > 0.55
    assert abs(correlation[1]) < 0.25


def test_episodes_have_the_same_bytes_in_any_number_of_worlds(device):
    three = measure(pane(0.9, worlds=3), device)
    for world in range(3):
        np.testing.assert_array_equal(measure(pane(0.9), device, first_episode=world).counts[0], three.counts[world])


@pytest.mark.parametrize("mode", [FAST, REFERENCE])
def test_colours_beside_it_change_nothing(device, mode):
    toy = pane(0.9)
    config = toy.config.with_values({"render.layers": ("depth_sensor",), "render.mode": mode, "render.samples": 1})
    toy.config, counts = config, []
    for colors in (False, True):
        renderer = make_renderer(toy.settings(), build_scene(toy, device), toy.instances, 1, colors=colors)
        sizes = {"view": 1, "row": VIEW.resolution[1], "column": VIEW.resolution[0]}
        layers = allocate(LayerBuffers, sizes, device, ("depth_sensor",))
        views = views_of(toy, device)
        renderer.render(snapshot(toy, device), views, allocate_view_buffers(1, *VIEW.resolution, toy.instances, device), layers)
        counts.append(layers.depth_sensor.numpy())
    np.testing.assert_array_equal(*counts)


def test_infrared_images_show_what_is_behind(device):
    """Clear glass vanishes before a white wall in even light; dots pass it twice, beside what the coat turns back."""
    wall, clear = (replace(pane(share), entries=[*pane(share).entries[:1], entry(sheet(4.0, 4.0), surface())]) for share in (0.0, 1.0))
    wall.placed = [wall.placed[0][1:]]
    wall.entries = [wall.entries[1], wall.entries[1]]
    for settings in (QUIET | {"dot_brightness": 0.0}, QUIET | {"ambient": 0.0, "dot_brightness": 0.9, "projector": 0.0}):
        images = [see(toy, device, **settings) for toy in (wall, clear)]
        factor = 1.0 if settings["dot_brightness"] == 0.0 else (1.0 - COAT) ** 2
        for eye in ("left", "right"):
            one, other = (getattr(image, eye).astype(float) for image in images)
            # The coat adds the projector's glare in the middle.
            assert (other - factor * one).min() > -3.0
            assert (other - factor * one > 3.0).mean() < 0.2


@pytest.mark.parametrize(("transmission", "depth"), [(0.0, NEAR), (1.0, FAR)])
def test_stereo_matches_what_is_behind_clear_glass(device, transmission, depth):
    seen = see(pane(transmission), device, **NOISY | {"projector": 0.5}).stereo[0, 10:-10, 60:-10]
    assert np.isfinite(seen).mean() > 0.8
    assert abs(np.nanmedian(seen) - depth) < 0.01
