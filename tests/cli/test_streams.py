"""What people see of a command, and what the system does not grant: streams that are closed, full, without a reader or ASCII; memory,
threads and open files."""

import io
import os
import re
import resource
import subprocess
import sys
import types
from collections import Counter
from pathlib import Path

import pytest
from rich.console import Console

from synpick_warp.apps.evaluation.results import write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.cli import display
from synpick_warp.cli import main as commands
from synpick_warp.cli.display import CountProgress, LiveProgress, PlainProgress, print_summary
from synpick_warp.cli.main import main
from synpick_warp.cli.streams import flush_output, safe_streams
from synpick_warp.codes import Ending, Outcome
from synpick_warp.dataset.reading import open_data_set
from synpick_warp.factory import episodes
from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome, ThroughputMeter
from synpick_warp.system.progress import Progress
from tests.harness.scripted_bake import bake, settings


def row(episode: int, arrangement: int, ending: Ending, frames: int, seconds: float, mode: str = "move", *counts: int) -> EpisodeOutcome:
    return EpisodeOutcome(episode, arrangement, ending, frames, seconds, mode, *(counts or (9, 0, 0, 0, 9)))


def printed(summary: BakeSummary) -> str:
    console = Console(file=io.StringIO(), width=120)
    print_summary(console, summary, Path("data"))
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        (BakeSummary(), "data set: data\n"),
        (
            BakeSummary(1, [row(0, 1, Ending.FINISHED, 9, 1.0)], remedies={Ending.PERCEPTION_OVERFLOW: "raise contour_points (16)"}),
            "\nperception overflow: raise contour_points (16)\n",
        ),
        (
            BakeSummary(3, [row(number, 0, Ending.FINISHED, 10, 1.0) for number in range(3)], views=30, wall_seconds=10.0, resumed=2),
            "3 of 3 episodes (2 of them before) and 30 views in 0:10 (3.0 views/s)",
        ),
        (BakeSummary(1, [row(0, 0, Ending.FINISHED, 120, 61.0)]), "1:01 "),
        (BakeSummary(1, [row(0, 0, Ending.FINISHED, 119, 3661.0)]), "1:01:01"),
    ],
)
def test_a_summary_says_what_is_there(summary, said):
    text = printed(summary)
    assert said in text
    assert text.count(Ending.FINISHED.sentence) == len(summary.episodes)
    assert "attempts" not in text
    assert "picked" not in text


def test_a_bake_that_picked_tells_of_attempts():
    rows = [
        row(0, 0, Ending.EMPTIED, 573, 38.2, "pick", 9, 10, 9, 0, 0),
        row(1, 0, Ending.GAVE_UP, 90, 6.0, "target", 8, 4, 2, 1, 5),
        row(2, 0, Ending.FINISHED, 416, 27.7),
    ]
    outcomes = Counter({Outcome.DROPPED: 3, Outcome.TARGET_PICKED: 10, Outcome.OTHER_PICKED: 1})
    text = printed(BakeSummary(len(rows), rows, views=3000, wall_seconds=10.0, outcomes=outcomes))
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines()]
    assert [line[-3:] for line in lines if line and line[0] in "012"][:2] == [["10", "9 of 9", "0"], ["4", "2 of 8", "1"]]
    assert {line[1] for line in lines if line and line[1]} == {"pick", "target", "move"}
    expected = "14 attempts: target picked 10 (71%), dropped 3 (21%), other picked 1 (7%); 11 of 17 objects picked, 1 lost otherwise"
    assert expected in text.splitlines()


@pytest.mark.parametrize("many", [False, True])
def test_endings_are_those_of_the_bin(many):
    given = EpisodeOutcome(0, 0, Ending.EMPTIED, 9, 1.0, "pick", 3, 3, 3, 0, 0, bin={"name": "kanban"})
    text = printed(BakeSummary(100, [given] * (100 if many else 1)))
    assert "no object is left in the bin" in text
    assert "tote" not in text


