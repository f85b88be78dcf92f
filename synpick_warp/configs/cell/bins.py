"""Settings of the bins that stand under the cameras, and their extents; a table and a pallet are bins without walls. Settings of props:
what stands around the bin, or hangs on the gripper, and is no object."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

from synpick_warp.configs.cell.cameras import GRIPPER, WORLD, Pose
from synpick_warp.configs.episodes.objects import UNITS
from synpick_warp.configs.fields import Color, Fraction, setting
from synpick_warp.errors import ConfigError, format_value

TOTE, OWN, NONE, PALLET = "tote", "own", "none", "pallet"
KINDS = (TOTE, OWN, NONE, PALLET)
"""What stands under the cameras."""


@dataclass(frozen=True)
class Tote:
    """The tote, an open box. The world frame has its origin at the centre of the inner floor, z up. Sizes of the released mesh."""

    outer_size: Annotated[tuple[float, float, float], "(0, 10] m"] = setting((0.615, 0.373, 0.200), "Outer length, width and height.")
    floor_size: Annotated[tuple[float, float], "(0, 10] m"] = setting((0.513, 0.319), "Length and width of the inner floor.")
    rim_size: Annotated[tuple[float, float], "(0, 10] m"] = setting((0.545, 0.352), "Length and width of the opening at the rim.")
    wall: Annotated[float, "(0, 1] m"] = setting(0.0045, "Thickness of walls and floor.")
    color: Color = setting((0.65, 0.05, 0.04), "Base colour.")
    metallic: Fraction = setting(0.0, "Metallic factor.")
    roughness: Fraction = setting(0.5, "Roughness.")


AXES = ("z", "-z", "y", "-y", "x", "-x")
"""Axes of a mesh file, of which one points up."""
FLOOR, FILE = "floor", "file"
PLACES = (FLOOR, FILE)
"""Where the frame of a bin's mesh lies."""
MESH, BOX = "mesh", "box"
COLLISIONS = (MESH, BOX)
"""What a bin's mesh collides as."""


@dataclass(frozen=True)
class MeasuredBin:
    """What the mesh of a bin measures in the bin's frame: origin below the middle of the opening, on the lowest inner point, z up, x and y
    along its sides."""

    REQUIRED: ClassVar = ("box", "opening", "height", "compartments", "checksum")
    box: Annotated[tuple[float, float, float, float, float, float], "m"] = setting((0.0,) * 6, "Lower and upper corner of the mesh.")
    opening: Annotated[tuple[float, float], "(0, inf) m"] = setting((0.0, 0.0), "Length and width of the inside at the rim.")
    floor: Annotated[tuple[float, float] | None, "(0, inf) m"] = setting(
        None, "Length and width of the floor from wall to wall; as the opening unless it is given."
    )
    height: Annotated[float, "(0, inf) m"] = setting(0.0, "Height of the rim, over which the inside would spill.")
    origin: Annotated[tuple[float, float, float], "m"] = setting((0.0, 0.0, 0.0), "Origin of the bin's frame in the world.")
    yaw: Annotated[float | None, "°"] = setting(None, "Angle about z of the bin's frame in the world; 0 unless it is given.")
    compartments: Annotated[tuple[tuple[float, float, float, float, float, float, float], ...], "m"] = setting(
        (), "Floor of each compartment: centre x, y, length, width, and height z = a x + b y + c."
    )
    openings: Annotated[tuple[tuple[float, float, float, float], ...] | None, "m"] = setting(
        None, "Opening of each compartment: centre x, y, length, width; as the floors unless it is given."
    )
    checksum: str = setting("", "SHA-256 of the mesh and its material.")


