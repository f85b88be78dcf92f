"""Vacuum of suction cups: rays over a cup's mouth find where air enters, and the flow balance of leak and ejector gives the break force.

Air enters where the mouth is not covered by the object that the cup seals with, and below or beside the lip where the surface falls away
faster than the lip follows. The ejector's characteristic is linear, p = p₀ (1 - Q / Q₀), and a leak of area A is an orifice,
Q = C_d A sqrt(2 p / ρ).
With s = sqrt(p / p₀) and k = A C_d sqrt(2 p₀ / ρ) / Q₀ that is s² + k s = 1. A cup holds p times the covered area of its mouth.
"""

import warp as wp

from synpick_warp.kernels.bitsets import pack_word
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.sim.cup_rays import CUP, SurfaceData, first_hit, suction_begins, tcp_pose
from synpick_warp.kernels.state import Attempts, Motion, Seals, Worlds
from synpick_warp.kernels.structs import CupData, LayoutData, PickData, SuctionData

wp.set_module_options({"enable_backward": False})

BACK = wp.constant(0.01)
"""Rays start this far above the lip [m]: a mesh can stand out of the collision shape on which the cup rests."""
NOWHERE = wp.constant(1.0e3)
"""Beyond any surface [m]."""
GOOD = wp.constant(0.5)
"""A seal is good if at least this fraction of the vacuum is left, as a vacuum switch confirms a part."""


@wp.struct
class MouthData:
    """Rays over the mouth of a cup, its lip and its ejector; see `configs.cell.gripper.Suction`."""

    ray: wp.array[wp.vec3]
    """(ray): place x, y in the TCP frame [m] and share of the mouth's area [m²]; those on the lip, which have none, first, by angle."""
    lip: int
    radius: float
    """Radius of the lip [m]."""
    compliance: float
    """Height that the lip follows [m]."""
    tilt: float
    """Largest slope of a surface on which the lip lies flat, since the cup tilts."""
    pressure: float
    """Vacuum of a tight cup, p₀ [Pa]."""
    leak: float
    """k of a leak, by its area [1/m²]."""


@wp.struct
class Leak:
    """Where air enters below a cup."""

    instance: int
    """Instance that the cup seals with; -1: none."""
    hits: int
    """Rays that hit it."""
    covered: float
    """Area of the mouth that it covers [m²]."""
    open: float
    """Area through which air enters [m²]."""


@wp.struct
class MouthRays:
    """What lies below the rays of a cup's mouth, and what follows for the cup; scratch."""

    depth: wp.array3d[float]
    """(world, cup, ray): depth of the first surface below the lip [m]."""
    owner: wp.array3d[int]
    """(world, cup, ray): its instance; -1: none."""
    leak: wp.array2d[Leak]
    """(world, cup): where air enters."""


@wp.kernel
def cast_mouth_rays_kernel(
    layout: LayoutData,
    pick: PickData,
    suction: SuctionData,
    cups: CupData,
    surface: SurfaceData,
    mouth: MouthData,
    state: Worlds,
    attempts: Attempts,
    motion: Motion,
    rays_out: MouthRays,
):
    """Write what lies below each ray of a cup's mouth where suction is switched on: instance, -1 for none, and its depth below the lip.

    Launched over world, cup, ray.
    """
    world, cup, ray = wp.tid()
    if not suction_begins(state, attempts, world, pick):
        return
    tcp_in_world = tcp_pose(motion.body_q[world * layout.bodies + CUP], cups.place[cup])
    place = mouth.ray[ray]
    start = wp.transform_point(tcp_in_world, wp.vec3(place[0], place[1], BACK))
    direction = wp.transform_vector(tcp_in_world, wp.vec3(0.0, 0.0, -1.0))
    # A ray passes through the whole of each object: it ends at the bottom of a pocket, however deep, but not in a hole.
    distance, hit = first_hit(start, direction, BACK + suction.reach, 2.0, layout, surface, world, state, motion)
    rays_out.depth[world, cup, ray] = distance - BACK
    rays_out.owner[world, cup, ray] = hit


@wp.func
def count_owner(instance: int, world: int, cup: int, reach: float, rays: MouthRays) -> int:
    """Number of a cup's rays that hit an instance within reach."""
    count = int(0)
    for ray in range(rays.owner.shape[2]):
        if rays.owner[world, cup, ray] == instance and rays.depth[world, cup, ray] <= reach:
            count += 1
    return count


@wp.func
def lip_slope(instance: int, world: int, cup: int, reach: float, mouth: MouthData, rays: MouthRays) -> wp.vec2:
    """Slope of the plane through the surface below the lip (least squares), to which the cup tilts; 0 where the lip stands out."""
    slope = wp.vec2(0.0, 0.0)
    for ray in range(mouth.lip):
        if rays.owner[world, cup, ray] != instance or rays.depth[world, cup, ray] > reach:
            return wp.vec2(0.0, 0.0)
        slope += rays.depth[world, cup, ray] * wp.vec2(mouth.ray[ray][0], mouth.ray[ray][1])
    slope *= 2.0 / (float(mouth.lip) * mouth.radius * mouth.radius)
    return slope * wp.min(1.0, mouth.tilt / wp.max(wp.length(slope), 1.0e-9))


@wp.func
def drop_below(ray: int, world: int, cup: int, slope: wp.vec2, mouth: MouthData, rays: MouthRays) -> float:
    """Depth of the surface below the plane of the tilted lip at a ray [m]."""
    place = mouth.ray[ray]
    return rays.depth[world, cup, ray] - slope[0] * place[0] - slope[1] * place[1]


