"""Grippers: the mechanism that all share, a conical shaft on three prismatic axes and a wrist joint that tilts the head about y; and heads.

`suction1` is one cup with bellows on the wrist's axis, `suction_array` cups at given places under a plate whose middle is on that axis, or
under a mesh. To add a kind, see "Add a gripper" in scenes/README.md. The origins of both bodies' frames lie on the wrist axis; z up.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.configs.cell.gripper import COMMON, SUCTION1, SUCTION_ARRAY, Gripper, Suction
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.modelling import Patch, at_height, join, lathe, make_mesh, rounded_rectangle, solid
from synpick_warp.scenes.props import read_body
from synpick_warp.scenes.types import Catalog, ConvexPiece, Fixture, Material, TriangleMesh
from synpick_warp.system.plugins import load_plugin

GRIPPER_BODIES = 2
GRIPPER_DOFS = 4
FINGER_TIP = 0.03
"""Maximum diameter of the shaft at the wrist axis [m]; at most that of its top."""
# Armature (rotor inertia) of the wrist joint [kg·m²], which keeps the stiff drive well conditioned at 2 ms.
CUP_ARMATURE = 1e-3


def finger_fixture(gripper: Gripper) -> Fixture:
    """Build the visual mesh of the shaft, a surface of revolution from the wrist axis (z = 0) up to z = finger_length."""
    low, high, length = *_finger_radii(gripper), gripper.finger_length

    def radius(fraction: float) -> float:
        """Radius of the cone at a fraction of the length [m]."""
        return low + fraction * (high - low)

    profile = [(0.7 * low, 0.0), (low, 0.3 * low)]
    for height in (0.3, 0.6, 0.9):
        # Grooves around the cone make its shading vary.
        depth, half = 0.06 * radius(height), 0.004
        profile += [(radius(height - half), (height - half) * length), (radius(height) - depth, height * length)]
        profile += [(radius(height + half), (height + half) * length)]
    profile += [(high, 0.99 * length), (0.96 * high, length)]
    mesh = make_mesh(solid(lathe(profile, SIDES)), centered=False)
    return Fixture(mesh, Material(gripper.color, None, gripper.metallic, gripper.roughness))


def finger_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the shaft: its cone."""
    low, high = _finger_radii(gripper)
    rings = lathe([(low, 0.0), (high, gripper.finger_length)], COLLIDER_SIDES)
    return simplify_hull(rings.reshape(-1, 3), 2 * COLLIDER_SIDES)


def _finger_radii(gripper: Gripper) -> tuple[float, float]:
    """Radii of the gripper shaft [m]: at the wrist joint, and at its upper end."""
    return min(FINGER_TIP, gripper.finger_width) / 2, gripper.finger_width / 2


SIDES = 40
"""Points per ring of the visual meshes."""
COLLIDER_SIDES = 12
"""Points per ring of the collision shapes."""
STEM_SIDES = 8
"""Points of the ring at the top of the cup's collision shape: with two rings of COLLIDER_SIDES, it has 32 vertices."""
LIP = 0.06
"""Height of the cup's lip, as a fraction of the cup's length."""
HINGE = 0.4
"""Radius of wrist joint and cup stem, as a fraction of the cup's."""
FOLDS = 3
"""Folds of the bellows."""
PLATE = (-0.42, -0.22)
"""Lower and upper side of the plate, as fractions of the cup's length."""
BEVEL = 0.02
"""Height of its bevelled edges, as fraction of the cup's length; cups and stem end this deep in it."""
CORNER = 0.45
"""Radius of its rounded corners, in widths of a cup: less than a half, so that its sides keep a length about a single row of cups."""
INSET = 0.98
"""Outline of its upper and lower side, relative to that between the bevels."""
CORNER_SEGMENTS = 6
"""Segments of a rounded corner of the plate."""
TAPER = 0.5
"""Radius of a cup's collision shape at the plate, as a fraction of the cup's."""
HULL_VERTICES = 32
"""Vertices of the collision shape of a mesh."""