@dataclass(frozen=True)
class BinRow(Tote):
    """A bin of bins.kind = "own", an open box or a mesh. An episode draws one by weight."""

    REQUIRED: ClassVar = ("name",)
    name: str = setting("", "Unique name of at most 32 lower-case letters, digits and underscores.")
    weight: Annotated[float, "[0, 1e6]"] = setting(1.0, "Weight with which an episode draws it.")
    compartments: Annotated[tuple[int, int], "[1, 6]"] = setting((1, 1), "Columns (along x) and rows of compartments of equal floors.")
    divider_height: Annotated[float, "(0, 10] m"] = setting(0.1, "Height of the dividers between compartments.")
    file: str | None = setting(None, "Mesh (.stl, .ply, .obj, .glb, .gltf, .step) instead of sizes and compartments.", path=True)
    unit: str | None = setting(None, "Unit of the mesh; m unless it is given.", choices=tuple(UNITS))
    up: str | None = setting(None, "Axis of the mesh that points up; z unless it is given.", choices=AXES)
    place: str | None = setting(
        None,
        "Where the mesh lies: floor (default: its lowest inner point is the world's z = 0, below the middle of its opening) or file (the "
        "mesh's origin is the world's; later bins stand on the table of the first).",
        choices=PLACES,
    )
    collision: str | None = setting(
        None, "What the mesh collides as: mesh (default) or box (a closed one, for baskets of wire).", choices=COLLISIONS
    )
    measured: MeasuredBin | None = setting(None, "What the mesh measures; the program writes this table.")

    @property
    def replaced(self) -> tuple[str, ...]:
        """Names of the settings that its mesh stands for."""
        return _SIZES if self.file else ()


@dataclass(frozen=True)
class Bins:
    """What stands under the cameras. The frame of a table or pallet has its origin on top."""

    kind: str = setting(
        TOTE, "What objects are dropped into or onto: tote ([tote]), own (drawn from [[bin]]), none (the table), pallet.", choices=KINDS
    )
    shift: Annotated[tuple[float, float], "[0, 1] m"] = setting((0.0, 0.0), "Half widths of each episode's random offset in x and y.")
    yaw: Annotated[float, "[0, 180] °"] = setting(0.0, "Half width of each episode's random rotation about z.")
    area: Annotated[tuple[float, float], "(0, 10] m"] = setting(
        (0.5, 0.35), "Length and width over which objects are dropped without walls."
    )
    margin: Annotated[float, "[0, 5] m"] = setting(0.15, "Without walls, an object that is farther outside of the area has left.")
    pallet_size: Annotated[tuple[float, float, float], "(0, 10] m"] = setting(
        (0.6, 0.4, 0.144), "Length, width and height of the pallet; half a EUR pallet by default."
    )


_SIZES = ("outer_size", "floor_size", "rim_size", "wall", "compartments", "divider_height")
"""Keys of a [[bin]] table that its mesh stands for."""
_OF_FILE = ("unit", "up", "place", "collision", "measured")
"""Keys that say how a mesh is read, or what it is."""


def check_meshes(tables: object, source: str) -> None:
    """Check which keys stand together in [[bin]] tables; anything that is no such table is passed over. `source`: where the tables come
    from, for messages. Raises ConfigError: a file stands beside sizes, or something that belongs to a file without one."""
    for index, table in enumerate(tables if isinstance(tables, list) else ()):
        names = () if not isinstance(table, dict) else _SIZES if table.get("file", "") else _OF_FILE
        if others := [name for name in names if name in table]:
            rule = "none beside bin.file, whose mesh has it" if names is _SIZES else "none without bin.file"
            raise ConfigError(f"bin[{index}].{others[0]} is {format_value(table[others[0]])} {source}; allowed: {rule}")


Sides = tuple[float, float]
"""Length (along x) and width (along y) [m]."""
Point = tuple[float, float, float]
Rectangle = tuple[float, float, float, float]
Floor = tuple[float, float, float, float, float, float, float]
DIVIDER = 0.01
"""Thickness of dividers [m]: more than an object at physics.max_speed moves in one step."""


