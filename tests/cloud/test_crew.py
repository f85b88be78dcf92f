"""Rate, remaining time and cost of a crew of workers, from its counts."""

from __future__ import annotations

import pytest

from synpick_warp.cloud.crew import Crew, CrewProgress
from synpick_warp.system.progress import SilentProgress
from tests.builders import mistake

COUNTS = [
    # time, episodes done, worlds, views; episodes shown, rate, remaining time
    (40.0, 0, 4, 0, 20, 0.0, None),
    (50.0, 0, 4, 100, 20, 10.0, None),
    (60.0, 2, 4, 200, 22, 10.0, 380.0),  # 4 of 80 episodes in 20 s; half of each that runs.
    (110.0, 12, 4, 1200, 32, 1100 / 60, (80 - 14) * 1200 / 14 / (1100 / 60)),  # The last 60 s.
    (170.0, 80, 0, 2400, 100, 20.0, 0.0),
]


def test_an_hour_of_two_workers_has_its_price_and_the_remaining_time_follows_from_the_last_minute():
    now, shown = [0.0], []
    crew, observer = Crew("", price=3.0, alive=2), SilentProgress()
    observer.update = lambda **given: shown.append(given)
    progress = CrewProgress(observer, crew, 20, 100, clock=lambda: now[0])
    for time, episodes, worlds, views, *_ in COUNTS:
        now[0] = time
        progress.update(episodes_done=episodes, episodes=0, worlds_active=worlds, views=views, views_per_s=0.0, seconds_left=None)
    for (_, _, worlds, views, *wanted), given in zip(COUNTS, shown, strict=True):
        assert (given["worlds_active"], given["views"], given["episodes"]) == (worlds, views, 100)
        assert [given[name] for name in ("episodes_done", "views_per_s", "seconds_left")] == pytest.approx(wanted)
    assert crew.seconds == 340.0
    assert str(crew) == "2 workers · cost 0.28"


@pytest.mark.parametrize("given", [("--claim",), ("--devices", "cpu,cpu"), ()])
def test_a_price_is_that_of_workers(given):
    assert "--price also goes with --claim --devices" in mistake("bake", "--config", "smoke", "--out", "s3://b/x", "--price", "2", *given)