def test_a_long_bake_lists_counts_and_failures():
    rows = [row(episode, 0, Ending.NOT_FINITE if episode % 4 == 0 else Ending.FINISHED, 5, 1.0) for episode in range(100)]
    text = printed(BakeSummary(len(rows), rows, views=1500, wall_seconds=10.0))
    assert text.count(Ending.FINISHED.sentence) == 1
    assert text.count(Ending.NOT_FINITE.sentence) == 1 + 20
    assert "and 5 more that delivered nothing" in text
    assert "75 of 100 episodes" in text


@pytest.mark.parametrize("kind", [LiveProgress, PlainProgress])
def test_progress_displays(kind):
    console = Console(file=io.StringIO(), width=120, highlight=False, force_terminal=kind is LiveProgress)
    progress: Progress = kind(console)
    with progress:
        progress.stage("baking [bold]")
        for done in range(5):
            progress.stage(f"compiling: {done} of 5 modules")
        for done in range(50):
            progress.update(episodes_done=done, episodes=50, worlds_active=4, views=done, views_per_s=3.0, seconds_left=90.0)
        progress.note("note [x]")
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "note [x]" in text
    assert "1:30 left" in text
    if kind is LiveProgress:
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
        assert "episodes ━━━━━━━━━━━╸ 49/50 0:00:00 worlds 4 · views 49 · 3.0 views/s · 1:30 left" in plain
    if kind is PlainProgress:
        lines = ["baking [bold]", "compiling: 0 of 5 modules", "episodes 0/50 · worlds 4 · views 0 · 3.0 views/s · 1:30 left", "note [x]"]
        assert text.splitlines() == [f"   0:00  {line}" for line in lines]


def test_the_remaining_time_is_shown_from_the_first_views_on(monkeypatch):
    """While no episode has ended, by its predicted length: 100 of 2 x 3 x 50 views in 5 s."""
    clock = iter((10.0, 15.0))
    monkeypatch.setattr(episodes.time, "perf_counter", lambda: next(clock))
    left, summary = [], BakeSummary(2, views=1)
    progress = types.SimpleNamespace(update=lambda **counts: left.append(counts["seconds_left"]))
    shown = ThroughputMeter(3, 50.0, summary, progress)
    shown.show(2)
    summary.views = 100
    shown.show(2)
    assert left == [None, pytest.approx(10.0)]


@pytest.mark.parametrize("terminal", [True, False])
def test_an_estimation_counts_views(terminal, monkeypatch):
    """A bar on a terminal, which is gone at the end; lines elsewhere."""
    monkeypatch.setattr(display, "PLAIN_INTERVAL", 0.0)
    console = Console(file=io.StringIO(), width=80, force_terminal=terminal)
    with CountProgress(console) as counter:
        counter.report("views", 128, 3600)
        counter.report("views", 3600, 3600)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert ("views 128/3,600\n" in text) is not terminal
    assert "3600/3600" in text or not terminal


# ---- standard streams ----


HANG = 20.0
"""Longest time that a process may take [s]; it takes half a second."""
FULL = (
    "synpick-warp: error: the standard output cannot be written: No space left on device; "
    "send it elsewhere, for instance to a file on another disk\n"
)


def run(arguments: str, redirections: str = "", **variables: str) -> subprocess.CompletedProcess[bytes]:
    """Run the program in a shell with redirections of its streams."""
    return subprocess.run(
        ["sh", "-c", f'exec "{sys.executable}" -m synpick_warp {arguments} {redirections}'],
        capture_output=True,
        env={**os.environ, **variables},
        timeout=HANG,
        check=False,
    )


def test_a_closed_output_is_no_fault():
    """Fault 10."""
    result = run("config", ">&-")
    assert (result.returncode, result.stderr) == (0, b"")
    result = run("config --config none", "<&- >&- 2>&-")
    assert (result.returncode, result.stdout, result.stderr) == (2, b"", b"")


@pytest.mark.parametrize("arguments", ["config", "bake --help", "--version"])
def test_a_full_device_is_one_line(arguments):
    """Fault 10."""
    result = run(arguments, ">/dev/full")
    assert (result.returncode, result.stderr.decode()) == (2, FULL)


