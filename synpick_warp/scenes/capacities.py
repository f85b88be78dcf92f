"""Capacities of a world for contacts, pairs of shapes and constraint rows, from the shapes of the catalog's objects and of the bins; and
fills by `arrangement.counts`: numbers of each object, and whether they fit into the bins."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.episodes.objects import Counts
from synpick_warp.configs.schema import LAYERED, Arrangement, Physics
from synpick_warp.errors import ConfigError, format_value, suggest
from synpick_warp.scenes.bins import Bin
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece
from synpick_warp.system.linear_algebra import dot, eigh, matmul

# Contacts of two convex shapes side by side, and such pairs of an object with floor and walls: a pile of 24 plates of 1 mm has up to 713.
_PAIR_CONTACTS, _FIXTURES = 5, 1.5
# Where shapes beside an object are counted, as fractions of the way from the middle of a compartment to its corners.
_SHARES = (0.25, 0.5, 0.75, 1.0)
FEW = 32
"""Objects of a world for which the settings' capacities suffice, if these are thicker than the contact margin."""
FEW_CONTACTS = 512 / 24
"""Contacts of each object of which there are many, at least: as the default settings have for theirs. Piles of 150 brackets and boxes have
up to 14 and 7 an object."""
MAX_CONTACTS = 4096
"""Contacts of a world that few thin objects get at most, 1 MB on a GPU."""
MAX_ROWS = 3072
"""Rows of a world that few thin objects get at most: `contact_sweep.MAX_SHARED_ROWS`, up to which a GPU keeps them in shared memory.
Contacts take two rows each, where a pile rests."""
CONTACT_ROWS = 3
"""Rows of a contact at most: its normal, and two of friction."""
MIN_SIDE = 1e-5
"""Least side of a box about an object [m]."""


def with_capacities(physics: Physics, count: int, catalog: Catalog, bins: Sequence[Bin] = (), counts: Counts = ()) -> Physics:
    """Raise the capacities of a world of at most `count` objects if these are many, or some are thinner than the contact margin, so touch
    through others, or if bins have more shapes beside an object than a box has.

    The margin of a fast shape and a fixed one is twice `physics.gap`; at rest it is less. Within a margin m of an object of side lengths
    a, b, c there is room for about (a + 2 m)(b + 2 m)(c + 2 m) / (a b c) - 1 others of its kind: 23 for plates of 100 x 80 x 1 mm. Up to
    FEW objects that are thicker than the margin keep the capacities of the settings. Many have contacts in proportion to their number, and
    three rows for each, so that rows cannot run out before contacts do. `count`: capacity for objects of a world. `bins`: the bins; without
    any, walls and floor of a box are counted. `counts`: `arrangement.counts`; the remaining room of `count` is for distractors."""
    margin, needed = 2.0 * physics.gap, 0.0
    reach = float(np.mean([entry.radius for entry in catalog.bodies])) + margin
    shapes = max((_count_beside(one, reach) for one in bins if one.is_detailed), default=_FIXTURES)
    fixtures = max(shapes, _FIXTURES)
    many, each = _contacts_of_many(catalog, margin, fixtures, count, counts)
    if shapes > _FIXTURES:
        needed = physics.contacts_per_world + _PAIR_CONTACTS * (shapes - _FIXTURES) * count
    for entry in catalog.bodies:
        if oriented_sides(entry.pieces).min() < margin:
            needed = max(needed, _contacts_of(entry, margin, fixtures, count))
    contacts = int(np.ceil(many)) if many else min(int(np.ceil(needed)), max(MAX_CONTACTS, physics.contacts_per_world))
    if contacts <= physics.contacts_per_world:
        return physics
    share = contacts / physics.contacts_per_world
    rows = CONTACT_ROWS * contacts
    return replace(
        physics,
        contacts_per_world=contacts,
        pairs_per_world=round(share * physics.pairs_per_world),
        rows_per_world=max(physics.rows_per_world, rows if many else min(rows, MAX_ROWS)),
        gripper_rows_per_world=round((each / FEW_CONTACTS if many else share) * physics.gripper_rows_per_world),
    )


def _contacts_of(entry: CatalogEntry, margin: float, fixtures: float, count: int) -> float:
    """Contacts of a pile of `count` objects of a kind. `margin`: distance up to which two shapes have contacts [m]. `fixtures`: shapes of a
    bin beside each object."""
    sides = np.sort(oriented_sides(entry.pieces))
    neighbors = float(np.prod(sides + 2.0 * margin) / np.prod(sides)) - 1.0
    pairs = min(count * neighbors, count * (count - 1)) / 2.0 + fixtures * count
    return _PAIR_CONTACTS * pairs * len(entry.pieces)


def _contacts_of_many(catalog: Catalog, margin: float, fixtures: float, count: int, counts: Counts) -> tuple[float, float]:
    """Contacts of a world of many objects, and the most of an object among them; 0 and 0 for few objects.

    Arguments as in `_contacts_of`, and `with_capacities`.
    """
    numbers = count_entries(counts, catalog)[:, 1]
    room = count if not counts else count - int(numbers.sum()) if catalog.distractors else 0
    total = int(numbers.sum()) + room
    if total <= FEW:
        return 0.0, 0.0
    each = np.array([max(FEW_CONTACTS, _contacts_of(entry, margin, fixtures, total) / total) for entry in catalog.bodies])
    drawn = each[len(numbers) :] if counts else each
    counted = each[: len(numbers)][numbers > 0]
    most = max(counted.max(initial=0.0), drawn.max(initial=0.0))
    return float(dot(counted, numbers[numbers > 0])) + room * float(drawn.max(initial=0.0)), float(most)


