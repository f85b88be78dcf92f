"""Multipath interference of depth sensors: closed-form depth error in a right-angled groove, holes, and scenes without an error."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.scenes.types import Finish, Material
from synpick_warp.stages.render.light_tables import measure_albedo
from tests.harness.brdf_probe import evaluate
from tests.render.images.test_depth_sensor import COUNT, FOCAL, HEIGHT, PERFECT, TOP, VIEW, WIDTH, measure
from tests.worlds.shapes import GREY, UPRIGHT, WHITE, entry, sheet, surface
from tests.worlds.toy_scene import ToyScene

SIDE, DEPTH = 0.6, 1.2
"""Side length of the two square sheets that form a groove, and distance of their common edge from the camera [m]."""
METAL, DULL = surface(WHITE, 1.0, 0.6), surface(WHITE, 0.0, 1.0)
"""Materials; white metal has a specular albedo of 1."""
SEEN = slice(None), slice(8, 76)
"""Rows and columns of the left sheet whose mirror rays hit the right sheet."""


def groove(left: Material, right: Material, worlds: int = 1, bend: float = 1.0) -> ToyScene:
    """Scene of two sheets at a right angle with the common edge on the optical axis: a groove, or with `bend` -1 a ridge."""
    turn, half = bend * np.pi / 8.0, SIDE / 8**0.5
    rest, sides = (0.0, TOP - DEPTH + bend * half, 0.0), enumerate((-1.0, 1.0))
    placed = [(side, (sign * half, *rest, -sign * np.sin(turn), 0.0, np.cos(turn))) for side, sign in sides]
    return ToyScene([entry(sheet(SIDE, SIDE), one) for one in (left, right)], [placed] * worlds, (VIEW,))


def predict(left: Material, right: Material, share: float, device) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """NumPy twin of the kernel: depth of the left sheet [m], weight of the indirect path, and its extra depth [m]. The right
    plane, perpendicular to the left one, is its own mirror image, so the unreflected ray hits it at the distance |cp| + |pq|."""
    row, column = np.mgrid[:HEIGHT, :WIDTH][(slice(None), *SEEN)]
    ray = np.stack([(column + 0.5 - WIDTH / 2) / FOCAL, (HEIGHT / 2 - row - 0.5) / FOCAL, -np.ones(row.shape)], -1)
    normal, other = np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]) / 2**0.5
    eye = np.array([0.0, 0.0, DEPTH])
    first, image = ((-(eye @ n) / (ray @ n))[..., None] * ray for n in (normal, other))
    second = image - 2.0 * ((eye + image) @ normal)[..., None] * normal
    there, both, back = (np.linalg.norm(way, axis=-1) for way in (first, image, second))

    def returned(material: Material, face: np.ndarray, outgoing: np.ndarray, way: np.ndarray) -> np.ndarray:
        frame = np.stack([np.cross([0.0, 1.0, 0.0], face), [0.0, 1.0, 0.0], face], -1)
        given, reach = (material.color, material.metallic, material.roughness), np.linalg.norm(way, axis=-1, keepdims=True)
        return evaluate(measure_albedo(device), given, outgoing @ frame, -way / reach @ frame)[0][..., 0] / reach[..., 0] ** 2

    direct = returned(left, normal, -first / there[..., None], first)
    indirect = share * returned(right, other, (first - second) / (both - there)[..., None], second)
    return -first[..., 2], indirect / (direct + indirect), ((both + back) / 2.0 - there) * -first[..., 2] / there


@pytest.mark.parametrize(("right", "share", "hole"), [(DULL, 0.05, False), (DULL, 0.1, False), (METAL, 0.03, False), (DULL, 1.0, True)])
def test_a_metal_groove_deepens_as_the_twin_predicts(device, right, share, hole):
    measured = measure(groove(METAL, right), device, **PERFECT, multipath=share)
    depth, weight, extra = predict(METAL, right, share, device)
    assert ((weight > 0.5) == hole).all()
    assert (weight * extra).max() > 0.02
    np.testing.assert_allclose(measured.depth[0][SEEN], np.where(hole, np.nan, depth + weight * extra), atol=3.0 * COUNT)
    # Ground truth is unaffected.
    np.testing.assert_allclose(measured.exact[0][SEEN], depth, atol=1e-5)
    np.testing.assert_allclose(measured.clean[0] * COUNT, measured.exact[0], atol=0.51 * COUNT)


def test_noise_is_that_without_multipath(device):
    noisy = PERFECT | {"noise": 0.002, "noise_angle": 1e-4, "noise_width": 3}
    biased, plain = (measure(groove(METAL, DULL), device, **noisy, multipath=share).depth[0][SEEN] for share in (0.1, 0.0))
    depth, weight, extra = predict(METAL, DULL, 0.1, device)
    assert (plain - depth).std() > 0.0015
    np.testing.assert_allclose(biased - plain, weight * extra, atol=3.0 * COUNT)


def test_plastic_has_little_and_convex_metal_none(device):
    """Known: the weight of a rough dielectric is about its reflectance of 4 %, divided by its diffuse albedo and the cosine."""
    depth, _, extra = predict(GREY, DULL, 1.0, device)
    share = (measure(groove(GREY, DULL), device, **PERFECT, multipath=1.0).depth[0][SEEN] - depth) / extra
    assert 0.04 < share.min() < share.max() < 0.08
    ridge, default = (measure(groove(METAL, METAL, bend=-1.0), device, multipath=share).counts for share in (1.0, 0.0))
    assert ridge.any()
    np.testing.assert_array_equal(ridge, default)


def test_coats_mirror_too_and_blocked_light_is_missing(device):
    settings, coated = PERFECT | {"multipath": 0.5}, replace(GREY, finish=Finish(1.0, 0.1))
    plain, coat = (measure(groove(left, DULL), device, **settings).depth[0][SEEN] for left in (GREY, coated))
    assert (coat > plain + 2.0 * COUNT).mean() > 0.9
    # A plate occludes the right sheet from the projector.
    toy = groove(GREY, DULL)
    toy.entries, toy.placed = [*toy.entries, entry(sheet(0.4, 1.0))], [[*toy.placed[0], (2, (0.203, 0.0, TOP - 0.6, *UPRIGHT))]]
    without, blocked = (measure(toy, device, **PERFECT, multipath=share).counts[0][SEEN] for share in (0.0, 0.5))
    np.testing.assert_array_equal(blocked, without)


def test_views_are_those_of_any_number_of_worlds(device):
    three = measure(groove(METAL, DULL, worlds=3), device, multipath=0.1).counts
    for world in range(3):
        np.testing.assert_array_equal(measure(groove(METAL, DULL), device, first_episode=world, multipath=0.1).counts[0], three[world])
