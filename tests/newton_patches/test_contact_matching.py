"""Contact matching: no contact of two shapes that touched before starts without impulse, unless all partners are taken or too far."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.configs.schema import Config, Physics
from synpick_warp.kernels.newton_patches import contact_matching as kernels
from synpick_warp.newton_patches.narrow_phase import MAX_DISTANCE
from synpick_warp.stages.sim import physics

PAIR_BITS = 3
"""Low bits of the keys of the tables below."""
NEAR, FAR = 1e-3, 2 * MAX_DISTANCE
SLIP = 5e-6
"""Motion of a box in a substep [m]."""
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
LAST = [(1, 0.0, UP), (1, 0.0, UP), (1, FAR, UP), (2, 0.0, UP), (2, NEAR, DOWN)]
"""Contacts of the last substep: pair of shapes, place along an axis [m], normal."""


def complete(device, contacts: list[tuple[int, float, tuple]], match: list[int]) -> list[int]:
    """Matches of contacts as of LAST after the kernel, which begins with `match`."""

    def keys(rows):
        return wp.array([(pair << PAIR_BITS) + index % 8 for index, (pair, _, _) in enumerate(rows)], dtype=wp.int64, device=device)

    def vectors(values):
        return wp.array(np.array(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)

    def places(rows):
        return [(place, 0.0, 0.0) for _, place, _ in rows]

    history = kernels.ContactHistory()
    history.count, history.key = wp.array([len(LAST)], dtype=int, device=device), keys(LAST)
    history.position, history.normal = vectors(places(LAST)), vectors([normal for _, _, normal in LAST])
    history.pair_bits = wp.int64((1 << PAIR_BITS) - 1)
    shapes, body_q = wp.zeros(len(contacts), dtype=int, device=device), wp.zeros(1, dtype=wp.transform, device=device)
    points = vectors(places(contacts))
    matches = wp.array(match, dtype=int, device=device)
    inputs = [wp.array([-1], dtype=int, device=device), MAX_DISTANCE, 0.995, history, body_q]
    inputs += [wp.array([len(contacts)], dtype=int, device=device), keys(contacts), shapes, shapes, points, points]
    inputs.append(vectors([normal for _, _, normal in contacts]))
    wp.launch(kernels.complete_matching_kernel, dim=len(contacts) + 2, inputs=inputs, outputs=[matches], device=device)
    return matches.numpy().tolist()


@pytest.mark.parametrize(
    ("contacts", "match", "expected"),
    [
        ([(1, 0.0, UP), (1, 0.0, UP)], [0, -2], [0, 1]),
        ([(1, 0.0, UP), (1, 0.0, UP)], [-2, 0], [1, 0]),
        ([(1, 0.0, UP), (1, 0.0, UP), (1, 0.0, UP)], [0, -2, -2], [0, 1, -2]),
        ([(1, FAR - NEAR, UP)], [-2], [2]),
        ([(1, FAR + MAX_DISTANCE + NEAR, UP)], [-2], [-2]),
        ([(2, NEAR, UP), (2, NEAR, DOWN)], [-2, -2], [3, 4]),
        ([(2, 0.0, UP), (2, NEAR, UP)], [3, -2], [3, -2]),
        ([(0, 0.0, UP), (3, 0.0, UP)], [-2, -2], [-2, -2]),
        ([(1, 0.0, UP), (1, 0.0, UP)], [-1, -1], [-1, -1]),
    ],
    ids=["second", "first", "none left", "nearest", "too far", "normals", "none aligned", "other pairs", "new pairs"],
)
def test_a_contact_without_a_partner_gets_the_nearest_one_left(contacts, match, expected, device):
    assert complete(device, contacts, match) == expected


@pytest.mark.parametrize("matches_all", [False, True])
def test_an_edge_on_a_face_keeps_its_impulses(matches_all, device):
    """Newton writes the end of an edge twice, and leaves one of the two without a partner as soon as it moves by micrometres."""
    builder = newton.ModelBuilder()
    shape = builder.ShapeConfig(gap=Config().physics.gap)
    turn = Rotation.from_euler("yx", (1.0, 30.0), degrees=True)
    corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3) * (0.08, 0.06, 0.03)
    lowest = float(turn.apply(corners)[:, 2].min())
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, -lowest), wp.quat(*turn.as_quat().tolist())))
    mesh = newton.Mesh.create_box(0.04, 0.03, 0.015, compute_inertia=False)
    builder.add_shape_convex_hull(body, mesh=mesh, cfg=shape)
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1, cfg=shape)
    model = builder.finalize(device)
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    pipeline = physics.make_pipeline(Physics(match_all=matches_all), model)
    contacts = pipeline.contacts()
    for slip in (0.0, SLIP):
        pose = state.body_q.numpy()
        pose[body, 0] += slip
        state.body_q.assign(pose)
        pipeline.collide(state, contacts)
    count = int(contacts.rigid_contact_count.numpy()[0])
    match = contacts.rigid_contact_match_index.numpy()[:count]
    assert count == 3
    assert sorted(match) == ([0, 1, 2] if matches_all else [-2, *sorted(match[match >= 0])])
