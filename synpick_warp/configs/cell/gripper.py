"""Settings of the gripper and its suction, and the constraints between them."""

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from synpick_warp.codes import MAX_CUPS
from synpick_warp.configs.episodes.objects import UNITS
from synpick_warp.configs.fields import INT32_MAX, Color, Conflict, Fraction, setting
from synpick_warp.system.plugins import plugin_names

SUCTION1 = "suction1"
SUCTION_ARRAY = "suction_array"
GRIPPERS = (SUCTION1, SUCTION_ARRAY, *plugin_names("grippers", (SUCTION1, SUCTION_ARRAY)))
"""Kinds of gripper: of this package, and of others."""
EACH = "each"
COMMON = "common"
MIN_RAYS = 48
"""Least rays on a lip with `suction.vacuum`: they and those within are so dense that one meets each hole of a tenth of the cup."""
FLOW, COMPLIANCE = 40.0, 0.1
"""Of an ejector [l/min] and of a bellows cup [cup widths], where only `suction.vacuum` is given."""
_ATMOSPHERE = 101.325
"""Pressure of air [kPa]."""
_DENSITY = 1.2
"""Density of air [kg/m³]."""
_DISCHARGE = 0.62
"""Discharge coefficient of a sharp-edged orifice (ISO 5167)."""
_LITRES_PER_MINUTE = 1e-3 / 60.0
"""[m³/s]"""


@dataclass(frozen=True)
class Gripper:
    """A conical shaft that translates along x, y and z, and a head with suction on a wrist joint about the y axis."""

    kind: str = setting(SUCTION1, "Kind: suction1 (one cup) or suction_array (a plate with gripper.cups).", choices=GRIPPERS)
    cups: Annotated[tuple[tuple[float, float], ...], "[-0.5, 0.5] m"] = setting(
        (),
        "Centres [x, y] of the cups of a suction_array: x across the wrist axis, y along it, from the tool centre point; "
        f"at most {MAX_CUPS}.",
    )
    valve: str = setting(
        EACH,
        "Valve of a suction_array: each (one per cup) or common (if one cup leaks or breaks off, all seals are poor).",
        choices=(EACH, COMMON),
    )
    mesh: str = setting(
        "",
        "Mesh (.stl, .ply, .obj, .glb, .gltf, .step) of a suction_array's body: origin on the wrist axis, which is y, cups towards -z. "
        "Empty: a plate.",
        path=True,
    )
    mesh_unit: str = setting("m", "Unit of that mesh.", choices=tuple(UNITS))
    mesh_checksum: str = setting("", "SHA-256 of that mesh; the program writes it.")
    finger_length: Annotated[float, "[0.005, 2] m"] = setting(0.35, "Length of the shaft, from its top to the wrist axis.")
    finger_width: Annotated[float, "[0.005, 1] m"] = setting(0.075, "Diameter of the shaft at its top.")
    cup_width: Annotated[float, "[0.005, 0.5] m"] = setting(0.042, "Diameter of the suction cup.")
    cup_length: Annotated[float, "[0.005, 0.5] m"] = setting(
        0.055, "Distance from the wrist axis to the tool centre point (TCP), the cup's lip."
    )
    finger_mass: Annotated[float, "[0.001, 1e3] kg"] = setting(1.5, "Mass of the shaft.")
    cup_mass: Annotated[float, "[0.001, 1e3] kg"] = setting(0.5, "Mass of the cup.")
    tilt_limit: Annotated[float, "(0, 90] °"] = setting(90.0, "Joint limit of the wrist, to both sides.")
    tilt_stiffness: Annotated[float, "(0, 1e6] N·m/rad"] = setting(2500.0, "Stiffness of the wrist's PD position drive.")
    tilt_damping: Annotated[float, "[0, 1e5] N·m·s/rad"] = setting(200.0, "Damping of the wrist's PD position drive.")
    tilt_torque: Annotated[float, "(0, 1e5] N·m"] = setting(200.0, "Torque limit of the wrist's drive.")
    color: Color = setting((0.55, 0.56, 0.58), "Base colour of the shaft.")
    cup_color: Color = setting((0.05, 0.05, 0.055), "Base colour of the cup.")
    metallic: Fraction = setting(0.01, "Metallic factor of shaft and cup (released).")
    roughness: Fraction = setting(0.9, "Roughness of shaft and cup (released).")


