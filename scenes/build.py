"""One newton.Model with N identical tote worlds: tote, guide walls, gripper, and slots that take any object of the catalog.

An episode needs no new model. Every world has the same bodies; a body slot becomes an object by selecting one of Newton's body
variants, or stays empty. Objects of one convex piece and concave ones have slots of their own, since a slot needs as
many shape rows as its largest variant, and the broad phase pays for every row.
"""

from __future__ import annotations

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.modes import mode_weights
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.gripper import cup_collider, finger_collider, rod_inertia
from synpick_warp.scenes.tote import TABLE_SIZE, guide_walls, tote_colliders
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece

# Mass [kg] and inertia [kg·m²] of an empty slot; its weight is cancelled, so that only their being positive matters.
EMPTY_MASS = 0.1
EMPTY_INERTIA = 1e-3
# Rotor inertia of the cup's drive [kg·m²]; keeps the stiff drive well-conditioned at 2 ms.
CUP_ARMATURE = 1e-3
# Draws by which the number of slots is found; a share of 1e-3 of them is known to 10 %.
SLOT_TRIALS = 100_000
GRIPPER_BODIES = 2
GRIPPER_DOFS = 4
FREE_COORDS = 7
FREE_DOFS = 6


@dataclass(frozen=True)
class Layout:
    """Where things lie in the model's arrays. All worlds are alike: world w adds w times the per-world extent."""

    worlds: int
    instances: int
    """Room for instances in a world."""
    single_slots: int
    """Body slots for objects of one convex piece; they come first."""
    compound_slots: int
    """Body slots for concave objects."""
    shapes_per_world: int
    guide_shapes: tuple[int, ...]
    """Guide walls, as shape indices inside a world."""
    finger_shape: int
    cup_shape: int
    """Collision shapes of the gripper, likewise."""

    @property
    def slots(self) -> int:
        return self.single_slots + self.compound_slots

    @property
    def bodies_per_world(self) -> int:
        return GRIPPER_BODIES + self.slots

    @property
    def coords_per_world(self) -> int:
        return GRIPPER_DOFS + FREE_COORDS * self.slots

    @property
    def dofs_per_world(self) -> int:
        return GRIPPER_DOFS + FREE_DOFS * self.slots


@dataclass(frozen=True, eq=False)
class BuiltModel:
    """The finalized model and its layout."""

    model: newton.Model
    layout: Layout
    variant: np.ndarray
    """Index of each catalog entry among the variants of its kind of slot (entry) int32."""
    empty_variant: tuple[int, int]
    """Index of the empty variant for single and for compound slots."""


def count_slots(config: Config, catalog: Catalog) -> tuple[int, int]:
    """Body slots (single, compound) that hold every draw but a share of `slot_shortfall`, in each mode that episodes can have.

    Found by drawing: the volume budget couples the number of objects with which ones they are, so there is no simple formula.
    Slots cost time whether full or not, and compound ones most: of these there are as few as possible, the single ones follow.

    Raises:
        ConfigError: No object fits into the volume budget.
    """
    budget, shortfall = config.arrangement.volume, config.arrangement.slot_shortfall
    compound = np.array([len(entry.pieces) > 1 for entry in catalog.entries])
    volume = np.array([entry.volume for entry in catalog.entries])
    if volume.min() > budget:
        least = catalog.entries[int(volume.argmin())]
        raise ConfigError(
            f"arrangement.volume is {budget:g} m³, but the smallest object, {least.name}, takes {least.volume:.3g} m³; make it larger"
        )
    needed = []
    for repeats in repeats_that_occur(config):
        drawn = _draw_trials(volume, budget, config.arrangement.max_objects, repeats)
        singles, compounds = (((drawn >= 0) & (compound[drawn] == kind)).sum(axis=1) for kind in (False, True))
        most = np.quantile(compounds, 1.0 - shortfall, method="higher")
        # Draws that find no room among the compound slots are lost already; all others and these together may be `shortfall`.
        needed.append((np.quantile(np.where(compounds > most, np.inf, singles), 1.0 - shortfall, method="higher"), most))
    return int(max(single for single, _ in needed)), int(max(most for _, most in needed))


def repeats_that_occur(config: Config) -> set[bool]:
    """Whether an object may come several times in a tote, for all modes that episodes can have."""
    rules = {"pick": config.pick.repeats, "target": config.pick.repeats, "move": config.move.repeats}
    return {rules[mode] for mode, weight in mode_weights(config).items() if weight > 0.0}


def _draw_trials(volume: np.ndarray, budget: float, room: int, repeats: bool) -> np.ndarray:
    """Draw as kernels.sim.arrangement.draw_objects_kernel does: catalog indices (SLOT_TRIALS, room), -1 after the last."""
    numbers = np.random.default_rng(0)
    drawn = np.full((SLOT_TRIALS, room), -1, dtype=np.int32)
    total = np.zeros(SLOT_TRIALS)
    # Trials that still draw. The first object is drawn again until one fits.
    going, choice = np.arange(SLOT_TRIALS), np.flatnonzero(volume <= budget)
    for position in range(room if repeats else min(room, len(volume))):
        candidate = numbers.choice(choice, size=len(going))
        known = np.arange(0 if repeats else len(going))
        while len(known := known[(drawn[going[known], :position] == candidate[known, None]).any(axis=1)]):
            candidate[known] = numbers.choice(choice, size=len(known))
        fits = total[going] + volume[candidate] <= budget
        going, candidate = going[fits], candidate[fits]
        drawn[going, position] = candidate
        total[going] += volume[candidate]
        choice = np.arange(len(volume))
    return drawn


