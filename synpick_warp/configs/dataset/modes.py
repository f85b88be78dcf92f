"""Modes (gripper tasks) that the episodes of a bake, or of one of its splits, can have."""

from __future__ import annotations

from collections.abc import Sequence

from synpick_warp.configs.schema import CYCLE, MIXED, MODES, Bake, Split


def mode_weights(bake: Bake, mode: str | None = None) -> dict[str, float]:
    """Unnormalized probability of each of MODES in a bake of mode `mode` (None: bake.mode); 0: never."""
    mode = bake.mode if mode is None else mode
    if mode == MIXED:
        return dict(zip(MODES, bake.mix, strict=True))
    return {name: float(mode in (name, CYCLE)) for name in MODES}


def bake_modes(bake: Bake, splits: Sequence[Split]) -> tuple[str, ...]:
    """Modes of the settings, each once: those of the splits, or without splits `bake.mode`."""
    return tuple(dict.fromkeys(split.mode for split in splits)) or (bake.mode,)


def possible_modes(bake: Bake, splits: Sequence[Split]) -> set[str]:
    """Modes of MODES that episodes of a data set with these settings can have."""
    return {name for mode in bake_modes(bake, splits) for name, weight in mode_weights(bake, mode).items() if weight > 0.0}


def may_pick(bake: Bake, splits: Sequence[Split]) -> bool:
    """Whether a bake can have episodes in mode pick or target."""
    return not possible_modes(bake, splits).isdisjoint({"pick", "target"})