@dataclass(frozen=True)
class BinSizes:
    """Extents of a bin [m] in its own frame: origin at the centre of the inner floor, z up."""

    name: str
    noun: str
    """What it is, in sentences: tote, bin, pallet or table."""
    shell: Tote | None
    """Dimensions and material of the walls, or their mesh file; None: a bin without walls."""
    outer: Sides
    floor: Sides
    """Inner floor."""
    opening: Sides
    """At the rim; without walls, the area over which objects are dropped."""
    height: float
    """Height of the rim."""
    base: float
    """z of its underside."""
    margin: float = 0.0
    """Distance from the opening beyond which an object has left it."""
    weight: float = 1.0
    """Weight with which an episode draws it."""
    compartments: tuple[int, int] = (1, 1)
    """Columns (along x) and rows (along y)."""
    divider_height: float = 0.0
    measured: MeasuredBin | None = None
    """Of a bin whose mesh has been read."""

    @classmethod
    def of_tote(cls, tote: Tote, name: str = TOTE, noun: str = TOTE) -> "BinSizes":
        """Sizes of the tote, or of a box like it."""
        height = tote.outer_size[2] - tote.wall
        return cls(name, noun, tote, tote.outer_size[:2], tote.floor_size, tote.rim_size, height, -tote.wall)

    @classmethod
    def of_row(cls, row: BinRow) -> "BinSizes":
        """Sizes of a row of [[bin]]; one with a file must be measured."""
        if (found := row.measured) is not None:
            x, y = (2 * max(abs(found.box[axis]), abs(found.box[axis + 3])) for axis in (0, 1))
            floor = found.floor or found.opening
            return cls(row.name, "bin", row, (x, y), floor, found.opening, found.height, found.box[2], weight=row.weight, measured=found)
        sizes = cls.of_tote(row, row.name, "bin")
        return replace(sizes, weight=row.weight, compartments=row.compartments, divider_height=row.divider_height)

    @property
    def is_visible(self) -> bool:
        """Whether there is anything but the table."""
        return self.noun != "table"

    @property
    def origin(self) -> Point:
        """Origin of its frame in the world, without shift, if it is the first bin."""
        return self.measured.origin if self.measured else (0.0, 0.0, 0.0)

    @property
    def turn(self) -> float:
        """Yaw of the bin's frame in the world [rad], without the random yaw of an episode."""
        return math.radians(self.measured.yaw or 0.0) if self.measured else 0.0

    @property
    def ground(self) -> float:
        """Height of the underside of the floor in the world [m]; the table is at that of the first bin."""
        return self.origin[2] + self.base

    def to_world(self, point: Point) -> Point:
        """Point of its frame in the world, without shift, if it is the first bin."""
        cosine, sine = math.cos(self.turn), math.sin(self.turn)
        (x, y, z), at = point, self.origin
        return at[0] + cosine * x - sine * y, at[1] + sine * x + cosine * y, at[2] + z

    def to_frame(self, point: Sequence[float]) -> Point:
        """Point of the world in its frame; the inverse of `to_world`."""
        cosine, sine = math.cos(self.turn), math.sin(self.turn)
        x, y, z = (value - begin for value, begin in zip(point, self.origin, strict=True))
        return cosine * x + sine * y, cosine * y - sine * x, z

    @property
    def corners(self) -> list[Point]:
        """Corners of the outer box in the world (8)."""
        length, width = (side / 2 for side in self.outer)
        return [self.to_world(one) for one in itertools.product((-length, length), (-width, width), (self.base, self.height))]

    @property
    def _centers(self) -> list[Sides]:
        columns, rows = (
            [-side / 2 + cell / 2 + index * (cell + DIVIDER) for index in range(count)] if count > 1 else [0.0]
            for side, cell, count in zip(self.floor, self.cell, self.compartments, strict=True)
        )
        return list(itertools.product(columns, rows))

    @property
    def cell(self) -> Sides:
        """Inner floor of a compartment."""
        length, width = (
            (side - (count - 1) * DIVIDER) / count if count > 1 else side for side, count in zip(self.floor, self.compartments, strict=True)
        )
        return length, width

    @property
    def openings(self) -> Sequence[Rectangle]:
        """Opening of each compartment: centre x, y, length and width; over its floor, where a box has several."""
        if self.measured:
            return self.measured.openings or [one[:4] for one in self.measured.compartments]
        return [(*center, *(self.opening if self.compartments == (1, 1) else self.cell)) for center in self._centers]

    @property
    def mouth(self) -> Sides:
        """Length and width of the smallest opening."""
        return min((one[2:] for one in self.openings), key=min)

    @property
    def floors(self) -> Sequence[Floor]:
        """Inner floor of each compartment: centre x, y, length and width; and its height z = a x + b y + c."""
        return self.measured.compartments if self.measured else [(*center, *self.cell, 0.0, 0.0, 0.0) for center in self._centers]

    def waypoints(self, corner: float, height: float) -> list[list[Point]]:
        """Points near the four corners of each compartment: `corner` is where they are, as a fraction of the way from the centre to the
        corners of the floor, `height` their height above the floor [m]."""
        return [
            [(x, y, a * x + b * y + c + height) for y in (cy + corner * width / 2, cy - corner * width / 2) for x in (cx + s, cx - s)]
            for cx, cy, length, width, a, b, c in self.floors
            for s in (corner * length / 2,)
        ]

    @property
    def inner_corners(self) -> list[Point]:
        """Corners of the inner floor and of the rim in the world (8)."""
        levels = ((self.floor, 0.0), (self.opening, self.height))
        signs = list(itertools.product((-1, 1), repeat=2))
        return [self.to_world((x * length / 2, y * width / 2, z)) for (length, width), z in levels for x, y in signs]