def build_model(config: Config, catalog: Catalog, device: wp.Device) -> BuiltModel:
    """Build and finalize the model of all worlds.

    Args:
        config: Settings; `bake.worlds` worlds are made.
        catalog: The objects.
        device: Where the model's arrays lie.
    """
    single, compound = count_slots(config, catalog)
    world = newton.ModelBuilder(gravity=(0.0, 0.0, -config.physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(world)
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, mu=config.physics.friction, gap=config.physics.gap, restitution=0.0)
    for piece in tote_colliders(config.tote):
        world.add_shape_convex_hull(-1, mesh=_hull(piece), cfg=shape)
    table = wp.transform(wp.vec3(0.0, 0.0, -config.tote.wall - TABLE_SIZE[2]), wp.quat_identity())
    world.add_shape_box(-1, xform=table, hx=TABLE_SIZE[0], hy=TABLE_SIZE[1], hz=TABLE_SIZE[2], cfg=shape)
    guides = tuple(
        world.add_shape_convex_hull(-1, mesh=_hull(piece), cfg=shape) for piece in guide_walls(config.tote, config.physics.guide_height)
    )
    gripper = _add_gripper(world, config, shape)
    variant = np.zeros(len(catalog), dtype=np.int32)
    empty = _add_slots(world, config, catalog, shape, (single, compound), variant)
    scene = newton.ModelBuilder(gravity=(0.0, 0.0, -config.physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(scene)
    scene.replicate(world, copy_count=config.bake.worlds)
    model = scene.finalize(device=device)
    layout = Layout(config.bake.worlds, config.arrangement.max_objects, single, compound, world.shape_count, guides, *gripper)
    return BuiltModel(model, layout, variant, empty)


def _hull(piece: ConvexPiece) -> newton.Mesh:
    return newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)


def _add_gripper(world: newton.ModelBuilder, config: Config, shape: newton.ModelBuilder.ShapeConfig) -> tuple[int, int]:
    """Finger on three linear axes, cup on a hinge about y; returns their shapes. Their weight is carried by the impedance controller."""
    gripper = config.gripper
    dof = newton.ModelBuilder.JointDofConfig
    free = {"limit_lower": -np.inf, "limit_upper": np.inf, "armature": 0.0}
    finger = world.add_link(
        mass=gripper.finger_mass,
        inertia=wp.mat33(np.diag(rod_inertia(gripper.finger_mass, gripper.finger_length))),
        com=wp.vec3(0.0, 0.0, gripper.finger_length / 2),
        lock_inertia=True,
        label="finger",
    )
    cup = world.add_link(
        mass=gripper.cup_mass,
        inertia=wp.mat33(np.diag(rod_inertia(gripper.cup_mass, gripper.cup_length))),
        com=wp.vec3(0.0, 0.0, -gripper.cup_length / 2),
        lock_inertia=True,
        label="cup",
    )
    axes = [dof(axis=axis, **free) for axis in (newton.Axis.X, newton.Axis.Y, newton.Axis.Z)]
    slide = world.add_joint_d6(-1, finger, linear_axes=axes)
    limit = np.radians(gripper.tilt_limit)
    drive = {"target_ke": gripper.tilt_stiffness, "target_kd": gripper.tilt_damping, "effort_limit": gripper.tilt_torque}
    tilt = world.add_joint_revolute(finger, cup, axis=newton.Axis.Y, limit_lower=-limit, limit_upper=limit, armature=CUP_ARMATURE, **drive)
    world.add_articulation([slide, tilt], label="gripper")
    finger_shape = world.add_shape_convex_hull(finger, mesh=_hull(finger_collider(gripper)), cfg=shape)
    cup_shape = world.add_shape_convex_hull(cup, mesh=_hull(cup_collider(gripper)), cfg=shape)
    world.add_shape_collision_filter_pair(finger_shape, cup_shape)
    return finger_shape, cup_shape


def _add_slots(
    world: newton.ModelBuilder,
    config: Config,
    catalog: Catalog,
    shape: newton.ModelBuilder.ShapeConfig,
    slots: tuple[int, int],
    variant: np.ndarray,
) -> tuple[int, int]:
    """Add the object slots; fill `variant`; return the empty variants' indices."""
    empty = []
    damping = {
        "steel:rigid_body_angular_damping": config.physics.angular_damping,
        "steel:rigid_body_max_linear_velocity": config.physics.max_speed,
    }
    for compound, count in enumerate(slots):
        entries = [index for index, entry in enumerate(catalog.entries) if (len(entry.pieces) > 1) == bool(compound)]
        variants = [_variant(config, catalog.entries[index], shape) for index in entries] + [_variant(config, None, shape)]
        for position, index in enumerate(entries):
            variant[index] = position
        empty.append(len(entries))
        for slot in range(count):
            body = world.add_body(mass=0.0, label=f"{'compound' if compound else 'single'}_{slot}", custom_attributes=damping)
            world.add_body_variants(body, variants, initial=len(entries), labels=[str(index) for index in entries] + ["empty"])
    return empty[0], empty[1]


def _variant(config: Config, entry: CatalogEntry | None, shape: newton.ModelBuilder.ShapeConfig) -> newton.ModelBuilder:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -config.physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(builder)
    if entry is None:
        builder.add_body(mass=EMPTY_MASS, inertia=wp.mat33(np.eye(3) * EMPTY_INERTIA), lock_inertia=True)
        return builder
    body = builder.add_body(
        mass=entry.mass, com=wp.vec3(*entry.center_of_mass), inertia=wp.mat33(entry.inertia), lock_inertia=True, label=entry.name
    )
    for piece in entry.pieces:
        builder.add_shape_convex_hull(body, mesh=_hull(piece), cfg=shape)
    return builder
