"""Settings file of a new cell: cameras, bin, parts and randomization as commented TOML, each setting with meaning, unit and range."""

import shlex
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from synpick_warp.configs.cell.bins import BinRow, BinSizes
from synpick_warp.configs.cell.cameras import Jitter, Pose
from synpick_warp.configs.cell.gripper import COMPLIANCE, FLOW, Gripper
from synpick_warp.configs.check import is_table
from synpick_warp.configs.episodes.objects import MESH
from synpick_warp.configs.episodes.randomize import ColorDistribution, Distribution
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import describe_setting, format_toml, sections, table_lists
from synpick_warp.configs.files.table_lists import given_values

WIDTH = 120
"""Longest comment line [characters]."""
_WRAPPER = textwrap.TextWrapper(WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False, break_on_hyphens=False)
FILL, _FEW = 0.1, 4
"""Volume of an episode's objects, as a fraction of the bin's, and their largest number: a few minutes on a CPU."""
VACUUM = 60.0
"""Vacuum below a tight cup [kPa]: an ejector's at 4 bar of compressed air or more has 50 to 85."""
_HEAD = """Cell {name}: cameras, bin, parts and what is randomized. Meaning, unit and allowed values stand above each setting.
Lines that begin with # and a key, as in #seed = 7, are examples: remove the # to use them.

    synpick-warp preview --cell {file}             # picture of the cell, after a change
    synpick-warp bake --config {file} --out DATA   # a small data set

All settings: `synpick-warp config --config {file}`, and configs/README.md."""


@dataclass(frozen=True)
class NewCell:
    """What a new cell consists of."""

    cameras: Sequence[Mapping[str, Any]]
    """Settings of each in [[camera]]."""
    bin: BinRow
    models: str = ""
    """Folder of the parts; empty: the embedded objects."""
    unit: str = ""
    """Unit of their files."""
    density: float | None = None
    """Density of their material [kg/m³]; None: not known."""
    mass: float | None = None
    """Mass of each [kg]; None: by the density."""
    weighed: Sequence[tuple[int, str]] = ()
    """obj_id and name of each part that has the mass."""
    center: bool = False
    """Whether parts are moved to their middle."""
    volume: float = 0.0
    """Least volume budget [m³]."""
    perception: tuple[int, int] = (640, 480)
    """Image size of perception [px]."""


def cell_toml(cell: NewCell, name: str) -> str:
    """TOML text of a cell; `name`: its folder."""
    inside, shape, shapes = _bin(cell.bin)
    volume = float(f"{max(FILL * inside, cell.volume):.2g}")
    parts = {"unit": cell.unit, "center": cell.center, "symmetries": "detect"} if cell.models else {}
    mass = {"id": 1, "name": "NAME", "diameter": 0.0, "mass": 0.1, "metallic": 0.6, "roughness": 0.3}
    if cell.density is not None:
        parts |= {"density": cell.density, "mass_volume": MESH}
    lines = [*(f"# {line}".rstrip() for line in _HEAD.format(name=name, file=shlex.quote(f"{name}/cell.toml")).splitlines()), ""]
    lines += ['# Preset below these settings: "smoke" is small and fast, to try a cell; "synpick" is for training.', 'preset = "smoke"', ""]
    models = {"models": cell.models} if cell.models else {}
    lines += _section("bake", {"mode": "pick", "worlds": 1, "episodes": 1, **models}, {"seed": 7, "formats": ("bop", "zarr")})
    lines += _title("Cameras")
    for index, camera in enumerate(cell.cameras):
        lines += _table("[[camera]]", "camera", camera, {}, first=index == 0)
    lines += _table("#[[camera]]", "camera", {}, _MEASURED)
    lines += _section("perception", {"camera": cell.cameras[0]["name"], "resolution": cell.perception}, {})
    lines += _title("Bin")
    lines += _section("bins", {"kind": "own"}, {"shift": (0.02, 0.02), "yaw": 5.0})
    lines += _table("[[bin]]", "bin", shape, shapes)
    lines += _title("Gripper")
    lines += _section("gripper", {"cup_width": Gripper().cup_width}, {})
    lines += _section("suction", {"vacuum": VACUUM, "flow": FLOW, "compliance": COMPLIANCE}, {})
    lines += _title("Parts")
    lines += _section("arrangement", {"volume": volume, "max_objects": _FEW}, {})
    examples = {"density": 7850.0} if cell.models and cell.density is None else {"unit": "mm", "symmetries": "detect"}
    lines += _section("objects", parts, {} if cell.density is not None else examples)
    for index, (obj_id, name) in enumerate(cell.weighed):
        row = {"id": obj_id, "name": name, "diameter": 0.0, "mass": cell.mass}
        lines += _table("[[object_rows]]", "object_rows", row, {}, first=index == 0)
    lines += [] if cell.weighed else _table("#[[object_rows]]", "object_rows", {}, mass)
    lines += _title("Domain randomization, drawn for each episode: a value or a distribution")
    lines += _section("randomize", {}, _RANDOMIZED)
    lines += _section("effects", {}, {"exposure_jitter": 0.3, "shot_noise": (0.0, 0.01), "blur": (0.0, 0.8)})
    lines += _title("Layers, and the sensor of the layer depth_sensor")
    lines += _section("render", {}, {"layers": ("normals", "nocs")})
    lines += _section("depth_sensor", {}, {"preset": "d435"})
    return "\n".join(lines).rstrip() + "\n"


