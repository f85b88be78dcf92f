"""Modes (gripper tasks) that the episodes of a bake, or of one of its splits, can have."""

from __future__ import annotations

from synpick_warp.configs.schema import CYCLE, MIXED, MODES, Config


def mode_weights(config: Config, mode: str | None = None) -> dict[str, float]:
    """Unnormalized probability of each of MODES in a bake of mode `mode` (None: bake.mode); 0: never."""
    mode = config.bake.mode if mode is None else mode
    if mode == MIXED:
        return dict(zip(MODES, config.bake.mix, strict=True))
    return {name: float(mode in (name, CYCLE)) for name in MODES}


def bake_modes(config: Config) -> tuple[str, ...]:
    """`bake.mode`, or the modes of the splits."""
    return tuple(dict.fromkeys(split.mode for split in config.splits)) or (config.bake.mode,)


def possible_modes(config: Config) -> set[str]:
    """Those of MODES that episodes of a bake can have."""
    return {name for mode in bake_modes(config) for name, weight in mode_weights(config, mode).items() if weight > 0.0}


def may_pick(config: Config) -> bool:
    """Whether a bake can have episodes in mode pick or target."""
    return not possible_modes(config).isdisjoint({"pick", "target"})
