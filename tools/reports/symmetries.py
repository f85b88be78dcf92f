"""Detected symmetries beside those that models_info.json states, as a table with the reasons for differences.

    python -m tools.reports.symmetries MODELS [--tolerance 0.03]

BOP's lists are geometric, within 0.1 of the diameter and at least 15 mm, and then without what texture tells apart, as people judged.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synpick_warp.configs.episodes.objects import Objects
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import ModelInfo, bop_obj_id, read_models_info
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.symmetries.detection import find_symmetries, turn_matrix
from synpick_warp.scenes.symmetries.groups import describe_counts
from synpick_warp.scenes.symmetries.surface import Surface

_MILLIMETRE = 1e-3
_SAME = np.cos(np.radians(8.0))
"""Cosine of the angle up to which axes are the same; published matrices are fitted, and up to 3° off."""
HEADER = ("object", "stated", "detected", "stated ones move it by", "detected ones by", "verdict")


@dataclass(frozen=True)
class Comparison:
    """Stated and detected symmetries of an object: (discrete, continuous) each, largest distances in diameters, and the verdict."""

    obj_id: int
    stated: tuple[int, int]
    detected: tuple[int, int]
    stated_off: float
    detected_off: float
    verdict: str

    def cells(self) -> tuple[str, ...]:
        """Cells of the table's row."""
        shares = (f"{100 * off:.1f} %" if counts != (0, 0) else "" for counts, off in self._pairs())
        return str(self.obj_id), describe_counts(*self.stated), describe_counts(*self.detected), *shares, self.verdict

    def _pairs(self) -> Iterator[tuple[tuple[int, int], float]]:
        yield self.stated, self.stated_off
        yield self.detected, self.detected_off


def compare(folder: Path, obj_ids: Iterable[int], tolerance: float) -> Iterator[Comparison]:
    """Compare objects of a BOP model folder; `tolerance`: of the detection, in diameters."""
    infos = read_models_info(folder / "models_info.json", obj_ids)
    for obj_id, info in sorted(infos.items()):
        mesh, _ = read_mesh(folder / f"obj_{obj_id:06d}.ply", _MILLIMETRE)
        diameter = hull_size(mesh.vertices).diameter
        found = find_symmetries(mesh.vertices, mesh.faces, diameter, tolerance * diameter)
        ours = _moves(found.discrete, [(turn.axis, turn.point) for turn in found.continuous])
        stated = _stated(info)
        surface = Surface(mesh.vertices, mesh.faces)
        off = max((surface.deviation(matrix) for matrix in stated), default=0.0) / diameter
        counts = (len(found.discrete), len(found.continuous))
        lacking = [move for move in stated if not _holds(move, found.discrete, [turn.axis for turn in found.continuous])]
        axes = [np.array(axis) for axis, _ in info.symmetries_continuous]
        beyond = [move for move in ours if not _holds(move, np.reshape(info.symmetries_discrete, (-1, 4, 4)), axes)]
        own_off = max([*found.deviations, *(turn.deviation for turn in found.continuous)], default=0.0) / diameter
        verdict = _verdict(len(lacking), len(beyond), off, tolerance)
        yield Comparison(obj_id, (len(info.symmetries_discrete), len(axes)), counts, off, own_off, verdict)


def _stated(info: ModelInfo) -> list[np.ndarray]:
    """Transforms by which stated symmetries are tried."""
    matrices = np.reshape(info.symmetries_discrete, (-1, 4, 4))
    return _moves(matrices, [(np.array(axis), np.array(point)) for axis, point in info.symmetries_continuous])


def _moves(discrete: np.ndarray, axes: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Discrete symmetries, and some angles of continuous ones, as 4 x 4 matrices."""
    return [*discrete, *(turn_matrix(axis, point, angle) for axis, point in axes for angle in (1.0, 2.0, np.pi))]


def _holds(move: np.ndarray, discrete: np.ndarray, axes: list[np.ndarray]) -> bool:
    """Whether a rotation is a discrete symmetry, or about a continuous axis, or turns such an axis over as a discrete one does."""
    rotation = move[:3, :3]

    def turned(axis: np.ndarray, by: np.ndarray) -> float:
        return float(axis @ by[:3, :3] @ axis)

    if any(
        turned(axis, move) > _SAME or (turned(axis, move) < -_SAME and any(turned(axis, flip) < -_SAME for flip in discrete))
        for axis in axes
    ):
        return True
    return any((np.trace(rotation.T @ other[:3, :3]) - 1.0) / 2.0 > _SAME for other in discrete)


def _verdict(lacking: int, beyond: int, off: float, tolerance: float) -> str:
    """Describe how detected and listed symmetries compare, with the reason for a difference."""
    parts = []
    if lacking:
        reason = f"{100 * off:.1f} % are more than {100 * tolerance:g} %" if off > tolerance else "not found"
        parts.append(f"lacks what is stated: {reason}")
    if beyond:
        parts.append("more than stated: shape alone, which texture tells apart")
    return "; ".join(parts) or "the same"


def main() -> None:
    """Print the table of a folder of BOP models."""
    parser = argparse.ArgumentParser(description="Compare detected symmetries with those that models_info.json states.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tolerance", type=float, default=Objects().symmetry_tolerance)
    given = parser.parse_args()
    ids = sorted(obj_id for file in given.folder.glob("*.ply") if (obj_id := bop_obj_id(file)) is not None)
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    for row in compare(given.folder, ids, given.tolerance):
        print(f"| {' | '.join(row.cells())} |", flush=True)


if __name__ == "__main__":
    main()