def _bin(row: BinRow) -> tuple[float, dict[str, Any], dict[str, Any]]:
    """Volume of the inside of a bin [m³], its settings, and examples of others."""
    if row.measured:
        height = row.measured.height
        inside = sum(
            (length * width + opening[2] * opening[3]) / 2.0 * (height - a * x - b * y - c)
            for (x, y, length, width, a, b, c), opening in zip(row.measured.compartments, BinSizes.of_row(row).openings, strict=True)
        )
        given = {name: value for name in ("name", "file", "unit", "up", "collision") if (value := getattr(row, name)) is not None}
        return inside, given, {"color": row.color}
    height = row.outer_size[2] - row.wall
    inside = height * sum(side[0] * side[1] for side in (row.floor_size, row.rim_size)) / 2.0
    shape = {name: getattr(row, name) for name in ("name", "outer_size", "floor_size", "rim_size", "wall", "color")}
    return inside, shape, {"compartments": (2, 1), "divider_height": round(height / 2.0, 3)}


_MEASURED: dict[str, Any] = {
    "name": "measured",
    "resolution": (640, 480),
    "matrix": ((610.0, 0.0, 325.4), (0.0, 609.2, 238.9), (0.0, 0.0, 1.0)),
    "distortion": (-0.12, 0.08, 0.0005, -0.0003, 0.0),
    "model": "pinhole",
    "pose": Pose(matrix=((1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 1.5), (0.0, 0.0, 0.0, 1.0))),
    "jitter": Jitter(Distribution("normal", ((0.0,), (0.002,))), Distribution("normal", ((0.0,), (0.2,)))),
}
"""Example of a camera with lens and pose by numbers, and with jitter of the pose about them."""
_RANDOMIZED: dict[str, Any] = {
    "object_hue": Distribution("normal", ((0.0,), (10.0,))),
    "object_brightness": Distribution("log_uniform", ((0.7,), (1.4,))),
    "object_roughness": Distribution("uniform", ((0.15,), (0.9,))),
    "object_metallic": Distribution("choice", ((0.0,), (1.0,)), (3.0, 1.0)),
    "bin_color": ColorDistribution("uniform", ((0.02, 0.02, 0.02), (0.9, 0.9, 0.9))),
    "bin_roughness": Distribution("uniform", ((0.2,), (0.9,))),
    "table_color": ColorDistribution("uniform", ((0.05, 0.05, 0.05), (0.9, 0.9, 0.9))),
    "table_roughness": Distribution("uniform", ((0.3,), (0.9,))),
    "lamps": Distribution("uniform", ((0.0,), (2.0,))),
}
"""Examples of distributions, of all kinds; most are those of the preset `randomized`."""


def bin_of_size(outer: tuple[float, float, float]) -> BinRow:
    """An open box of an outer size [m], as injection-moulded bins are: walls with a draft of 2°, and a rim as wide as two walls."""
    wall = min(0.005, min(outer) / 20.0)
    height = outer[2] - wall
    rim = (outer[0] - 4.0 * wall, outer[1] - 4.0 * wall)
    floor = tuple(round(side - 2.0 * _DRAFT * height, 4) for side in rim)
    row = replace(BinRow(), name="bin", outer_size=outer, wall=round(wall, 5))
    return replace(row, rim_size=tuple(round(side, 4) for side in rim), floor_size=floor)


_DRAFT = 0.035
"""Tangent of 2°."""


def _title(text: str) -> list[str]:
    return [f"# ---- {text} ----", ""]


def _section(section: str, values: Mapping[str, Any], examples: Mapping[str, Any]) -> list[str]:
    """Lines of a section, with settings and with examples that are commented out."""
    return _table(f"[{section}]", section, values, examples)


def _table(header: str, name: str, values: Mapping[str, Any], examples: Mapping[str, Any], *, first: bool = True) -> list[str]:
    """Lines of a section or of a row; only the first row of a list explains its settings."""
    known = settings_of(sections().get(name) or table_lists()[name])
    lines = [header]
    for mark, settings in (("", values), ("#", examples)):
        for key, value in settings.items():
            lines += _WRAPPER.wrap(describe_setting(known[key])) if first else []
            lines.append(f"{mark}{key} = {format_toml(given_values(value) if is_table(type(value)) else value)}")
    return [*lines, ""]