@dataclass(frozen=True)
class Suction:
    """The suction cup: seal test by rays, and a spring-damper that holds attached objects."""

    rays: Annotated[int, "[3, 64]"] = setting(10, "Rays of the seal test, on a circle at the cup's lip (paper).")
    vacuum: Annotated[float | None, f"(0, {_ATMOSPHERE}] kPa"] = setting(
        None,
        "Vacuum below a tight cup, such as 60: a seal then breaks at the vacuum, less leaks, times the covered area of the mouth; it sets "
        "radius, rays, surface and break forces. Not given: good_force and poor_force (paper).",
    )
    flow: Annotated[float | None, "[0.1, 1e5] l/min"] = setting(
        None,
        "Suction rate of the ejector, of a linear characteristic, with an open cup, 40 unless given; small ejectors have 10 to 80.",
    )
    compliance: Annotated[float | None, "[0, 1]"] = setting(
        None,
        "Height that bellows and lip follow, as a fraction of gripper.cup_width, 0.1 unless given: balls from a radius of 1.3 cups seal; "
        "a flat cup has 0.05.",
    )
    radius: Annotated[float, "(0, 0.25] m"] = setting(0.01, "Radius of that circle (released).")
    reach: Annotated[float, "(0, 1] m"] = setting(0.03, "Length of the rays (paper).")
    surface: str = setting(
        "hull",
        "Geometry that the rays intersect: hull (collision shapes, on which the cup rests) or mesh (visual mesh).",
        choices=("hull", "mesh"),
    )
    tolerated_misses: Annotated[int, f"[0, {INT32_MAX}]"] = setting(
        0, "Without vacuum: rays that may miss for a good seal (paper: 0; released: 2)."
    )
    good_force: Annotated[float, "(0, 1e5] N"] = setting(40.0, "Break force of a good seal (paper).")
    poor_force: Annotated[float, "(0, 1e5] N"] = setting(2.0, "Break force of any other seal (paper: 2; released: 0.2).")
    stiffness: Annotated[float, "(0, 1e6] N/m"] = setting(
        2e4, "Linear stiffness of a seal; 40 N stretch it by 2 mm, within the paper's 5 mm."
    )
    damping: Annotated[float, "[0, 1e5] N·s/m"] = setting(100.0, "Linear damping of a seal.")
    twist_stiffness: Annotated[float, "[0, 1e6] N·m/rad"] = setting(50.0, "Torsional stiffness about the cup's axis.")
    twist_damping: Annotated[float, "[0, 1e5] N·m·s/rad"] = setting(0.1, "Angular damping of twist and swing.")
    swing_limit: Annotated[float, "[0, 90] °"] = setting(5.0, "Angle by which an attached object may swing freely (released).")
    swing_stiffness: Annotated[float, "[0, 1e6] N·m/rad"] = setting(50.0, "Stiffness against swing beyond that angle.")

    @property
    def mouth_rays(self) -> int:
        """Rays of the seal test within the lip, nearly as far apart as those on it: none without `vacuum`."""
        return self.rays**2 // 9 if self.vacuum is not None else 0

    @property
    def leak(self) -> float:
        """Flow of a leak relative to `flow`, at the full vacuum and by its area: C_d sqrt(2 p / ρ) / Q [1/m²]."""
        assert self.vacuum is not None
        assert self.flow is not None
        return _DISCHARGE * math.sqrt(2e3 * self.vacuum / _DENSITY) / (_LITRES_PER_MINUTE * self.flow)


def follow_vacuum(gripper: Gripper, suction: Suction, fixed: Collection[str]) -> Suction:
    """Settings of suction that follow from its vacuum, if that is given: the ring is the cup's lip, a good seal holds the vacuum times the
    mouth's area, and any other at least what is left beside an open cup. Those in `fixed` stay as they are.
    """
    if suction.vacuum is None:
        return suction
    radius, plain = gripper.cup_width / 2, Suction()
    chosen = {"rays": MIN_RAYS, "surface": "mesh", "flow": FLOW, "compliance": COMPLIANCE}
    found = replace(suction, **{name: value for name, value in chosen.items() if getattr(suction, name) == getattr(plain, name)})
    force, k = 1e3 * suction.vacuum * math.pi * radius**2, found.leak * math.pi * radius**2
    forces = {"radius": radius, "good_force": force, "poor_force": force * (2.0 / (k + math.sqrt(k * k + 4.0))) ** 2}
    changes = {name: getattr(found, name) for name in chosen} | forces
    return replace(suction, **{name: value for name, value in changes.items() if name not in fixed})