@wp.func
def gap_below_lip(
    ray: int, instance: int, world: int, cup: int, top: float, slope: wp.vec2, mouth: MouthData, reach: float, rays: MouthRays
) -> float:
    """Height of the gap between lip and surface at a ray of the lip [m].

    The lip rests on the highest point below the mouth. It follows the surface down to its compliance c, and along its length with a slope
    of at most c / r, that of a cylinder on which it just seals: the lowest position with both bounds that is nowhere below the surface.
    """
    lowest = float(mouth.compliance)
    for other in range(mouth.lip):
        if rays.owner[world, cup, other] == instance and rays.depth[world, cup, other] <= reach:
            apart = wp.abs(ray - other)
            way = mouth.compliance * TAU * float(wp.min(apart, mouth.lip - apart)) / float(mouth.lip)
            lowest = wp.min(lowest, drop_below(other, world, cup, slope, mouth, rays) - top + way)
    return drop_below(ray, world, cup, slope, mouth, rays) - top - lowest


@wp.func
def gap_beside_lip(ray: int, instance: int, world: int, cup: int, top: float, slope: wp.vec2, mouth: MouthData, rays: MouthRays) -> float:
    """Distance from a ray of the lip that misses the object to its surface, less that in the plane of the lip [m].

    The open area of the mouth counts the latter. A ball that is hardly narrower than the cup leaves none, and falls away below the lip.
    """
    across = float(NOWHERE)
    way = float(NOWHERE)
    place = mouth.ray[ray]
    for other in range(rays.owner.shape[2]):
        if rays.owner[world, cup, other] == instance:
            apart = wp.length(wp.vec2(place[0] - mouth.ray[other][0], place[1] - mouth.ray[other][1]))
            drop = wp.max(drop_below(other, world, cup, slope, mouth, rays) - top - mouth.compliance, 0.0)
            across = wp.min(across, apart)
            way = wp.min(way, wp.length(wp.vec2(apart, drop)))
    return way - across


@wp.kernel
def measure_leaks_kernel(pick: PickData, suction: SuctionData, mouth: MouthData, state: Worlds, attempts: Attempts, rays_inout: MouthRays):
    """Measure where air enters below each cup where suction is switched on.

    A cup seals with the instance that most of its rays hit, the first of several: between two objects, or beside one, air enters. Launched
    over world, cup.
    """
    world, cup = wp.tid()
    if not suction_begins(state, attempts, world, pick):
        return
    leak = Leak()
    leak.instance = -1
    for ray in range(rays_inout.owner.shape[2]):
        instance = rays_inout.owner[world, cup, ray]
        if instance >= 0 and (ray == 0 or rays_inout.owner[world, cup, ray - 1] != instance):
            count = count_owner(instance, world, cup, suction.reach, rays_inout)
            if count > leak.hits or (count == leak.hits and instance < leak.instance):
                leak.instance = instance
                leak.hits = count
    slope = lip_slope(leak.instance, world, cup, suction.reach, mouth, rays_inout)
    top = float(suction.reach)
    for ray in range(rays_inout.owner.shape[2]):
        covered = leak.instance >= 0 and rays_inout.owner[world, cup, ray] == leak.instance
        if covered and (ray >= mouth.lip or rays_inout.depth[world, cup, ray] <= suction.reach):
            leak.covered += mouth.ray[ray][2]
            top = wp.min(top, drop_below(ray, world, cup, slope, mouth, rays_inout))
        else:
            leak.open += mouth.ray[ray][2]
    arc = TAU * mouth.radius / float(mouth.lip)
    for ray in range(mouth.lip):
        if leak.instance >= 0 and rays_inout.owner[world, cup, ray] == leak.instance and rays_inout.depth[world, cup, ray] <= suction.reach:
            leak.open += arc * gap_below_lip(ray, leak.instance, world, cup, top, slope, mouth, suction.reach, rays_inout)
        elif leak.instance >= 0:
            leak.open += arc * gap_beside_lip(ray, leak.instance, world, cup, top, slope, mouth, rays_inout)
    rays_inout.leak[world, cup] = leak


@wp.func
def vacuum_left(open: float, mouth: MouthData) -> float:
    """Vacuum relative to that of a tight cup, s², with a leak of an area [m²]: s² + k s = 1."""
    k = mouth.leak * open
    s = 2.0 / (k + wp.sqrt(k * k + 4.0))
    return s * s


@wp.kernel
def set_vacuum_kernel(
    layout: LayoutData,
    pick: PickData,
    cups: CupData,
    mouth: MouthData,
    state: Worlds,
    attempts_inout: Attempts,
    seals_inout: Seals,
    rays: MouthRays,
):
    """Attach objects and set break forces where suction is switched on; outputs as of `count_seal_rays_kernel`.

    A cup that has nothing below it has the break force 0. With a common valve the leaks of all cups add up. Launched over world.
    """
    world = wp.tid()
    if not suction_begins(state, attempts_inout, world, pick):
        return
    for instance in range(layout.instances):
        seals_inout.attached[world, instance] = 0
    total = float(0.0)
    for cup in range(cups.count):
        total += rays.leak[world, cup].open
    hits = int(0)
    sealed = int(0)
    for cup in range(cups.count):
        below = rays.leak[world, cup]
        left = vacuum_left(wp.where(cups.common_valve != 0, total, below.open), mouth)
        seals_inout.break_force[world, cup] = mouth.pressure * left * below.covered
        if below.instance >= 0:
            hits += below.hits
            seals_inout.attached[world, below.instance] = seals_inout.attached[world, below.instance] | (1 << cup)
            if left >= GOOD:
                sealed = sealed | (1 << cup)
    attempts_inout.hits[world] = wp.vec2i(hits, sealed)
    for word in range(attempts_inout.engaged_words.shape[1]):
        attempts_inout.engaged_words[world, word] = pack_word(seals_inout.attached, state.catalog_index, world, word)
