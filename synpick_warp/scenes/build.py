"""Simulation model: one newton.Model with N identical worlds of tote, guide walls, props, gripper, and body slots for catalog objects.

Episodes need no new model. Every world has the same bodies; a body slot becomes an object by selecting one of Newton's body variants,
or stays empty. Single-hull objects and compound (decomposed) ones have slots of their own, since a slot has as many shapes as its
largest variant, and every shape costs time in the broad phase.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.dataset import mode_weights
from synpick_warp.configs.schema import EXCEED, Arrangement, Bake, Config, Move, Physics, Pick
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes.inside import HeightField
from synpick_warp.scenes.bins import TABLE_SIZE, guide_walls, make_bins
from synpick_warp.scenes.capacities import count_entries, oriented_sides
from synpick_warp.scenes.grippers import CUP_ARMATURE, GRIPPER_BODIES, GRIPPER_DOFS, Head, finger_collider, make_head, rod_inertia
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece

# Mass [kg] and inertia [kg·m²] of an empty slot. Its gravity is compensated, so any positive values will do.
EMPTY_MASS = 0.1
EMPTY_INERTIA = 1e-3
# Monte Carlo trials that determine the slot counts; a fraction of 1e-3 of them is known to 10 %.
SLOT_TRIALS = 100_000
# Contact margin of a shape at rest [m]: far above the depth of contacts at rest, 0.1 mm.
REST_GAP = 5e-4
FREE_COORDS = 7
FREE_DOFS = 6


class WorldPart(NamedTuple):
    """Collision shape of a bin, or guide wall on its rim: index among a world's shapes, index of the bin, whether it is a guide wall."""

    shape: int
    bin: int
    guide: bool


@dataclass(frozen=True)
class WorldLayout:
    """Counts and offsets of bodies, joints and shapes in the arrays of the model. World w starts at w times the count per world."""

    worlds: int
    instances: int
    """Capacity for instances in a world."""
    single_slots: int
    """Body slots for objects whose collision shape is one hull; they come first."""
    compound_slots: int
    """Body slots for objects with a convex decomposition."""
    shapes_per_world: int
    parts: tuple[WorldPart, ...]
    """Collision shapes and guide walls of all bins, of which each world has one in place."""
    finger_shape: int
    """Shape index of the gripper shaft within a world."""
    head_shapes: tuple[int, ...]
    """Shape indices of the gripper head within a world."""

    @property
    def slots(self) -> int:
        """Body slots of a world."""
        return self.single_slots + self.compound_slots

    @property
    def bodies_per_world(self) -> int:
        """Bodies of a world: gripper and slots."""
        return GRIPPER_BODIES + self.slots

    @property
    def coords_per_world(self) -> int:
        """Joint coordinates of a world: gripper and slots."""
        return GRIPPER_DOFS + FREE_COORDS * self.slots

    @property
    def dofs_per_world(self) -> int:
        """Degrees of freedom of a world: gripper and slots."""
        return GRIPPER_DOFS + FREE_DOFS * self.slots


@dataclass(frozen=True, eq=False)
class BuiltModel:
    """Finalized Newton model with its layout, and the body variant (shape and mass) that a slot selects for each catalog entry."""

    model: newton.Model
    layout: WorldLayout
    head: Head
    variant: np.ndarray
    """Variant index of each catalog entry in slots of its type (entry) int32."""
    empty_variant: tuple[int, int]
    """Index of the empty variant in single and in compound slots."""
    fields: tuple[HeightField | None, ...]
    """Height field of the inside of each bin."""
    rest_gap: float
    """Contact margin of a shape at rest [m]."""


REPEATS: Mapping[str, object] = {"pick.repeats": True, "move.repeats": True}
"""Settings by which objects repeat in an episode, in every mode."""


