"""Settings of the bins that stand under the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

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