@dataclass(frozen=True, eq=False)
class Head:
    """Body on the wrist with its suction cups, in a frame whose origin lies on the wrist axis, which is y; z up."""

    fixture: Fixture
    """Visual mesh and material."""
    pieces: tuple[ConvexPiece, ...]
    """Collision shapes."""
    inertia: tuple[float, float, float]
    """Principal moments about the centre of mass, in the axes of the frame [kg·m²]."""
    cups: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    """(x, y) of the centre of each cup's lip, in the plane of the tool centre point [m]."""
    has_common_valve: bool = False
    """Whether a leak at one cup spoils the vacuum of all."""


def rod_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Principal moments of inertia [kg·m²] of a cylinder along z whose diameter is a quarter of its length, as for shaft and cup."""
    radius = length / 8
    across = mass * (length**2 + 3 * radius**2) / 12
    return across, across, mass * radius**2 / 2


@functools.lru_cache(maxsize=16)
def make_cup(gripper: Gripper) -> Head:
    """Build the head of one cup: plan, scene, physics and stages ask for the same one, and nobody changes it."""
    mesh = make_mesh(join(cup_patch(gripper), hinge_patch(gripper)), centered=False)
    fixture = Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))
    return Head(fixture, (cup_collider(gripper),), rod_inertia(gripper.cup_mass, gripper.cup_length))


def cup_patch(gripper: Gripper, top: float = 0.0) -> Patch:
    """Surface of revolution of a cup, from z = `top` cup_length down to the lip at z = -cup_length; hollow below."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    stem = HINGE * radius
    profile = [(0.15 * radius, -0.84 * length), (0.55 * radius, -0.88 * length), (0.90 * radius, -length), (radius, -length)]
    profile += [(radius, -(1 - LIP) * length)]
    fold = 0.36 * length / FOLDS
    for index in range(FOLDS):
        base = -0.90 * length + index * fold
        bulge = (0.88 - 0.06 * index) * radius
        profile += [(0.62 * radius, base), (bulge, base + 0.4 * fold), (bulge, base + 0.6 * fold)]
    profile += [(0.62 * radius, -0.54 * length), (0.62 * radius, -0.46 * length), (stem, -0.44 * length), (stem, top * length)]
    return solid(lathe(profile, SIDES))


def hinge_patch(gripper: Gripper) -> Patch:
    """Cylinder about the wrist axis."""
    stem = HINGE * gripper.cup_width / 2
    hinge = solid(lathe([(0.9 * stem, -1.15 * stem), (stem, -1.05 * stem), (stem, 1.05 * stem), (0.9 * stem, 1.15 * stem)], SIDES))
    return hinge.rotate("x", 90.0)


def make_cup_array(gripper: Gripper) -> Head:
    """Build the head of the cups `gripper.cups`, with a plate or the body of `gripper.mesh`. Raises ConfigError: the mesh cannot be used,
    or is not the one that was measured."""
    if gripper.mesh:
        return _mesh_head(gripper)
    top, sides = PLATE[0], _sides(gripper)
    pieces = (_plate_collider(gripper), *(cup_collider(gripper, place, top, TAPER) for place in gripper.cups))
    patches = (*_plate(gripper), *_cup_patches(gripper, [top] * len(gripper.cups)))
    return _head(gripper, make_mesh(join(*patches), centered=False), pieces, (*sides, gripper.cup_length))


def _mesh_head(gripper: Gripper) -> Head:
    """Build the head whose body is a mesh; its collision shape is the convex hull."""
    body = read_body(gripper)
    if gripper.mesh_checksum not in ("", body.checksum):
        raise ConfigError(f"gripper.mesh: {gripper.mesh} is not the mesh that was measured; restore it, or bake again into another folder")
    tops = [height / gripper.cup_length - 1.0 for height in body.undersides]
    cups = make_mesh(join(*_cup_patches(gripper, tops)), centered=False)
    names = ("vertices", "normals", "uv")
    arrays = {name: np.concatenate([getattr(body.mesh, name), getattr(cups, name)]) for name in names}
    mesh = TriangleMesh(faces=np.concatenate([body.mesh.faces, cups.faces + len(body.mesh.vertices)]), **arrays)
    hull = simplify_hull(body.mesh.vertices.astype(np.float64), HULL_VERTICES)
    pieces = (hull, *(cup_collider(gripper, *cup, TAPER) for cup in zip(gripper.cups, tops, strict=True)))
    x, y, z = np.ptp(mesh.vertices, axis=0).tolist()
    return _head(gripper, mesh, pieces, (x, y, z))


