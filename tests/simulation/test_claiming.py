"""Claiming workers under a virtual clock: thousands of schedules with deaths, freezes and faults; nothing is lost, nothing made twice."""

from collections.abc import Callable, Iterable

import pytest

from synpick_warp.cloud import claims, run
from synpick_warp.cloud.claims import Claim
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.system.stores import store
from synpick_warp.system.stores.store import Store
from tests.simulation.claiming import Schedule, without_formats
from tests.simulation.scheduler import HungError

SCHEDULES, MOST_SCHEDULES = 200, 2000
"""Schedules of a test, and those in which a planted bug must show; the rarest does in one of 250."""


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    without_formats(monkeypatch)


@pytest.mark.parametrize("block", [0, *(pytest.param(block, marks=pytest.mark.slow) for block in range(1, 100))])
def test_no_schedule_loses_or_repeats_anything(block):
    """A failure names its seed: `Schedule(seed).run()` repeats it."""
    seen = _run_all(range(block * SCHEDULES, (block + 1) * SCHEDULES))
    assert min(seen) > SCHEDULES // 4  # Deaths, freezes and faults have happened.


def test_a_worker_may_die_at_any_point():
    """Enumerated: one of three workers dies at the n-th scheduling point of a schedule, for all n."""
    points = Schedule("deaths", {}, lambda point: False).run().points
    assert points > 150
    for last in range(1, points + 1):
        assert Schedule("deaths", {}, lambda point, last=last: point == last).run().deaths <= 1


def test_a_seed_repeats_its_schedule():
    reports = [Schedule("again").run() for _ in range(3)]
    assert len(set(reports)) == 1
    assert Schedule("other").run() != reports[0]


def _run_all(seeds: Iterable[int]) -> list[int]:
    """Run schedules; returns the numbers of deaths, freezes and faults."""
    seen = [0, 0, 0]
    for seed in seeds:
        try:
            report = Schedule(seed).run()
        except AssertionError as error:
            raise AssertionError(f"Schedule({seed}): {error}") from error
        seen = [count + more for count, more in zip(seen, report[1:4], strict=True)]
    return seen


def _overtaken(self: Store, key: str, data: bytes, tag: str = "") -> str:
    """A write that does not compare."""
    self.put(key, data)
    found = self.get_tagged(key)
    assert found is not None
    return found[1]


def _first_look(self: Ledger) -> bytes | None:
    """As before it was looked for twice: `Ledger._stored_manifest` answers the first look only."""
    try:
        return None if vars(self).setdefault("_looks", []) else self.store.get("manifest.json", 1 << 20)
    except FileNotFoundError:
        self._looks.append(1)
        return None


def _entry_first(self: Ledger, episode: int, checksums: bytes, entry: bytes) -> None:
    """The mark before the list of checksums."""
    self.store.put(f"manifest/{episode:06d}.json", entry)
    self.store.put(f"manifest/{episode:06d}.sha256", checksums)


def _end_early(self: run._Work, episode: int, permit: Callable[..., None] = run._Work.permit) -> None:
    permit(self, episode)
    self._chunks.done(self._held[episode][0])


BUGS = {
    "a lease is not checked before a commit": lambda patch: patch.setattr(Claim, "check", lambda self: None),
    "a lease counts for longer than others wait": lambda patch: patch.setattr(claims, "MARGIN", -3.0),
    "no heartbeat": lambda patch: patch.setattr(Claim, "_keep", lambda self: None),
    "leases never last": lambda patch: patch.setattr(claims, "_read", lambda data: claims._Lease("", 0.0)),
    "a takeover is not compared": lambda patch: patch.setattr(Store, "replace", _overtaken),
    "a lease is created over another": lambda patch: patch.setattr(
        Store, "create", lambda self, key, data: _overtaken(self, key, data, "")
    ),
    "a mark before its checksums": lambda patch: patch.setattr(Ledger, "commit", _entry_first),
    "done marks are not read": lambda patch: patch.setattr(Ledger, "done", lambda self, block: set()),
    "a chunk ends before its episode": lambda patch: patch.setattr(run._Work, "permit", _end_early),
    "a request is not repeated": lambda patch: patch.setattr(store, "TRIES", 1) or patch.setattr(store.persist, "__defaults__", (1,)),
    "a manifest of another worker is taken for foreign": lambda patch: patch.setattr(Ledger, "_stored_manifest", _first_look),
}
"""Planted bugs, by name."""


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_found(bug, monkeypatch):
    BUGS[bug](monkeypatch)
    with pytest.raises((AssertionError, HungError)):
        _run_all(range(MOST_SCHEDULES))
