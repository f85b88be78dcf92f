"""Contact manifolds of collision shapes: how one scanned box lies on another."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.configs.schema import Config
from synpick_warp.scenes.collision.hulls import hull_planes
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.stages.sim import physics

LOWER, UPPER = (0.3, 0.3, 0.05), (0.1, 0.15, 0.05)
"""Extents of the boxes [m]."""
ROUGHNESS = 2e-4
"""Largest error of a point of a scan in each coordinate [m]."""


def scan_box(size: tuple[float, float, float], rng: np.random.Generator) -> ConvexPiece:
    """Collision shape of noisy points on the sides of a box about the origin."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), axis=-1).reshape(-1, 3)
    points = grid[np.abs(grid).max(axis=1) == 0.5] * size
    return simplify_hull(points + rng.uniform(-ROUGHNESS, ROUGHNESS, points.shape), 64)


def lay_side(piece: ConvexPiece, side: float) -> wp.transform:
    """Pose in which the side of a piece that faces up (side 1) or down (-1) lies in the plane z = 0."""
    planes = hull_planes(piece)
    plane = planes[(side * planes[:, 2]).argmax()]
    turn = Rotation.align_vectors([[0.0, 0.0, side]], plane[None, :3])[0]
    return wp.transform(wp.vec3(0.0, 0.0, -side * float(plane[3])), wp.quat(*turn.as_quat().tolist()))


@pytest.mark.parametrize("seed", range(8))
def test_a_scanned_box_lies_on_another_on_the_corners_of_its_side(device, seed):
    """Were the sides not planar, a single contact would jump from vertex to vertex as the upper box rocks."""
    rng = np.random.default_rng(seed)
    lower, upper = scan_box(LOWER, rng), scan_box(UPPER, rng)
    builder = newton.ModelBuilder()
    shape = builder.ShapeConfig(gap=Config().physics.gap)
    for piece, side, body in ((lower, 1.0, -1), (upper, -1.0, builder.add_body(xform=lay_side(upper, -1.0)))):
        mesh = newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)
        builder.add_shape_convex_hull(body, xform=lay_side(piece, side) if body < 0 else None, mesh=mesh, cfg=shape)
    model = builder.finalize(device)
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    pipeline = physics.make_pipeline(Config().physics, model)
    contacts = pipeline.contacts()
    pipeline.collide(state, contacts)

    count = int(contacts.rigid_contact_count.numpy()[0])
    assert 3 <= count <= 4
    corners = 0.5 * (contacts.rigid_contact_point0.numpy()[:count] + contacts.rigid_contact_point1.numpy()[:count])
    assert (np.ptp(corners[:, :2], axis=0) > 0.9 * np.array(UPPER[:2])).all()
