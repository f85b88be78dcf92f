"""Pipeline of a bake, from settings to committed files: output folder, stages, exporters and writers, and the loop over their ticks."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from synpick_warp.codes import Phase
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import committed_episodes, describe_strays, episode_entry, read_entry
from synpick_warp.dataset.commit.writing import OutputFolder, commit_episode, digest_inputs, finalize_data_set
from synpick_warp.errors import OutputError
from synpick_warp.exporters.registry import Exporters, Needs
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.assembly import Factory, build_factory, make_compiler
from synpick_warp.factory.attempts import EpisodeRecord
from synpick_warp.factory.devices import DeviceShare, bake_on_devices, load_assets, open_exporters, prepare_folder
from synpick_warp.factory.episodes import BakeSummary, EpisodeSource, ThroughputMeter, count_writers, episode_end, is_resampled, measured
from synpick_warp.factory.forecast import SAMPLED, check_disk, forecast_bake, predict_length
from synpick_warp.factory.memory_plan import advise_processes, check_episodes, explain_shortage, pick_processes
from synpick_warp.factory.picks import PickQueue
from synpick_warp.factory.worker import BakeLink
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import limit_threads
from synpick_warp.stages.render.layers import with_suctionable_area
from synpick_warp.stages.stream import TickReport, tick_batch
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.stages.timing import scope
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.interrupt import StopRequest
from synpick_warp.system.progress import Progress
from synpick_warp.views.frames import EpisodeEnd, FrameBatch

_DEVICE_PROGRAM = "from synpick_warp.factory.worker import main; main('synpick_warp.factory.pipeline', 'generate_share')"
"""Program of a device's process, where a bake uses several."""
MAX_TICK_FRAMES = 256
"""Maximum number of a tick's frames that are handed over before more physics is enqueued: some 30 ms of CPU time. The parts of physics in
flight (`ticks.PARTS_IN_FLIGHT`) last for 0.1 s on an H200, and handing over the frames of 2,048 worlds takes longer."""


def run_bake(
    config: Config,
    out: Path,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
) -> BakeSummary:
    """Simulate, render and write a data set, or the remaining episodes of one, in a folder: new, empty, or of an earlier bake with the same
    settings.

    `shard` (i, n): only episodes with index % n == i; `splits`: only their episodes, empty: all; `devices` have a process each, see
    `pick_processes`, empty: `bake.device` alone. Raises SynpickError for what the user can correct; committed episodes stay, and the same
    bake resumes."""
    config = measured(config, devices)
    planned = DataLayout.of(config).plan_shard(splits, shard)
    check_episodes(sum(map(len, planned)), config.bake.episodes)
    return bake_episodes(config, out, progress, [episode for each in planned for episode in each], devices)


def bake_episodes(
    config: Config,
    out: Path,
    progress: Progress,
    episodes: Sequence[int],
    devices: Sequence[str] = (),
    deliver: Callable[[], None] | None = None,
    processes: int = 1,
    stop: BakeLink | None = None,
) -> BakeSummary:
    """Generate these episodes of a data set, sorted, in a folder, or the remaining ones of them; of an `EpisodeSource` one device takes
    further ones, too. Other arguments and errors as of `run_bake`.

    `config` has measures (`measured`). `deliver` is called at the end, also after a stop, in place of writing the indices: it takes
    the episodes elsewhere; None: they are written. `processes` bake on this host, and share its memory; `stop` requests to stop one device,
    None: signals do."""
    needs, source = Needs.of(config), episodes if isinstance(episodes, EpisodeSource) else EpisodeSource(episodes)
    with OutputFolder(out, config, episodes) as output:
        summary = BakeSummary(len(output.episodes))
        for episode in output.committed:
            summary.take_record(read_entry(out, episode_entry(episode)) or {})
        if output.is_finished:
            progress.note("the data set is finished: nothing is left to do")
            return summary
        if output.committed:
            progress.note(f"{len(output.committed)} of {len(output.episodes)} episodes are complete; resuming with the others")
        try:
            with explain_shortage(config):
                names = pick_processes(config, devices, len(output.remaining)) if devices else (config.bake.device,)
                if deliver is None and (advice := advise_processes(config, names, len(output.remaining))):
                    progress.note(advice)
                _fill(output, source, needs, names, summary, progress, deliver, processes, stop or StopRequest())
        except OutputError as error:
            if out.exists():
                raise
            raise OutputError(f"{out} was removed while the bake wrote to it") from error
    return summary


