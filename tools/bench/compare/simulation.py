"""Benchmark of a physics engine on a pile: rate while it falls and lands, rate and calm at rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import Tote
from tools.bench.compare.engines import Engine
from tools.bench.compare.piles import Pile
from tools.options import Row
from tools.reports.rest import is_inside

FALL_STEPS, LEAD_STEPS, REST_STEPS = 250, 500, 250
"""Time steps of a fall, of settling from our pile at rest into the engine's, and of the measurement at rest."""


def measure_engine(engine: Engine, tote: Tote, pile: Pile) -> Iterator[Row]:
    """Benchmark of an engine. A world-step is `physics.step` of simulated time for all engines."""
    engine.start(pile.lift())
    worlds = f"{engine.worlds} worlds of {len(pile.entries)} objects"
    yield Row(f"{engine.name}, {worlds}, falling: world-steps", _rate(engine, FALL_STEPS), "1/s")
    engine.start(pile)
    engine.run(LEAD_STEPS)
    yield Row(f"{engine.name}, at rest: world-steps", _rate(engine, REST_STEPS), "1/s")
    position, velocity = engine.bodies()
    speed = 1e3 * np.linalg.norm(velocity, axis=-1)
    yield Row(f"{engine.name}, at rest: mean speed", float(speed.mean()), "mm/s")
    yield Row(f"{engine.name}, at rest: median speed", float(np.median(speed)), "mm/s")
    moved = np.linalg.norm(position - pile.pose[:, :3], axis=-1)
    yield Row(f"{engine.name}, at rest: mean distance from the start", 1e3 * float(moved.mean()), "mm")
    yield Row(
        f"{engine.name}, at rest: objects in the tote",
        100.0 * float(is_inside(BinSizes.of_tote(tote), position.reshape(-1, 3)).mean()),
        "%",
    )


def _rate(engine: Engine, steps: int) -> float:
    """World-steps per second of the next `steps` steps."""
    return steps * engine.worlds / engine.run(steps)
