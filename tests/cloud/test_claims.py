"""Claims: one owner at a time, who learns of his loss before he commits; workers that die are replaced; the set is that of one bake."""

import itertools
import os
import subprocess
import sys
import threading
import time
from contextlib import nullcontext

import msgspec
import pytest

import synpick_warp
from synpick_warp.cloud import claims, run, workers
from synpick_warp.cloud.claims import Chunk, Chunks, Claims, LeaseLostError, Sizes, default_chunk
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.cloud.run import Crew, Job, PlanProgress
from synpick_warp.cloud.workers import bake_with_devices
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.system import clock
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores.store import Probe, open_store
from tests.builders import mistake
from tests.cloud.conftest import files, stored
from tests.harness import scripted_bake
from tests.harness.processes import module_command
from tests.harness.scripted_bake import EPISODES, tiny


def work(url: str, **given):
    return run.bake_into_store(Job(tiny(), url, **{"bake": scripted_bake.bake_episodes} | given), SilentProgress(), claim=True)


@pytest.mark.parametrize(("episodes", "chunk"), [(1, 1), (4, 1), (7, 3), (1_000_000, 512), (1_000, 600)])
def test_chunks_cover_the_plan_and_shrink_towards_its_end(episodes, chunk):
    bounds = list(Sizes(episodes, chunk).bounds())
    assert [start for start, _ in bounds] == [0, *(end for _, end in bounds[:-1])]
    assert bounds[-1][1] == episodes
    assert all(0 < end - start <= chunk for start, end in bounds)
    if episodes == 1_000_000:
        sizes = [end - start for start, end in bounds]
        assert sizes[0] == 512
        assert sizes[-2] == 64
        assert sum(size == 512 for size in sizes) * 512 == pytest.approx(0.75 * episodes, rel=1e-2)


@pytest.mark.parametrize(("worlds", "episodes", "chunk"), [(300, 1_000_000, 600), (0, 1_000_000, 512), (300, 64, 2), (2, 3, 1)])
def test_a_chunk_fills_the_worlds_of_a_device(worlds, episodes, chunk):
    assert default_chunk(worlds, episodes) == chunk


def test_a_claim_has_one_owner_until_it_runs_out(memory):
    """A damaged one is nobody's. Neither a clock that is wrong by less than the probe finds nor a slow owner breaks it."""
    store = open_store(memory)
    store.put("k", b"damaged")
    quick, other = Claims(store, 0.0, 60.0), Claims(store, 0.0, 60.0)
    claim = quick.take("k")
    assert claim is not None
    claim.check()
    assert other.take("k") is None
    claim.release()
    second = other.take("k")
    assert second is not None
    with pytest.raises(LeaseLostError):
        claim.check()
    second.stop()


def test_a_worker_without_work_asks_little_and_each_lease_once(memory, monkeypatch):
    """Of 1,500 chunks that others have: two pages of a listing and CHECKS leases a look, none twice before it may run out."""
    store, asked = open_store(memory), []
    others = Claims(store, 0.0)
    ledger = Ledger(store, tiny(1_500), Probe(0.0, True))
    chunks = Chunks(ledger, Claims(store, 0.0), [range(1_500)], 1)
    for number, _ in enumerate(chunks.sizes.bounds()):
        store.put(chunks._key(number), msgspec.json.encode(claims._Lease(others.owner, time.time() + 100.0)))
    monkeypatch.setattr(store, "create", lambda key, data, real=store.create: asked.append(key) or real(key, data))
    monkeypatch.setattr(store._obs, "list", lambda *a, real=store._obs.list, **given: asked.append("list") or real(*a, **given))
    pauses, waits = iter(range(3)), []
    chunks.on_wait = lambda: waits.append(len(asked))
    monkeypatch.setattr(clock, "sleep", lambda seconds: next(pauses))
    with pytest.raises(RuntimeError):  # Of the iterator, when the pauses end.
        next(iter(chunks))
    assert asked.count("list") == 4 * 2
    assert len(waits) == 1
    assert len(set(asked) - {"list"}) == len(asked) - 8 == 4 * claims.CHECKS


def test_workers_try_different_chunks_of_each_size_first(memory):
    """So that thousands that start at once, or end together, rarely collide."""
    store = open_store(memory)
    plans = [Chunks(Ledger(store, tiny(64), Probe(0.0, True)), Claims(store, 0.0), [range(64)], 8) for _ in range(16)]
    orders = [each._order for each in plans]
    assert all(sorted(order) == list(enumerate(plans[0].sizes.bounds())) for order in orders)
    assert all(sizes == sorted(sizes, reverse=True) for sizes in ([end - start for _, (start, end) in order] for order in orders))
    assert len({order[0] for order in orders}) > 2
    assert len({order[-1] for order in orders}) > 2