def _head(gripper: Gripper, mesh: TriangleMesh, pieces: tuple[ConvexPiece, ...], box: tuple[float, float, float]) -> Head:
    """Head of a mesh and collision shapes, with the inertia of a box of these sides [m]."""
    x, y, z = box
    share = gripper.cup_mass / 12
    inertia = share * (y * y + z * z), share * (x * x + z * z), share * (x * x + y * y)
    fixture = Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))
    return Head(fixture, pieces, inertia, gripper.cups, gripper.valve == COMMON)


def _sides(gripper: Gripper) -> tuple[float, float]:
    """Length and width of the plate, symmetric about the axis [m]."""
    x, y = (2 * np.abs(np.array(gripper.cups)).max(axis=0) + gripper.cup_width).tolist()
    return x, y


def _outline(gripper: Gripper, segments: int) -> np.ndarray:
    """Outline of the plate: a rounded rectangle (point, 2) [m]."""
    return rounded_rectangle(*_sides(gripper), CORNER * gripper.cup_width, segments)


def _plate(gripper: Gripper) -> tuple[Patch, Patch, Patch]:
    """Surfaces of plate, stem and hinge on the wrist axis."""
    ring, length = _outline(gripper, CORNER_SEGMENTS), gripper.cup_length
    low, high = PLATE
    heights = ((INSET, low), (1.0, low + BEVEL), (1.0, high - BEVEL), (INSET, high))
    plate = solid(np.stack([at_height(scale * ring, z * length) for scale, z in heights]))
    radius = HINGE * gripper.cup_width / 2
    stem = solid(lathe([(radius, (high - BEVEL) * length), (radius, 0.0)], SIDES))
    return plate, stem, hinge_patch(gripper)


def _cup_patches(gripper: Gripper, tops: Sequence[float]) -> list[Patch]:
    """Surface of each cup, which ends in the body whose lower side is at `tops` [cup lengths]."""
    places = zip(gripper.cups, tops, strict=True)
    return [cup_patch(gripper, top + BEVEL).translate(x, y, 0.0) for (x, y), top in places]


def _plate_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the plate: at most 32 vertices."""
    points = np.concatenate([at_height(_outline(gripper, 2), z * gripper.cup_length) for z in PLATE])
    return simplify_hull(points, len(points))


def cup_collider(gripper: Gripper, place: tuple[float, float] = (0.0, 0.0), top: float = 0.0, taper: float = HINGE) -> ConvexPiece:
    """Build the collision shape of the cup at a place [m], without bellows: lip, and a cone up to the wrist axis or the body at `top` [cup
    lengths], where its radius is `taper` of the cup's; at most 32 vertices."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    points = np.concatenate([lip, lathe([(taper * radius, top * length)], STEM_SIDES)[0]]) + np.array([*place, 0.0])
    return simplify_hull(points, len(points))


HEADS: Mapping[str, Callable[[Gripper], Head]] = {SUCTION1: make_cup, SUCTION_ARRAY: make_cup_array}
"""Builder of the head, by `gripper.kind`; other kinds are plug-ins (`system/plugins.py`)."""


def make_head(gripper: Gripper) -> Head:
    """Build the head of the gripper that the settings name."""
    build = HEADS.get(gripper.kind) or load_plugin("grippers", gripper.kind, "make_head", "BEHAVIOR").make_head
    return build(gripper)


def check_reach(gripper: Gripper, suction: Suction, catalog: Catalog) -> None:
    """Refuse cups of which none can lie on an object that is gripped at the tool centre point. Raises ConfigError: the nearest cup is
    farther from it than the largest diameter of the catalog."""
    nearest = min(math.hypot(*place) for place in make_head(gripper).cups)
    largest = max(entry.diameter for entry in catalog.entries)
    if nearest - suction.radius > largest:
        raise ConfigError(
            f"no cup of gripper.cups reaches an object: the nearest is {nearest:g} m from the tool centre point, where objects are "
            f"gripped, and the largest object has a diameter of {largest:.3g} m; move the cups nearer"
        )