def test_two_full_devices_leave_the_exit_code():
    """Fault 10."""
    assert run("config", ">/dev/full 2>/dev/full").returncode == 2
    assert run("config --config none", "2>/dev/full").returncode == 2


@pytest.mark.parametrize("arguments", ["config", "bake --help"])
def test_a_reader_that_leaves_ends_the_program_as_sigpipe_does(arguments):
    """Fault 10. Rich, which prints the help, ends a program with exit code 1."""
    reader, writer = os.pipe()
    os.close(reader)
    result = subprocess.run(
        [sys.executable, "-m", "synpick_warp", *arguments.split()], stdout=writer, stderr=subprocess.PIPE, timeout=HANG, check=False
    )
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, b"")


def test_characters_that_a_locale_lacks_are_escaped():
    """Fault 10."""
    result = run("config", PYTHONIOENCODING="ascii")
    assert (result.returncode, result.stderr) == (0, b"")
    assert b"\\xb2" in result.stdout
    result = run("bake --help", PYTHONIOENCODING="ascii", LC_ALL="C")
    assert (result.returncode, result.stderr) == (0, b"")
    assert result.stdout.isascii()


def test_rich_prints_into_an_ascii_stream(tmp_path, monkeypatch):
    """Fault 10: progress lines and tables of a bake, in this process."""
    with (tmp_path / "out").open("w", encoding="ascii") as file:
        kept = os.dup(1)
        os.dup2(file.fileno(), 1)
        monkeypatch.setattr(sys, "stdout", file)
        monkeypatch.setattr(sys, "__stdout__", file)
        try:
            with safe_streams() as output:
                Console(width=80).print("worlds 2 · 3 m³ \ud800")
                flush_output()
                assert output.fault is None
        finally:
            os.dup2(kept, 1)
            os.close(kept)
    assert (tmp_path / "out").read_text() == "worlds 2 \\xb7 3 m\\xb3 \\ud800\n"


BAKE_ON_FULL_DEVICE = """
import gc; gc.disable()
import sys, synpick_warp.factory.pipeline as pipeline
from synpick_warp.cli.main import main
def build(*_, **__): raise AssertionError("the bake goes on")
# No kernels are compiled or loaded, whatever the load of the machine: the first line comes before, and ends the bake.
pipeline.build_factory = build
pipeline.advise_processes = lambda *_: "the first line"
code = main(sys.argv[2:])
open(sys.argv[1], "w").write("\\n".join(sys.modules))
sys.exit(code)
"""


@pytest.mark.slow
def test_a_bake_on_a_full_device_stops_in_its_first_progress_line(tmp_path):
    """Fault 10: nothing is left behind. By then, all is imported: neither evaluation nor estimation."""
    out, modules = tmp_path / "deep" / "set", tmp_path / "modules"
    arguments = f"bake --config smoke --device cpu --resolution 160x90 --worlds 1 --episodes 1 --mode move --out {out}"
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", BAKE_ON_FULL_DEVICE, str(modules), *arguments.split()]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False)
    assert (result.returncode, result.stderr.decode()) == (2, FULL)
    assert not out.parent.exists()
    imported = modules.read_text().split()
    assert "synpick_warp.factory.pipeline" in imported
    assert not [name for name in imported if name.startswith(("synpick_warp.apps.eval", "synpick_warp.apps.estim"))]


def test_replaced_streams_are_left_alone(capsys):
    before = sys.stdout, sys.stderr
    with safe_streams():
        assert (sys.stdout, sys.stderr) == before
        print("kept")
    assert capsys.readouterr().out == "kept\n"


POOL = """
import os, sys
from pathlib import Path
folder = Path(sys.argv[1])
lock = os.open(folder, os.O_RDONLY)
assert lock == 1, lock
from synpick_warp.exporters.writing.pool import WriterPool
with WriterPool(1, 64, lock) as pool:
    pool.submit(os.mkdir, (), (str(folder / "new"),), path=folder)
"""