def _fill(
    output: OutputFolder,
    source: EpisodeSource,
    needs: Needs,
    names: Sequence[str],
    summary: BakeSummary,
    progress: Progress,
    deliver: Callable[[], None] | None,
    processes: int,
    stop: StopRequest | BakeLink,
) -> None:
    """Generate the remaining episodes, and those of the source, then the indices over all, or deliver the episodes."""
    config, factory = output.config, None
    settings = ExportSettings.of(config)
    if len(names) > 1:
        bake_on_devices(config, output, needs, names, _DEVICE_PROGRAM, summary, progress)
    elif output.remaining:
        with scope("build"):
            own = {"processes": processes, "longest_first": True, "expected": source.expected}
            factory = build_factory(config, progress, output.remaining, **own)
        if deliver is None:
            check_disk(forecast_bake(factory.config, factory.catalog, output.remaining), output.out, progress)
    else:
        prepare_folder(output, needs, *load_assets(config, progress.note))
    with WriterPool(count_writers(config.bake.writers, needs.slot_bytes), needs.slot_bytes, output.lock) as pool:
        started = time.perf_counter()
        if factory is not None:
            catalog = with_suctionable_area(factory.catalog, config.suction.radius) if config.bop.graph else factory.catalog
            assets = catalog, factory.cameras, factory.lights, factory.randomized
            with open_exporters(output.out, config, needs, pool, *assets) as exporters:
                output.prepare(exporters, digest_inputs(factory.catalog, factory.lights, factory.randomized), pool)
                commit = partial(commit_episode, output.out, exporters, pool)
                _Run(factory, exporters, needs.views, commit, summary, progress, stop, source.more).run()
                with scope("wait for writers"):
                    pool.wait()
        if deliver is not None:
            deliver()
        elif not summary.stopped:
            progress.stage("finishing files")
            with scope("finalize"):
                finalize_data_set(output.out, settings, needs.classes, pool)
            if strays := describe_strays(output.out, settings.layout, committed_episodes(output.out)):
                progress.note(strays)
        summary.wall_seconds += time.perf_counter() - started


