"""Modes (gripper tasks) that the episodes of a bake can have."""

from __future__ import annotations

from synpick_warp.configs.schema import CYCLE, MIXED, MODES, Config


def mode_weights(config: Config) -> dict[str, float]:
    """Unnormalized probability of each of MODES; 0: never."""
    if config.bake.mode == MIXED:
        return dict(zip(MODES, config.bake.mix, strict=True))
    return {mode: float(config.bake.mode in (mode, CYCLE)) for mode in MODES}


def may_pick(config: Config) -> bool:
    """Whether a bake can have episodes in mode pick or target."""
    weights = mode_weights(config)
    return weights["pick"] > 0.0 or weights["target"] > 0.0