def count_slots(arrangement: Arrangement, rules: Iterable[bool], catalog: Catalog) -> tuple[int, int]:
    """Determine the body slots (single, compound) that suffice for all draws but a fraction `slot_shortfall`, in each possible mode.

    The object that exceeds the budget, if `fill` keeps it, has its slot as well. Where `counts` are set, they suffice for the largest ones.

    A Monte Carlo estimate: the volume budget couples how many objects are drawn with which ones, so there is no simple formula. Slots cost
    time whether used or not, and compound ones most: their count is minimized first, then that of single slots. `rules`: whether objects
    repeat in an episode: the values by `find_repeat_rules`. Raises ConfigError: no object fits into the volume budget, or `count_entries`
    refuses a part."""
    if arrangement.counts:
        most = count_entries(arrangement.counts, catalog)[:, 1]
        compounds = sum(int(number) for number, entry in zip(most, catalog.entries, strict=True) if len(entry.pieces) > 1)
        return int(most.sum()) - compounds, compounds
    budget, shortfall = arrangement.volume, arrangement.slot_shortfall
    compound = np.array([len(entry.pieces) > 1 for entry in catalog.entries])
    volume = np.array([entry.volume for entry in catalog.entries])
    # The kernels sample in 32-bit floats: an object of exactly the budget fits there.
    if np.float32(volume.min()) > np.float32(budget):
        smallest = catalog.entries[int(volume.argmin())]
        raise ConfigError(
            f"arrangement.volume is {budget:g} m³, but the smallest object, {smallest.name}, takes {smallest.volume:.3g} m³; make it larger"
        )
    needed = []
    for repeats in rules:
        slots = _slots_of_trials(_draw_trials(volume, budget, arrangement, repeats), compound, shortfall)
        # Where a sum of volumes meets the budget but for rounding, as of three cubes of a litre and three litres, 64-bit floats may
        # find room for one object fewer than the kernels do, in every draw. Other catalogs keep the count of the 64-bit draws.
        rounded = _draw_trials(volume.astype(np.float32), np.float32(budget), arrangement, repeats)
        noise = 4.0 * np.sqrt(shortfall / SLOT_TRIALS)
        if (_count_by_type(rounded, compound) > slots).any(axis=1).mean() > shortfall + noise:
            slots = _slots_of_trials(rounded, compound, shortfall)
        needed.append(slots)
    return max(single for single, _ in needed), max(limit for _, limit in needed)


def without_distractors(arrangement: Arrangement, most: int) -> Arrangement:
    """Settings of the draw of objects with labels, which leaves room for `most` distractors."""
    return replace(arrangement, max_objects=arrangement.max_objects - most)


def count_distractor_slots(most: int, catalog: Catalog, arrangement: Arrangement) -> tuple[int, int]:
    """Body slots (single, compound) that suffice for `most` distractors, in all draws but a fraction `slot_shortfall` for each type."""
    if not most or not catalog.distractors:
        return 0, 0
    from scipy.stats import binom  # which takes 0.3 s to import

    share = np.mean([len(entry.pieces) > 1 for entry in catalog.distractors])
    single, compound = (int(binom.isf(arrangement.slot_shortfall, most, part)) for part in (1.0 - share, share))
    return single, compound


def _count_by_type(drawn: np.ndarray, compound: np.ndarray) -> np.ndarray:
    """Numbers of drawn objects by slot type, single and compound (trial, 2), from catalog indices (trial, capacity), -1: none."""
    compounds = ((drawn >= 0) & compound[drawn]).sum(axis=1)
    return np.stack([(drawn >= 0).sum(axis=1) - compounds, compounds], axis=1)


def _slots_of_trials(drawn: np.ndarray, compound: np.ndarray, shortfall: float) -> tuple[int, int]:
    """Body slots (single, compound) that suffice for all drawn trials (trial, capacity) but a fraction `shortfall`."""
    singles, compounds = _count_by_type(drawn, compound).T
    limit = np.quantile(compounds, 1.0 - shortfall, method="higher")
    # Draws that exceed the compound slots fail anyway; `shortfall` bounds these and those that exceed the single slots together.
    return int(np.quantile(np.where(compounds > limit, np.inf, singles), 1.0 - shortfall, method="higher")), int(limit)


def find_repeat_rules(bake: Bake, pick: Pick, move: Move) -> set[bool]:
    """Whether episodes may contain several instances of an object: the values in all modes that the bake's episodes can have."""
    return {move.repeats if mode == "move" else pick.repeats for mode, weight in mode_weights(bake).items() if weight > 0.0}


def _draw_trials(volume: np.ndarray, budget: float | np.float32, rule: Arrangement, repeats: bool) -> np.ndarray:
    """Draw as kernels.sim.arrangement.sample_objects_kernel does: catalog indices (SLOT_TRIALS, capacity), -1 after the last.

    Volumes [m³] are summed in the type of `volume` (entry); the kernel's is float32.
    """
    rng, exceed, capacity = np.random.default_rng(0), rule.fill == EXCEED, rule.max_objects
    drawn = np.full((SLOT_TRIALS, capacity), -1, dtype=np.int32)
    total = np.zeros(SLOT_TRIALS, volume.dtype)
    # `active`: trials that still draw. The first object is drawn from those that fit.
    active, choice = np.arange(SLOT_TRIALS), np.flatnonzero(volume <= budget)
    if not len(choice):
        return drawn
    for position in range(capacity if repeats else min(capacity, len(choice if exceed else volume))):
        candidate = rng.choice(choice, size=len(active))
        repeated = np.arange(0 if repeats else len(active))
        while len(repeated := repeated[(drawn[active[repeated], :position] == candidate[repeated, None]).any(axis=1)]):
            candidate[repeated] = rng.choice(choice, size=len(repeated))
        if not exceed:
            fits = total[active] + volume[candidate] <= budget
            active, candidate = active[fits], candidate[fits]
            choice = np.arange(len(volume))
        drawn[active, position] = candidate
        total[active] += volume[candidate]
        if exceed:
            active = active[total[active] < budget]
    return drawn