def generate_share(share: DeviceShare, handles: Sequence[int], link: BakeLink) -> BakeSummary:
    """Generate and commit the episodes of one device, in its process; the folder is prepared already. Writers keep the `handles` open; the
    link receives reports, and requests to stop."""
    config, summary = share.config, BakeSummary(len(share.episodes))
    if config.bake.device == "cpu":
        limit_threads(max(1, count_cores() // share.processes))
    needs = Needs.of(config)
    with explain_shortage(config):
        factory = build_factory(config, link, share.episodes, processes=share.processes)
        with WriterPool(config.bake.writers, needs.slot_bytes, *handles) as pool:
            link.writers = pool.pids()
            started = time.perf_counter()
            assets = factory.catalog, factory.cameras, factory.lights, factory.randomized
            with open_exporters(share.out, config, needs, pool, *assets) as exporters:
                _Run(factory, exporters, needs.views, partial(commit_episode, share.out, exporters, pool), summary, link, link).run()
                pool.wait()
            summary.wall_seconds = time.perf_counter() - started
    return summary


class _Run:
    """Main loop of a bake: takes ticks from a `TickLoop`, renders views, hands both to exporters and ends episodes."""

    def __init__(
        self,
        factory: Factory,
        exporters: Exporters,
        writes_views: bool,
        commit: Callable[[EpisodeEnd], None],
        summary: BakeSummary,
        progress: Progress,
        stop: StopRequest | BakeLink,
        more: Callable[[bool], Sequence[int]] = lambda _: (),
    ) -> None:
        self.stop, self.source = stop, more
        self.factory, self.exporters, self.writes_views = factory, exporters, writes_views
        self.commit, self.summary, self.progress = commit, summary, progress
        expected = predict_length(factory.config, factory.catalog, factory.simulation.episodes.numpy()[:SAMPLED].tolist())
        self.meter = ThroughputMeter(len(factory.cameras), expected, summary, progress)
        self.picks = factory.picks

    def run(self) -> None:
        """Tick until no episode remains or a signal requests a stop."""
        self.progress.stage("loading kernels, dropping objects")
        done = False
        simulation, lead = self.factory.simulation, None if self.picks is None else self.picks.lead
        compiling = contextlib.ExitStack()
        with self.stop as stop, self.factory.stream.streams, TickLoop(simulation, lead, self._more) as ticks, compiling:
            compiling.enter_context(make_compiler(None, self.progress))
            while not (done or stop.number):
                report, snapshot = ticks.advance()
                self._hand_over(report, snapshot, ticks)
                if self.summary.views:
                    compiling.close()
                if self.picks is not None and self.picks.is_due:
                    self._try_picks(self.picks)
                phase = report.column("phase")
                self.meter.show(int(np.isin(phase, (Phase.SETTLE, Phase.ACT)).sum()))
                done = bool((phase == Phase.IDLE).all()) and not ticks.refill()
            for views in self.factory.stream.drain():
                self._write(views)
            if self.picks is not None and done:
                self._try_picks(self.picks)
        self.summary.stopped = 0 if done else stop.number

    def _more(self, wait: bool) -> Sequence[int]:
        """Further episodes, which count in the summary; see `TickLoop`."""
        episodes = self.source(wait)
        self.summary.total += len(episodes)
        return episodes

    def _hand_over(self, report: TickReport, snapshot: Snapshot, ticks: TickLoop) -> None:
        """Export a tick: write its frames, render its views, write views and episode ends; enqueue physics between parts of these."""
        batch = tick_batch(report, self.factory.object_ids, self.factory.tick_time)
        for first in range(0, len(batch), MAX_TICK_FRAMES):
            frames = np.arange(first, min(first + MAX_TICK_FRAMES, len(batch)))
            with scope("hand over ticks"):
                self.exporters.write_ticks(batch.select(frames))
            ticks.enqueue()
        records = self.factory.log.update(report)
        if self.picks is not None:
            self.picks.take(report)
        if self.writes_views:
            streams = self.factory.stream.streams
            streams.confine(ticks.reserved_share)
            ticks.confine_solver(streams.solver if len(batch) else None)
            for views in self.factory.stream.advance(snapshot, report, partial(self._end_episodes, report, records)):
                ticks.enqueue()
                self._write(views)
        else:
            self._end_episodes(report, records)

    def _write(self, views: FrameBatch) -> None:
        """Hand a batch of views over to the exporters."""
        with scope("hand over views"):
            self.exporters.write_views(views)
        self.summary.views += len(views)

    def _try_picks(self, picks: PickQueue) -> None:
        """Run the grasp trials of all states that wait, hand them to the exporters, and end the episodes that waited for them."""
        batches = picks.run()
        with scope("hand over picks"):
            for batch in batches:
                self.exporters.write_picks(batch)
            picks.release()

    def _end_episodes(self, report: TickReport, records: Mapping[int, EpisodeRecord]) -> None:
        """End the episodes that ended in a tick, after its views."""
        for world in np.flatnonzero(report.column("phase") == Phase.OVER).tolist():
            with scope("end episode"):
                self._end(report, world, records[int(report.column("episode")[world])])

    def _end(self, report: TickReport, world: int, record: EpisodeRecord) -> None:
        """End an episode: count it, and commit it, or resample its arrangement, by its ending."""
        tries = self.factory.config.settle.tries
        row = self.factory.episode_row(report, world, record)
        end, advice = episode_end(row, record, tries), self.summary.take_end(row, record, self.factory.config)
        if is_resampled(row, tries):
            note = f"episode {row.episode}, arrangement {row.arrangement + 1}: {row.sentence}"
            self.progress.note(note + (f"; {advice}" if advice else ""))
            if self.picks is not None:
                self.picks.drop(row.episode, row.arrangement)
            self.exporters.end_episode(end, lambda: None)
            return
        commit = partial(self.exporters.end_episode, end, partial(self.commit, end))
        if self.picks is None:
            commit()
        else:
            self.picks.end(row.episode, commit)