def test_an_error_ends_the_heartbeat_of_a_chunk(memory, monkeypatch):
    def fail(*_):
        raise StoreError("no answer")

    monkeypatch.setattr(Ledger, "done", fail)
    store = open_store(memory)
    chunks = Chunks(Ledger(store, tiny(), Probe(0.0, True)), Claims(store, 0.0), [range(4)], 4)
    with pytest.raises(StoreError, match="no answer"):
        next(iter(chunks))
    monkeypatch.undo()
    (chunk,) = itertools.islice(Chunks(chunks._ledger, Claims(store, 1_000.0), [range(4)], 4), 1)
    monkeypatch.setattr(store, "put", fail)
    with pytest.raises(StoreError, match="no answer"):
        chunks.done(chunk)
    assert not any(thread.name == "heartbeat" for thread in threading.enumerate())


@pytest.mark.parametrize("lost", [False, True])
def test_a_bake_takes_further_chunks_and_loses_one_alone(lost, memory, local):
    """Of four chunks of one episode, in one folder; the second lease is stolen, and its episode made in a second bake."""
    store, baked, notes = open_store(memory), [], []

    def bake(config, out, progress, episodes, devices=(), deliver=None):
        baked.append(out)
        more, asked = episodes.more, []

        def steal(wait):
            found = more(True)
            asked.append(found)
            if lost and len(baked) == 1 and len(asked) == 1:
                key = next(key for key, _ in store.list(".store/claims") if key.endswith(f"/{found[0]:06d}") and "done" not in key)
                data, tag = store.get_tagged(key)
                assert store.replace(key, data.replace(b'"owner":"', b'"owner":"thief-'), tag) is not None
                time.sleep(0.6)  # The lease has run out: found, its worker took it again before it knew of the loss, and died of it.
            return found

        episodes.more = steal
        return scripted_bake.bake_episodes(config, out, progress, episodes, devices, deliver, grows=True)

    progress = SilentProgress()
    progress.note = notes.append
    summary = run.bake_into_store(Job(tiny(), memory, bake=bake, lease=0.5), progress, claim=True)
    assert stored(memory) == local
    assert (len(baked) > 1) == lost
    assert summary.total == EPISODES
    assert any("ran out" in note for note in notes) == lost
    assert not any(thread.name == "heartbeat" for thread in threading.enumerate())


@pytest.mark.parametrize(("workers", "most"), [(0, 2 * run.HELD_CHUNKS), (2, 32)])
def test_a_worker_leaves_chunks_to_others_and_gives_up_what_it_holds(workers, most, memory, tmp_path):
    """Of 64 episodes in chunks of two, at most; of a worker of two the half."""
    store = open_store(memory)
    works = run._works(Ledger(store, tiny(64), Probe(0.0, True)), tmp_path, Claims(store, 0.0), [range(64)], workers, SilentProgress())
    with next(works) as held:
        found, end = list(held), time.monotonic() + 30.0
        while len(found) < most and time.monotonic() < end:
            found += held.more(False)
        assert len(set(found)) == len(found) == most == held.expected
        assert [held.more(False) for _ in range(3)] == [[]] * 3
        keys = [held._chunks._key(number) for number in held._held]
    taken = [Claims(store, 0.0).take(key) for key in keys]
    assert None not in taken
    for claim in taken:
        claim.stop()


def test_finalizers_of_different_plans_at_once_do_not_both_succeed(memory, local, tmp_path, monkeypatch):
    """The smaller plan is finalized while the larger uploads its indices; whoever comes next repairs it."""
    store, places = open_store(memory), [tmp_path / "large", tmp_path / "small"]
    large, small = (Ledger(store, tiny(count), Probe(0.0, False)) for count in (EPISODES, 2))
    with monkeypatch.context() as patch:
        patch.setattr(run, "finalize_store", lambda *_: 0)
        run.bake_into_store(Job(tiny(), memory, bake=scripted_bake.bake_episodes), SilentProgress())
    real = run.send_file
    for each in places:
        each.mkdir()

    def send(*arguments):
        real(*arguments)
        monkeypatch.setattr(run, "send_file", real)
        run.finalize_store(small, places[1])

    monkeypatch.setattr(run, "send_file", send)
    with pytest.raises(StoreError, match=r"another bake finalized s3://memory-.* for other episodes"):
        run.finalize_store(large, places[0])
    assert store.get(run.FINISHING, 1 << 30) == b""  # So the other would fail, too, if it still ran.
    run.bake_into_store(Job(tiny(), memory, bake=scripted_bake.bake_episodes), SilentProgress())
    assert stored(memory) == local