@dataclass(frozen=True)
class Cell:
    """What stands under the cameras: the bins from which an episode draws its own."""

    bins: tuple[BinSizes, ...]
    """Extents of the bins; the first stands on the table, whose height follows from its base."""
    tables: Mapping[str, Tote]
    """Settings of the bins with walls of sizes, not of a mesh, by their keys: tote, or bin[0] and so on."""
    recorded: tuple[str, ...]
    """Names of the bins, where data sets record that of each episode; empty for a tote that is always in its place."""

    @classmethod
    def of(cls, tote: Tote, bins: Bins, rows: tuple[BinRow, ...]) -> "Cell":
        """The cell of these settings."""
        tables: dict[str, Tote] = {}
        if bins.kind == NONE:
            sizes: tuple[BinSizes, ...] = (BinSizes("table", "table", None, bins.area, bins.area, bins.area, 0.0, 0.0, bins.margin),)
        elif bins.kind == PALLET:
            length, width, height = bins.pallet_size
            sizes = (BinSizes("pallet", "pallet", None, (length, width), bins.area, bins.area, 0.0, -height, bins.margin),)
        elif bins.kind == OWN and rows:
            sizes = tuple(BinSizes.of_row(row) for row in rows)
            tables = {f"bin[{index}]": row for index, row in enumerate(rows) if not row.file}
        else:
            sizes = (BinSizes.of_tote(tote),)
            tables = {TOTE: tote} if bins.kind == TOTE else {}
        stays = bins.kind == TOTE and not any(bins.shift) and bins.yaw == 0.0
        return cls(sizes, tables, () if stays else tuple(one.name for one in sizes))


CONVEYOR, FRAME = "conveyor", "frame"
EMBEDDED = (CONVEYOR, FRAME)
"""Names of the embedded props."""


@dataclass(frozen=True)
class PropRow:
    """A prop: scenery that is drawn, hides objects, casts shadows and is mirrored, but has no label. Not in the paper."""

    REQUIRED: ClassVar = ("name", "mesh", "pose")
    name: str = setting("", "Unique name of at most 32 lower-case letters, digits and underscores, a letter first.")
    mesh: str = setting(
        "",
        "Mesh file (.stl, .ply, .obj, .glb, .gltf, .step), in metres, or the name of an embedded prop.",
        choices=EMBEDDED,
        allowed=f"a path, in a file relative to it, or {', '.join(EMBEDDED)}",
        path=True,
    )
    pose: Pose = setting(Pose(), "Pose in the tote's frame, as of a camera in whose axes the mesh is; a position alone: without rotation.")
    scale: Annotated[float, "(0, 1e4]"] = setting(1.0, "Factor on the mesh, such as 0.001 for a file in millimetres.")
    collide: bool = setting(False, "Collide, as the convex hull of each connected part of the mesh.")
    follows: str = setting(
        WORLD,
        "What carries the prop: the world, or the gripper (the pose is in the frame of its shaft, and the layer suction_seal takes the "
        "prop for an obstacle).",
        choices=(WORLD, GRIPPER),
    )
