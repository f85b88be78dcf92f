"""Resources that the system does not grant: one line, exit code 2."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from synpick_warp.apps.evaluation.results import write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.cli import main as commands
from synpick_warp.cli.main import main
from synpick_warp.dataset.reading import open_data_set
from tests.harness.scripted_bake import bake, settings


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "memory is exhausted; free memory, or raise its limit (ulimit -v)"),
        (MemoryError("Unable to allocate 3 GiB"), "memory is exhausted (Unable to allocate 3 GiB); free memory, or raise its limit"),
        (RuntimeError("can't start new thread"), "no thread can be started; close other programs, or raise the limit of processes"),
        (OSError(24, "Too many open files"), "[Errno 24] Too many open files; raise the limit of open files (ulimit -n)"),
        (ImportError("x.so: failed to map segment from shared object"), "memory is exhausted (x.so: failed to map segment"),
        (ImportError("x.so: cannot open shared object file: Too many open files"), "x.so: cannot open shared object file: Too many "),
    ],
)
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_limit_is_one_line(monkeypatch, capsys, error, said, wrapped):
    def fail(*_, **__):
        if wrapped:
            raise ValueError("a consequence") from error
        raise error

    monkeypatch.setattr(commands, "load_settings", fail)
    assert main(["config"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"synpick-warp: error: {said}")


@pytest.mark.parametrize("error", [RuntimeError("a fault of ours"), ImportError("no module named x"), OSError(5, "Input/output error")])
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
