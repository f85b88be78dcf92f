"""Detected symmetries beside those that models_info.json states, as a table with the reasons for differences.

    python -m tools.reports.symmetries MODELS [--tolerance 0.03]

BOP's lists are geometric, within 0.1 of the diameter and at least 15 mm, and then without what texture tells apart, as people judged.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from synpick_warp.configs.episodes.objects import Objects
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import bop_obj_id, read_models_info
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.symmetries.detection import find_symmetries, turn_matrix
from synpick_warp.scenes.symmetries.groups import describe_counts
from synpick_warp.scenes.symmetries.surface import SampledSurface

_MILLIMETRE = 1e-3
_SAME = np.cos(np.radians(8.0))
"""Cosine of the angle up to which axes are the same; published matrices are fitted, and up to 3° off."""
HEADER = ("object", "stated", "detected", "stated ones move it by", "detected ones by", "verdict")


class SymmetryComparison(NamedTuple):
    """Stated and detected symmetries of an object: (discrete, continuous) each, largest distances in diameters, and the verdict."""

    obj_id: int
    stated: tuple[int, int]
    detected: tuple[int, int]
    stated_off: float
    detected_off: float
    verdict: str


class SymmetryGroup(NamedTuple):
    """Symmetries of an object: discrete ones (N, 4, 4), and axes and points of continuous ones."""

    discrete: np.ndarray
    continuous: list[tuple[np.ndarray, np.ndarray]]

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of discrete and of continuous symmetries."""
        return len(self.discrete), len(self.continuous)

    def moves(self) -> list[np.ndarray]:
        """Discrete symmetries, and some angles of continuous ones, as 4 x 4 matrices."""
        return [*self.discrete, *(turn_matrix(axis, point, angle) for axis, point in self.continuous for angle in (1.0, 2.0, np.pi))]

    def holds(self, move: np.ndarray) -> bool:
        """Whether a rotation is a discrete symmetry, or about a continuous axis, or turns such an axis over as a discrete one does."""
        for axis, _ in self.continuous:
            turned, flips = axis @ move[:3, :3] @ axis, [axis @ flip[:3, :3] @ axis < -_SAME for flip in self.discrete]
            if turned > _SAME or (turned < -_SAME and any(flips)):
                return True
        return any((np.trace(move[:3, :3].T @ other[:3, :3]) - 1.0) / 2.0 > _SAME for other in self.discrete)


def compare(folder: Path, obj_ids: Iterable[int], tolerance: float) -> Iterator[SymmetryComparison]:
    """Compare objects of a BOP model folder; `tolerance`: of the detection, in diameters."""
    for obj_id, info in sorted(read_models_info(folder / "models_info.json", obj_ids).items()):
        mesh, _ = read_mesh(folder / f"obj_{obj_id:06d}.ply", _MILLIMETRE)
        diameter = hull_size(mesh.vertices).diameter
        found = find_symmetries(mesh.vertices, mesh.faces, diameter, tolerance * diameter)
        detected = SymmetryGroup(np.reshape(found.discrete, (-1, 4, 4)), [(turn.axis, turn.point) for turn in found.continuous])
        axes = [(np.array(axis), np.array(point)) for axis, point in info.symmetries_continuous]
        stated = SymmetryGroup(np.reshape(info.symmetries_discrete, (-1, 4, 4)), axes)
        surface = SampledSurface(mesh.vertices, mesh.faces)
        off = max((surface.deviation(matrix) for matrix in stated.moves()), default=0.0) / diameter
        own_off = max([*found.deviations, *(turn.deviation for turn in found.continuous)], default=0.0) / diameter
        parts = []
        if not all(map(detected.holds, stated.moves())):
            reason = f"{100 * off:.1f} % are more than {100 * tolerance:g} %" if off > tolerance else "not found"
            parts.append(f"lacks what is stated: {reason}")
        if not all(map(stated.holds, detected.moves())):
            parts.append("more than stated: shape alone, which texture tells apart")
        yield SymmetryComparison(obj_id, stated.counts, detected.counts, off, own_off, "; ".join(parts) or "the same")


def main() -> None:
    """Print the table of a folder of BOP models."""
    parser = argparse.ArgumentParser(description="Compare detected symmetries with those that models_info.json states.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tolerance", type=float, default=Objects().symmetry_tolerance)
    given = parser.parse_args()
    ids = sorted(obj_id for file in given.folder.glob("*.ply") if (obj_id := bop_obj_id(file)) is not None)
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    for row in compare(given.folder, ids, given.tolerance):
        groups = ((row.stated, row.stated_off), (row.detected, row.detected_off))
        shares = (f"{100 * off:.1f} %" if any(counts) else "" for counts, off in groups)
        cells = (str(row.obj_id), *(describe_counts(*counts) for counts, _ in groups), *shares, row.verdict)
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