def describe_forces(gripper: Gripper, suction: Suction) -> str:
    """Line about break forces that do not follow from a vacuum."""
    most = 1e3 * _ATMOSPHERE * math.pi * gripper.cup_width**2 / 4
    return (
        f"suction: a seal breaks at {suction.good_force:g} or {suction.poor_force:g} N, as in the paper, whatever cup, holes and gaps "
        f"(full vacuum below this cup: {most:.3g} N); with suction.vacuum = 60 [kPa] it follows from physics"
    )


def find_gripper_conflicts(gripper: Gripper, suction: Suction, mouths: Sequence[tuple[float, float]]) -> Iterator[Conflict]:
    """Yield conflicts of cups, rays and break forces; `mouths` are the sides of the openings of all compartments [m]."""
    max_radius = gripper.cup_width / 2
    yield from _vacuum(gripper, suction)
    if suction.radius > max_radius:
        yield "suction.radius", f"at most half of gripper.cup_width, {max_radius:g} [m]"
    if suction.tolerated_misses >= suction.rays:
        yield "suction.tolerated_misses", f"less than suction.rays, {suction.rays}: one ray must hit"
    if suction.poor_force > suction.good_force:
        yield "suction.poor_force", f"at most suction.good_force, {suction.good_force:g} [N]"
    if gripper.kind == SUCTION1:
        if gripper.cups:
            yield "gripper.cups", f'none with gripper.kind "{gripper.kind}"; set gripper.kind = "{SUCTION_ARRAY}"'
        if gripper.valve != EACH:
            yield "gripper.valve", f'{EACH} with gripper.kind "{gripper.kind}", which has one; set gripper.kind = "{SUCTION_ARRAY}"'
        if gripper.mesh:
            yield "gripper.mesh", f'none with gripper.kind "{gripper.kind}"; set gripper.kind = "{SUCTION_ARRAY}"'
    if gripper.kind != SUCTION_ARRAY:
        return
    if not 1 <= len(gripper.cups) <= MAX_CUPS:
        yield "gripper.cups", f"1 to {MAX_CUPS} places [x, y] with gripper.kind {SUCTION_ARRAY}, such as [[-0.03, 0.0], [0.03, 0.0]]"
        return
    pairs = itertools.combinations(enumerate(gripper.cups), 2)
    distance, first, second = min(((math.dist(a, b), i, j) for (i, a), (j, b) in pairs), default=(math.inf, 0, 0))
    if distance < gripper.cup_width:
        apart = f"{first} and {second} are {distance:g} m apart"
        yield "gripper.cups", f"cups that do not overlap: {apart}, gripper.cup_width is {gripper.cup_width:g}"
    limit = max((min(sides) for sides in mouths), default=math.inf) / 2 - max_radius
    if max(math.hypot(*place) for place in gripper.cups) > limit:
        yield "gripper.cups", f"within {max(limit, 0.0):g} m of the middle: the tool must fit into a compartment, however it is turned"


def _vacuum(gripper: Gripper, suction: Suction) -> Iterator[Conflict]:
    """Yield conflicts of the vacuum with what follows from it, and of settings that only it has."""
    if suction.vacuum is None:
        for name in ("flow", "compliance"):
            if getattr(suction, name) is not None:
                yield f"suction.{name}", "none without suction.vacuum, such as 60 [kPa]"
        return
    if suction.rays < MIN_RAYS:
        yield "suction.rays", f"at least {MIN_RAYS} with suction.vacuum: fewer miss holes of a tenth of the cup"
    if suction.surface != "mesh":
        yield "suction.surface", "mesh with suction.vacuum: collision shapes close holes"
    follows = follow_vacuum(gripper, suction, ())
    for name, unit in (("radius", "m"), ("good_force", "N"), ("poor_force", "N")):
        value = getattr(follows, name)
        if not math.isclose(getattr(suction, name), value, rel_tol=1e-6):
            yield f"suction.{name}", f"none with suction.vacuum, or what follows from it and gripper.cup_width, {value:g} [{unit}]"