def test_the_progress_of_workers_is_that_of_the_plan(memory, monkeypatch):
    """A quarter of 100 episodes was done before; then 8 are done and 4 run for 20 s, so 65 are left for 130 s.

    One of two workers runs for 300 s more."""
    now, shown, observer, crew = [100.0], {}, SilentProgress(), Crew(price=3.0, alive=2)
    observer.update = shown.update
    monkeypatch.setattr(clock, "monotonic", lambda: now[0])
    chunks = Chunks(Ledger(open_store(memory), tiny(100), Probe(0.0, True)), Claims(open_store(memory), 0.0), [range(100)], 25)
    chunks.done(Chunk(0, [], None))
    progress = PlanProgress(observer, chunks, crew)
    now[0] += 20.0
    progress.update(episodes_done=8, episodes=0, worlds_active=4, views=300, views_per_s=15.0, seconds_left=None)
    expected = {"episodes_done": 33, "episodes": 100, "worlds_active": 4, "views": 300, "views_per_s": 15.0, "seconds_left": 130.0}
    assert shown == expected
    assert str(crew) == "2 workers · cost 0.03"
    chunks.done(Chunk(1, [], None))
    now[0] += 300.0
    progress.count(1)
    assert shown == dict.fromkeys(expected, 0) | {"episodes_done": 50, "episodes": 100, "seconds_left": 640.0}
    assert (str(crew), crew.seconds) == ("1 worker · cost 0.28", 340.0)


def test_claims_need_a_store(tmp_path):
    for place in (tmp_path / "set", f"file://{tmp_path}/set"):
        assert "--claim shares out" in mistake("bake", "--out", place, "--claim")
    assert files(tmp_path) == {}


def test_a_damaged_plan_is_refused(memory):
    work(memory)
    store = open_store(memory)
    (key,) = (key for key, _ in store.list(".store/claims") if key.endswith("plan.json"))
    store.put(key, b"none")
    store.delete(".store/finished")
    with pytest.raises(StoreError, match="is damaged; delete it"):
        work(memory)


@pytest.mark.slow
def test_a_killed_worker_leaves_the_set_of_one_bake(prefix, tmp_path):
    """Of three processes one is killed, and its chunk claimed again: a smoke test of what simulations assume."""
    command = [*module_command("tests.cloud.claiming_worker"), prefix, "6", "4", tmp_path / "died"]
    places = {"HOME": str(tmp_path), "TMPDIR": str(tmp_path / "tmp"), "PYTHONPATH": os.pathsep.join(sys.path)}
    (tmp_path / "tmp").mkdir()
    assert subprocess.run(command, env=os.environ | places, stdout=subprocess.PIPE, check=True).stdout == b"[-9, 0, 0]\n"
    scripted_bake.bake(tmp_path / "local", tiny(6))
    assert stored(prefix) == files(tmp_path / "local")


@pytest.mark.slow
def test_workers_of_several_devices_share_a_set(prefix, tmp_path, monkeypatch):
    """Each device has one process for all of its chunks; the settings in the store are those of the command."""
    job = Job(tiny(), prefix, bake=scripted_bake.bake_episodes, lease=60.0)
    crew = Crew(price=3600.0)
    summary = bake_with_devices(job, ("cpu", "cpu"), SilentProgress(), crew)
    assert (summary.total, summary.stopped, crew.alive) == (EPISODES, 0, 2)
    scripted_bake.bake(tmp_path / "local", tiny().with_values({"bake.device": "cpu"}))
    assert stored(prefix) == files(tmp_path / "local")
    monkeypatch.setattr(workers, "DeviceProcesses", lambda *_: nullcontext())
    assert bake_with_devices(job, ("cpu",), SilentProgress(), crew).total == 0


@pytest.mark.parametrize(
    ("out", "given", "said"),
    [
        ("DATA", {"claim": True}, "name one as the place"),
        ("DATA", {"engine": "ray"}, "name one as the place"),
        ("s3://bucket/x", {"claim": True, "shard": (0, 2)}, "drop the shard"),
        ("s3://bucket/x", {"engine": "ray", "devices": "all"}, "drop the devices"),
        ("s3://bucket/x", {"engine": "dask"}, "--engine is dask"),
    ],
)
def test_the_function_takes_claims_and_engines_as_the_command_does(out, given, said):
    with pytest.raises(SynpickError, match=said):
        synpick_warp.bake("smoke", out, **given)