def _count_beside(one: Bin, reach: float) -> float:
    """Mean number of a bin's collision shapes beside an object on its floor, in proportion to _FIXTURES of a box.

    Over a grid of places in all compartments, shapes are counted whose planes are within `reach`, the object's bounding radius and margin
    [m]; and so are floor and walls of boxes as large as the compartments.
    """
    planes = [ConvexHull(piece.vertices.astype(np.float64)).equations for piece in one.pieces]
    shapes, sides = 0, 0
    for floor, *parts in zip(one.sizes.floors, *(one.sizes.waypoints(k, reach) for k in _SHARES), strict=True):
        places, half = np.concatenate(parts), np.array(floor[2:4]) / 2.0
        sides += len(places) + int((half - np.abs(places[:, :2] - floor[:2]) <= reach).sum())
        shapes += sum(int(((matmul(places, each[:, :3].T) + each[:, 3]).max(axis=1) <= reach).sum()) for each in planes)
    return _FIXTURES * shapes / sides


def oriented_sides(pieces: Sequence[ConvexPiece]) -> np.ndarray:
    """Side lengths (3) [m] of a box about convex pieces, along their principal axes."""
    points = np.concatenate([piece.vertices for piece in pieces]).astype(np.float64)
    centered = points - points.mean(axis=0)
    return np.maximum(np.ptp(matmul(centered, eigh(matmul(centered.T, centered))[1][:, ::-1]), axis=0), MIN_SIDE)


_DENSEST = 0.74
"""Packing fraction of the densest packing of equal spheres, π / √18; dropped parts stay below."""
_MOST_NAMED = 12
"""Most objects that a message names."""


def count_entries(counts: Counts, catalog: Catalog) -> np.ndarray:
    """Least and largest number of each entry of the catalog in an episode (entry, 2) int32; zero without counts.

    A part is the name of an object, or its obj_id. Raises ConfigError: there is no such object, or there are several."""
    numbers = np.zeros((len(catalog.entries), 2), np.int32)
    for part, low, high in counts:
        named = [index for index, entry in enumerate(catalog.entries) if entry.name == part]
        found = named or [index for index, entry in enumerate(catalog.entries) if str(entry.obj_id) == part]
        if len(found) != 1 or numbers[found].any():
            names = [entry.name for entry in catalog.entries]
            listed = ", ".join(names[:_MOST_NAMED]) + (f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else "")
            what = "which no object has" if not found else "which is set already" if len(found) == 1 else f"which {len(found)} objects have"
            raise ConfigError(
                f"arrangement.counts names {format_value(part)}, {what}; allowed: each of {listed}, or an obj_id{suggest(part, names)}"
            )
        numbers[found[0]] = low, high
    return numbers


def drop_height(most: np.ndarray, radius: np.ndarray, arrangement: Arrangement, sizes: BinSizes) -> float:
    """Height of the stack from which a bin's objects begin to fall [m], by `kernels.sim.drop.drop_objects_kernel`. `most`: largest number
    of each object in an episode (entry). `radius`: bounding radii (entry) [m]. `sizes`: the bin; in layers its compartments are taken to
    have equal shares of the objects."""
    if arrangement.drop != LAYERED:
        return float(dot(most, 2.0 * radius + arrangement.clearance))
    pitch = float(2.0 * radius[most > 0].max(initial=0.0) + arrangement.clearance)
    cells = sum(max(1, int(length / pitch)) * max(1, int(width / pitch)) for *_, length, width in sizes.openings)
    return pitch * math.ceil(int(most.sum()) / cells)


def check_fill(arrangement: Arrangement, guide_height: float, catalog: Catalog, bins: Sequence[BinSizes]) -> None:
    """Refuse parts by `counts` that do not fit into each bin with walls, at the densest packing of spheres, or between its guide walls.
    Raises ConfigError: they do not, or `count_entries` refuses a part."""
    if not arrangement.counts:
        return
    most = count_entries(arrangement.counts, catalog)[:, 1]
    volume, radius = (np.array([getattr(entry, name) for entry in catalog.entries]) for name in ("volume", "radius"))
    volume = float(dot(most, volume))
    for sizes in bins:
        height = drop_height(most, radius, arrangement, sizes)
        if height > guide_height:
            other = f'set arrangement.drop = "{LAYERED}"' if arrangement.drop != LAYERED else "raise physics.guide_height"
            raise ConfigError(
                f"the {most.sum()} parts of arrangement.counts begin to fall from up to {height:.3g} m above the {sizes.noun}, but the "
                f"walls that guide them are {guide_height:g} m high; {other}, or take fewer"
            )
        inside = sizes.height * (np.prod(sizes.floor) + np.prod(sizes.opening)) / 2.0
        if sizes.shell is not None and volume > _DENSEST * inside:
            raise ConfigError(
                f"arrangement.counts asks for parts of {1e3 * volume:.3g} l together, but the {sizes.noun} has room for "
                f"{1e3 * _DENSEST * inside:.3g} l of parts; take fewer, or a larger bin"
            )