def test_writers_start_when_a_lock_has_the_number_of_the_closed_output(tmp_path):
    """Fault 5: as for programs that call `bake`; two "Fatal Python error: init_sys_streams" before."""
    result = subprocess.run(
        ["sh", "-c", f'exec "{sys.executable}" -c \'{POOL}\' "{tmp_path}" >&-'], stderr=subprocess.PIPE, timeout=HANG, check=False
    )
    assert (result.returncode, result.stderr) == (0, b"")
    assert (tmp_path / "new").is_dir()


def test_closed_descriptors_are_taken_before_any_file(tmp_path):
    """Fault 5: the program itself."""
    code = (
        "import os, sys; from synpick_warp.cli.streams import flush_output, safe_streams\n"
        f"with safe_streams(): sys.exit(os.open({str(tmp_path)!r}, os.O_RDONLY) < 3)"
    )
    result = subprocess.run(["sh", "-c", f'exec "{sys.executable}" -c "{code}" <&- >&- 2>&-'], timeout=HANG, check=False)
    assert result.returncode == 0


# ---- memory, threads, open files ----


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "memory is exhausted; free memory, or raise its limit (ulimit -v)"),
        (MemoryError("Unable to allocate 3 GiB"), "memory is exhausted (Unable to allocate 3 GiB); free memory, or raise its limit"),
        (RuntimeError("can't start new thread"), "no thread can be started; close other programs, or raise the limit of processes"),
        (OSError(24, "Too many open files"), "[Errno 24] Too many open files; raise the limit of open files (ulimit -n)"),
        (ImportError("x.so: failed to map segment from shared object"), "memory is exhausted (x.so: failed to map segment"),
        (SystemError("error return without exception set"), "a library failed without a reason, as some do without memory (error return "),
        (ImportError("x.so: cannot open shared object file: Too many open files"), "x.so: cannot open shared object file: Too many "),
    ],
)
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_limit_is_one_line(monkeypatch, capsys, error, said, wrapped):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1 << 30, 1 << 30))

    def fail(*_, **__):
        if wrapped:
            raise ValueError("a consequence") from error
        raise error

    monkeypatch.setattr(commands, "load_settings", fail)
    assert main(["config"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"synpick-warp: error: {said}")


OTHERS = [RuntimeError("a fault of ours"), ImportError("no module named x"), OSError(5, "Input/output error"), SystemError("error")]


@pytest.mark.parametrize("error", OTHERS)
def test_other_faults_keep_their_traceback(monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(commands, "load_settings", fail)
    with pytest.raises(type(error)):
        main(["config"])


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("limits") / "set"
    bake(out, settings(1, ("bop",)))
    write_results(out.parent / "exact.csv", read_truth(open_data_set(out)).poses)
    return out


CHARTS = {
    "page.html": "report {data} --views 1 --out {out}",
    "picture.png": "explain {data} --out {out}",
    "plots": "eval --data {data} --results {data}/../exact.csv --visib-min 0 --plots {out}",
}
TIGHT = (resource.RLIMIT_AS, 6 << 28)


@pytest.mark.parametrize(
    ("name", "limit", "value"),
    [*((name, *TIGHT) for name in CHARTS), ("picture.png", resource.RLIMIT_AS, 3 << 30), ("picture.png", resource.RLIMIT_NOFILE, 8)],
)
def test_charts_under_limits_are_drawn_or_one_line(data, tmp_path, limit, value, name):
    """The charts' library, a browser's engine, aborted with its stack, or panicked."""
    out = tmp_path / name
    command = [sys.executable, "-m", "synpick_warp", *(part.format(data=data, out=out) for part in CHARTS[name].split())]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, preexec_fn=lambda: resource.setrlimit(limit, (value, value))
    )
    lines = done.stderr.splitlines()
    assert done.returncode in (0, 2), done.stderr
    assert out.exists() == (done.returncode == 0)
    assert not done.returncode or (len(lines) == 1 and lines[0].startswith("synpick-warp: error: ")), done.stderr
