"""Rigid-body model of one tote's pile, the same in all worlds, for several physics engines; and states that they start from."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import Physics, Tote
from synpick_warp.scenes.bins import guide_walls
from synpick_warp.scenes.tote import TABLE_SIZE, tote_colliders
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece
from synpick_warp.stages.buffers import Snapshot

LIFT, SPREAD = 0.1, 2.0
"""Start of a fall: heights above the floor at rest times SPREAD, plus LIFT [m]. The lowest objects land after 0.14 s."""


@dataclass(frozen=True, eq=False)
class Pile:
    """Objects of one world with their object-to-world poses [m]."""

    entries: tuple[CatalogEntry, ...]
    pose: np.ndarray
    """Object to world: x, y, z [m], quaternion x, y, z, w (body, 7) float64."""

    def lift(self) -> Pile:
        """Start of a fall: the same pile, stretched vertically by SPREAD and raised by LIFT; x, y and orientations stay."""
        pose = self.pose.copy()
        pose[:, 2] = LIFT + SPREAD * pose[:, 2]
        return replace(self, pose=pose)


def pick_pile(catalog: Catalog, snapshot: Snapshot) -> Pile:
    """Pile of the world with the median number of objects."""
    indices, poses = snapshot.catalog_index.numpy(), snapshot.pose.numpy()
    counts = (indices >= 0).sum(axis=1)
    world = int(np.argsort(counts, kind="stable")[len(counts) // 2])
    present = indices[world] >= 0
    return Pile(tuple(catalog.entries[index] for index in indices[world][present]), poses[world][present].astype(np.float64))


def build_piles(physics: Physics, tote: Tote, pile: Pile, worlds: int, device: wp.Device) -> newton.Model:
    """Build `worlds` equal worlds of tote, table, guide walls and the pile; no gripper, no empty body slots.

    Shapes, masses, friction and damping are those of a bake. Joint coordinates are the pile's poses, object by object.
    """
    world = newton.ModelBuilder(gravity=(0.0, 0.0, -physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(world)
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, mu=physics.friction, gap=physics.gap, restitution=0.0)
    for piece in (*tote_colliders(tote), *guide_walls(BinSizes.of_tote(tote), physics.guide_height)):
        world.add_shape_convex_hull(-1, mesh=_hull(piece), cfg=shape)
    table = wp.transform(wp.vec3(0.0, 0.0, -tote.wall - TABLE_SIZE[2]), wp.quat_identity())
    world.add_shape_box(-1, xform=table, hx=TABLE_SIZE[0], hy=TABLE_SIZE[1], hz=TABLE_SIZE[2], cfg=shape)
    damping = {
        "steel:rigid_body_angular_damping": physics.angular_damping,
        "steel:rigid_body_max_linear_velocity": physics.max_speed,
    }
    for entry, pose in zip(pile.entries, pile.pose, strict=True):
        body = world.add_body(
            xform=wp.transform(*pose.tolist()),
            mass=entry.mass,
            com=wp.vec3(*entry.center_of_mass),
            inertia=wp.mat33(entry.inertia),
            lock_inertia=True,
            custom_attributes=damping,
        )
        for piece in entry.pieces:
            world.add_shape_convex_hull(body, mesh=_hull(piece), cfg=shape)
    scene = newton.ModelBuilder(gravity=(0.0, 0.0, -physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(scene)
    scene.replicate(world, copy_count=worlds)
    with warnings.catch_warnings():
        # Newton raises the inertia of bodies of a few millimetres to its threshold, and says so.
        warnings.filterwarnings("ignore", "Eigenvalues below threshold")
        return scene.finalize(device=device)


def _hull(piece: ConvexPiece) -> newton.Mesh:
    """Newton mesh of a convex piece, without inertia."""
    return newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)
