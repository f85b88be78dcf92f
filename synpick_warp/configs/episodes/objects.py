"""Settings of objects, and part counts of an episode's bin (`arrangement.counts`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import hypot
from typing import Annotated, Any, ClassVar

from synpick_warp.configs.fields import INT32_MAX, Fraction, setting

AUTO_UNIT = "auto"
"""Unit of mesh files by their kind: millimetres of BOP models, metres of others."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Units of mesh files [m]."""
HOUSEHOLD, INDUSTRIAL = "household", "industrial"
EMBEDDED = (HOUSEHOLD, INDUSTRIAL)
"""Sets of embedded objects."""
HULL, MESH = "hull", "mesh"
"""Volumes that a density is multiplied by."""
MASS_RANGE = (1e-7, 1e4)
"""Allowed masses [kg]: others have no useful inverse in 32-bit floats."""
MATERIALS = {
    "abs": 1050.0,
    "aluminium": 2700.0,
    "brass": 8500.0,
    "cast-iron": 7200.0,
    "copper": 8960.0,
    "glass": 2500.0,
    "nylon": 1140.0,
    "petg": 1270.0,
    "pla": 1240.0,
    "pom": 1410.0,
    "pp": 905.0,
    "stainless-steel": 7900.0,
    "steel": 7850.0,
    "titanium": 4500.0,
    "zinc": 7140.0,
}
"""Typical densities of solid materials, as data sheets give them [kg/m³]."""
DECLARED, DETECT = "declared", "detect"
SYMMETRIES = (DECLARED, DETECT)
"""Sources of an object's symmetries."""
MAX_FOLD = 72
"""Largest fold that can be declared."""
_TURN = "an axis that is not zero and a fold from 2 to 72, with an offset [m] or without: { axis = [0, 0, 1], fold = 2 }"
_DISCRETE = f"{_TURN}; or a rigid 4 x 4 matrix, row by row [m]"
_CONTINUOUS = "an axis that is not zero, with an offset [m] or without: { axis = [0, 0, 1], offset = [0, 0, 0] }"
_RIGID = 1e-3
"""Tolerance of the elements of a rotation: published matrices have six digits."""


def _parse_each(value: Any, flatten: Callable[[Any], list[Any]], rule: str) -> Any:
    """Convert each symmetry of a list; raises ValueError with the rule."""
    if not isinstance(value, list | tuple):
        raise ValueError(f"a list of symmetries, each {rule}")
    rows = []
    for one in value:
        row = flatten(one)
        if not all(isinstance(number, int | float) and not isinstance(number, bool) and abs(number) < 1e9 for number in row):
            raise ValueError(rule)
        if not (_is_rigid(row) if len(row) == 16 else len(row) in (3, 4, 6, 7) and hypot(*row[:3]) > 0.0):
            raise ValueError(rule)
        rows.append(row)
    return rows


def _flatten_discrete(one: Any) -> list[Any]:
    """Numbers of a discrete symmetry: 16 of a matrix, or axis, fold and offset, if there is one; none if its form is another one."""
    if isinstance(one, dict) and {"axis", "fold"} <= one.keys() <= {"axis", "fold", "offset"}:
        one = [*_triple(one["axis"]), one["fold"], *(_triple(one["offset"]) if "offset" in one else ())]
    elif isinstance(one, dict) and one.keys() == {"matrix"}:
        one = one["matrix"]
    row = list(one) if isinstance(one, list | tuple) else []
    if len(row) == 4 and all(isinstance(line, list | tuple) and len(line) == 4 for line in row):
        row = [number for line in row for number in line]
    is_turn = len(row) in (4, 7) and isinstance(row[3], int | float) and row[3] in range(2, MAX_FOLD + 1)
    return row if is_turn or len(row) == 16 else []


def _flatten_continuous(one: Any) -> list[Any]:
    """Numbers of a continuous symmetry: axis, and offset, if there is one; none if its form is another one."""
    if isinstance(one, dict) and {"axis"} <= one.keys() <= {"axis", "offset"}:
        one = [*_triple(one["axis"]), *(_triple(one["offset"]) if "offset" in one else ())]
    row = list(one) if isinstance(one, list | tuple) else []
    return row if len(row) in (3, 6) else []


def _triple(value: Any) -> list[Any]:
    """A list of three elements; of others one that no number is in."""
    return list(value) if isinstance(value, list | tuple) and len(value) == 3 else [None]


def _is_rigid(row: list[Any]) -> bool:
    """Whether 16 numbers are a rotation and a translation, row by row."""
    a, b, c = row[0:3], row[4:7], row[8:11]
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    lengths = (sum(x * x for x in one) - 1.0 for one in (a, b))
    offs = (*lengths, sum(x * y for x, y in zip(a, b, strict=True)), *(x - y for x, y in zip(c, cross, strict=True)))
    last = (*row[12:15], row[15] - 1.0)
    return max(abs(off) for off in (*offs, *last)) <= _RIGID