def build_model(config: Config, catalog: Catalog, device: wp.Device) -> BuiltModel:
    """Build and finalize the model of `bake.worlds` worlds."""
    most = config.randomize.most_distractors
    slots = count_slots(without_distractors(config.arrangement, most), find_repeat_rules(config.bake, config.pick, config.move), catalog)
    single, compound = (count + more for count, more in zip(slots, count_distractor_slots(most, catalog, config.arrangement), strict=True))
    world = newton.ModelBuilder(gravity=(0.0, 0.0, -config.physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(world)
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, mu=config.physics.friction, gap=config.physics.gap, restitution=0.0)
    bins = make_bins(config.cell.bins)

    def add(index: int, pieces: Sequence[ConvexPiece], guide: bool) -> list[WorldPart]:
        return [WorldPart(world.add_shape_convex_hull(-1, mesh=hull_mesh(piece), cfg=shape), index, guide) for piece in pieces]

    parts = add(0, bins[0].pieces, False)
    table = wp.transform(wp.vec3(0.0, 0.0, bins[0].sizes.ground - TABLE_SIZE[2]), wp.quat_identity())
    world.add_shape_box(-1, xform=table, hx=TABLE_SIZE[0], hy=TABLE_SIZE[1], hz=TABLE_SIZE[2], cfg=shape)
    for index, one in enumerate(bins):
        parts += [] if index == 0 else add(index, one.pieces, False)
        parts += add(index, guide_walls(one.sizes, config.physics.guide_height), True)
    for pose, piece in ((wp.transform(*prop.pose), piece) for prop in catalog.props for piece in prop.pieces):
        world.add_shape_convex_hull(-1, xform=pose, mesh=hull_mesh(piece), cfg=shape)
    head = make_head(config.gripper)
    gripper = add_gripper(world, config.gripper, head, shape)
    drawn = find_drawn(config.arrangement, catalog)
    variant, empty = _add_slots(world, config.physics, catalog, shape, (single, compound), drawn)
    scene = newton.ModelBuilder(gravity=(0.0, 0.0, -config.physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(scene)
    scene.replicate(world, copy_count=config.bake.worlds)
    with warnings.catch_warnings():
        # Newton raises the inertia of bodies of a few millimetres to its threshold, and says so for every slot.
        warnings.filterwarnings("ignore", "Eigenvalues below threshold")
        model = scene.finalize(device=device)
    layout = WorldLayout(config.bake.worlds, config.arrangement.max_objects, single, compound, world.shape_count, tuple(parts), *gripper)
    return BuiltModel(model, layout, head, variant, empty, tuple(one.limits for one in bins), find_rest_gap(config.physics, catalog, drawn))


def find_rest_gap(physics: Physics, catalog: Catalog, drawn: np.ndarray) -> float:
    """Contact margin of a shape at rest [m]: REST_GAP, or that of a fast one, if one of the objects `drawn` is thinner than two of these.
    It would pass through another of its kind when hit, as its margin does not know of the impact."""
    is_thin = any(oriented_sides(catalog.bodies[index].pieces).min() < 2.0 * physics.gap for index in drawn.tolist())
    return physics.gap if is_thin else min(REST_GAP, physics.gap)


def find_drawn(arrangement: Arrangement, catalog: Catalog) -> np.ndarray:
    """Indices of the catalog's bodies that episodes can have: all, or those of `arrangement.counts` and distractors."""
    drawn = np.arange(len(catalog.bodies))
    if not arrangement.counts:
        return drawn
    most = count_entries(arrangement.counts, catalog)[:, 1]
    return np.concatenate([np.flatnonzero(most), drawn[len(most) :]])


def must_repeat(arrangement: Arrangement, catalog: Catalog) -> bool:
    """Whether objects repeat in an episode since all together stay below the volume budget: a catalog of one object fills the tote, too."""
    if arrangement.counts:
        return False
    volumes = [entry.volume for entry in catalog.entries if entry.volume <= arrangement.volume]
    return arrangement.repeat_to_fill and sum(volumes) < arrangement.volume and len(volumes) < arrangement.max_objects


def _add_slots(
    world: newton.ModelBuilder,
    physics: Physics,
    catalog: Catalog,
    shape: newton.ModelBuilder.ShapeConfig,
    slots: tuple[int, int],
    drawn: np.ndarray,
) -> tuple[np.ndarray, tuple[int, int]]:
    """Add the body slots for objects. A slot has as many shapes as the largest of the objects that episodes can have, `drawn`. Returns the
    variant of each catalog entry (entry) int32, 0 of those that no episode has, and the empty variants of single and compound slots."""
    variant, empty = np.zeros(len(catalog.bodies), np.int32), []
    damping = {
        "steel:rigid_body_angular_damping": physics.angular_damping,
        "steel:rigid_body_max_linear_velocity": physics.max_speed,
    }
    for compound, count in enumerate(slots):
        entries = [index for index in drawn.tolist() if (len(catalog.bodies[index].pieces) > 1) == bool(compound)]
        variants = [_variant(physics, catalog.bodies[index], shape) for index in entries] + [_variant(physics, None, shape)]
        for position, index in enumerate(entries):
            variant[index] = position
        empty.append(len(entries))
        for slot in range(count):
            body = world.add_body(mass=0.0, label=f"{'compound' if compound else 'single'}_{slot}", custom_attributes=damping)
            world.add_body_variants(body, variants, initial=len(entries), labels=[str(index) for index in entries] + ["empty"])
    return variant, (empty[0], empty[1])


def _variant(physics: Physics, entry: CatalogEntry | None, shape: newton.ModelBuilder.ShapeConfig) -> newton.ModelBuilder:
    """Body variant of an object, or the empty one."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -physics.gravity))
    newton.solvers.SolverSteel.register_custom_attributes(builder)
    if entry is None:
        builder.add_body(mass=EMPTY_MASS, inertia=wp.mat33(np.eye(3) * EMPTY_INERTIA), lock_inertia=True)
        return builder
    body = builder.add_body(
        mass=entry.mass, com=wp.vec3(*entry.center_of_mass), inertia=wp.mat33(entry.inertia), lock_inertia=True, label=entry.name
    )
    for piece in entry.pieces:
        builder.add_shape_convex_hull(body, mesh=hull_mesh(piece), cfg=shape)
    return builder


def add_gripper(
    world: newton.ModelBuilder, gripper: Gripper, head: Head, shape: newton.ModelBuilder.ShapeConfig
) -> tuple[int, tuple[int, ...]]:
    """Add shaft (three prismatic axes) and head (revolute wrist about y); returns the indices of the shaft's shape and of the head's.

    The impedance controller compensates their weight.
    """
    dof = newton.ModelBuilder.JointDofConfig
    finger = world.add_link(
        mass=gripper.finger_mass,
        inertia=wp.mat33(np.diag(rod_inertia(gripper.finger_mass, gripper.finger_length))),
        com=wp.vec3(0.0, 0.0, gripper.finger_length / 2),
        lock_inertia=True,
        label="finger",
    )
    cup = world.add_link(
        mass=gripper.cup_mass,
        inertia=wp.mat33(np.diag(head.inertia)),
        com=wp.vec3(0.0, 0.0, -gripper.cup_length / 2),
        lock_inertia=True,
        label="cup",
    )
    axes = [dof(axis=axis, limit_lower=-np.inf, limit_upper=np.inf, armature=0.0) for axis in (newton.Axis.X, newton.Axis.Y, newton.Axis.Z)]
    slide = world.add_joint_d6(-1, finger, linear_axes=axes)
    limit = np.radians(gripper.tilt_limit)
    wrist = world.add_joint_revolute(
        finger,
        cup,
        axis=newton.Axis.Y,
        target_ke=gripper.tilt_stiffness,
        target_kd=gripper.tilt_damping,
        limit_lower=-limit,
        limit_upper=limit,
        effort_limit=gripper.tilt_torque,
        armature=CUP_ARMATURE,
    )
    world.add_articulation([slide, wrist], label="gripper")
    finger_shape = world.add_shape_convex_hull(finger, mesh=hull_mesh(finger_collider(gripper)), cfg=shape)
    head_shapes = tuple(world.add_shape_convex_hull(cup, mesh=hull_mesh(piece), cfg=shape) for piece in head.pieces)
    for each in head_shapes:
        world.add_shape_collision_filter_pair(finger_shape, each)
    return finger_shape, head_shapes


def hull_mesh(piece: ConvexPiece) -> newton.Mesh:
    """Newton's mesh of a convex piece."""
    return newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)
