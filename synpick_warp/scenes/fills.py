"""Fills of the catalog's objects by `arrangement.counts`: numbers of each entry, and whether they fit into the bins."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.episodes.objects import Counts
from synpick_warp.configs.schema import LAYERED, Arrangement
from synpick_warp.errors import ConfigError, format_value, suggest
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.linear_algebra import dot

_DENSEST = 0.74
"""Packing fraction of the densest packing of equal spheres, π / √18; dropped parts stay below."""
_MOST_NAMED = 12
"""Most objects that a message names."""


def count_entries(counts: Counts, catalog: Catalog) -> np.ndarray:
    """Least and largest number of each entry of the catalog in an episode (entry, 2) int32; zero without counts.

    A part is the name of an object, or its obj_id.

    Raises:
        ConfigError: There is no such object, or there are several.
    """
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
    """Height of the stack from which a bin's objects begin to fall [m], by `kernels.sim.drop.drop_objects_kernel`.

    Args:
        most: Largest number of each object in an episode (entry).
        radius: Bounding radii (entry) [m].
        arrangement: Settings of the drop.
        sizes: The bin; in layers its compartments are taken to have equal shares of the objects.
    """
    if arrangement.drop != LAYERED:
        return float(dot(most, 2.0 * radius + arrangement.clearance))
    pitch = float(2.0 * radius[most > 0].max(initial=0.0) + arrangement.clearance)
    cells = sum(max(1, int(length / pitch)) * max(1, int(width / pitch)) for *_, length, width in sizes.openings)
    return pitch * math.ceil(int(most.sum()) / cells)


def check_fill(arrangement: Arrangement, guide_height: float, catalog: Catalog, bins: Sequence[BinSizes]) -> None:
    """Refuse parts by `counts` that do not fit into each bin with walls, at the densest packing of spheres, or between its guide walls.

    Raises:
        ConfigError: They do not, or `count_entries` refuses a part.
    """
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