@dataclass(frozen=True)
class Objects:
    """How a mesh becomes a rigid body: collision shape, mass and material."""

    embedded: tuple[str, ...] = setting(
        (HOUSEHOLD,),
        "Embedded objects, where bake.models is empty: household (21, like those of YCB-Video), industrial (bolt, nut, bracket, pipe_tee, "
        "gear, sheet_part, box).",
        choices=EMBEDDED,
    )
    unit: str = setting(
        AUTO_UNIT,
        "Unit of all mesh files; auto: mm for BOP models (obj_NNNNNN.ply), m for others. STEP files name their own.",
        choices=(AUTO_UNIT, *UNITS),
    )
    hull_vertices: Annotated[int, "[8, 256]"] = setting(64, "Maximum vertices of a convex hull.")
    piece_vertices: Annotated[int, "[8, 256]"] = setting(32, "Maximum vertices of each piece of a convex decomposition.")
    pieces: Annotated[int, "[1, 64]"] = setting(16, "Maximum pieces of a convex decomposition.")
    concavity: Annotated[float, "[0.01, 1]"] = setting(0.05, "CoACD's concavity threshold; smaller values follow the surface more closely.")
    decomposition_time: Annotated[float, "(0, 86400] s"] = setting(
        1800.0, "Maximum processor time of a convex decomposition; longer is an error."
    )
    concave_ratio: Fraction = setting(
        0.6,
        "Objects whose row does not say whether they are concave are decomposed if 1 - depth is below this. Depth: largest distance of "
        "the convex hull from the surface, in halves of the hull's thickness (hollow ball 0, tube 0.8, bowl or bracket above 1).",
    )
    strict: bool = setting(False, "End the bake at the first object or light map that cannot be used, instead of leaving it out.")
    density: Annotated[float, "(0, 1e5] kg/m³"] = setting(
        400.0, "Density of objects without a mass; not set: the mass is a guess, and named as one."
    )
    mass_volume: str = setting(
        HULL,
        "Volume for the density: hull (convex hull) or mesh (where it is watertight, else the collision shape; the default where density "
        "is set).",
        choices=(HULL, MESH),
    )
    metallic: Fraction = setting(0.1, "Metallic factor of objects whose material names none.")
    roughness: Fraction = setting(0.5, "Roughness of objects whose material names none.")
    crease_angle: Annotated[float, "[0, 180] °"] = setting(
        35.0, "Meshes without normals are smooth where triangles meet at up to this angle; 180: all over."
    )
    center: bool = setting(False, "Move the centre of each mesh's bounding box to its origin, except of BOP models.")
    symmetries: str = setting(
        DECLARED,
        "Symmetries: declared (of their rows, else of models_info.json), or detect (of objects that declare none, by shape alone).",
        choices=SYMMETRIES,
    )
    symmetry_tolerance: Annotated[float, "[1e-3, 0.2]"] = setting(
        0.03, "Largest distance between a surface and its rotated self for a detected symmetry, in diameters (BOP: 0.1, at least 15 mm)."
    )
    diameter_tolerance: Annotated[float, "(0, 1]"] = setting(
        0.1, "Largest relative difference between a model's diameter and that of its row; with more, the row is not used."
    )


@dataclass(frozen=True)
class ObjectRow:
    """Physical and material properties that model files do not contain."""

    REQUIRED: ClassVar = ("id", "diameter")
    IDENTITY: ClassVar = ("id", "name", "diameter", "symmetries_discrete", "symmetries_continuous")
    id: Annotated[int, f"[0, {INT32_MAX}]"] = setting(0, "The model's obj_id in its BOP folder.")
    name: str = setting("", "Name; of meshes that are not BOP models the file name without suffix.")
    diameter: Annotated[float, "[0, inf) m"] = setting(0.0, "Diameter of the model, which must agree; 0: any.")
    mass: Annotated[float | None, "(0, inf) kg"] = setting(None, "Mass; not given: by objects.density.")
    concave: bool | None = setting(
        None, "Use a convex decomposition as collision shape instead of the convex hull; not given: by objects.concave_ratio."
    )
    metallic: Fraction = setting(0.1, "Metallic factor, unless the mesh file names one.")
    roughness: Fraction = setting(0.5, "Roughness, unless the mesh file names one.")
    symmetries_discrete: Annotated[tuple[tuple[float, ...], ...], "m"] = setting(
        (),
        f"Discrete symmetries in the frame of the mesh file, replacing those of models_info.json; each {_DISCRETE}. Without an offset the "
        "axis passes through the centroid of the surface. Products of those listed are added.",
        parse=partial(_parse_each, flatten=_flatten_discrete, rule=_DISCRETE),
    )
    symmetries_continuous: Annotated[tuple[tuple[float, ...], ...], "m"] = setting(
        (),
        f"Continuous symmetries, as symmetries_discrete; each {_CONTINUOUS}.",
        parse=partial(_parse_each, flatten=_flatten_continuous, rule=_CONTINUOUS),
    )


Counts = tuple[tuple[str, int, int], ...]
"""Part, least and largest number of it, each part once."""
COUNTS = "a table of parts with their numbers, or least and largest numbers: { bracket = 12 } or { bolt = [4, 8], nut = 8 }"


def parse_counts(value: Any) -> Any:
    """Lists [part, least, most] of a table; such lists, which config.toml has, stay as they are. Raises ValueError: it is none, a number is
    not allowed, or a part comes twice."""
    rows = value
    if isinstance(value, Mapping):
        rows = [[name, *(number if isinstance(number, list | tuple) else (number, number))] for name, number in value.items()]
    if not isinstance(rows, list | tuple) or not all(isinstance(row, list | tuple) and len(row) == 3 for row in rows):
        raise ValueError(COUNTS)
    if not all(isinstance(row[0], str) and row[0] and all(type(number) is int for number in row[1:]) for row in rows):
        raise ValueError(COUNTS)
    if not all(0 <= low <= high <= INT32_MAX and high > 0 for _, low, high in rows):
        raise ValueError("numbers of at least 1, or [least, most] with least at most most")
    if len({row[0] for row in rows}) < len(rows):
        raise ValueError("each part once")
    return rows


def most_objects(counts: Counts) -> int:
    """Largest number of an episode's objects."""
    return sum(most for _, _, most in counts)
