"""Bakes on a Ray cluster: the files of one bake though a worker is killed, nothing in HOME, and one line for what cannot be used."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from synpick_warp.cli.display import make_progress
from synpick_warp.cloud.run import Crew
from tests.builders import mistake
from tests.cloud.conftest import files, stored, tiny
from tests.harness import scripted_bake

S3 = ("bake", "--config", "smoke", "--device", "cpu", "--out", "s3://bucket/set")


@pytest.mark.slow(minutes=1)
def test_a_killed_worker_leaves_the_set_of_one_bake_and_home_untouched(prefix, tmp_path):
    """Two workers; the first that claims a chunk is killed in it, Ray starts it again, and its chunk is dealt again."""
    pytest.importorskip("ray")
    (tmp_path / "home").mkdir()
    with tempfile.TemporaryDirectory(dir="/tmp") as short:  # Paths of sockets have 107 characters.
        places = {"HOME": str(tmp_path / "home"), "TMPDIR": short, "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-m", "tests.cloud.ray_driver", prefix, "12", "2", str(tmp_path / "died")]
        ran = subprocess.run(command, env=os.environ | places, capture_output=True, text=True, timeout=300)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        assert not list(Path(short).glob("ray-*"))
    assert list((tmp_path / "home").iterdir()) == []
    assert (tmp_path / "died").exists()
    assert "worker · cost" in ran.stdout or "workers · cost" in ran.stdout
    assert "A worker died" in ran.stdout  # Ray's own notice.
    scripted_bake.bake(tmp_path / "local", tiny(12).with_values({"bake.device": "cpu"}))
    assert stored(prefix) == files(tmp_path / "local")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("--engine", "dask"), "--engine is dask; allowed: ray, or ray://HOST:PORT"),
        (("--engine", "dask", "--out", "DATA"), "--engine is dask; allowed: ray, or ray://HOST:PORT"),
        (("--engine", "ray://127.0.0.1:1"), "ray://127.0.0.1:1 does not answer ("),
        (("--engine", "ray://127.0.0.1:99999"), "ray://127.0.0.1:99999 does not answer ("),
        (("--engine", "ray", "--shard", "0/2"), "drop --devices and --shard"),
        (("--engine", "ray", "--out", "DATA"), "name one by --out"),
        (("--engine", "ray", "--price", "-1"), "--price is -1; allowed: 0.0 to 1000000.0"),
        (("--engine", "ray", "--workers", "-1"), "--workers is -1; allowed: 0 to 100000"),
        (("--workers", "2"), "--workers and --price go with --engine"),
    ],
)
def test_options_that_cannot_be_used(given, said):
    assert said in mistake(*S3[: -2 if "--out" in given else None], *given)


@pytest.mark.parametrize("given", [("--claim",), ("--devices", "cpu,cpu"), ()])
def test_a_price_is_that_of_workers(given):
    assert "--price also goes with --claim --devices" in mistake("bake", "--config", "smoke", "--out", "s3://b/x", "--price", "2", *given)


@pytest.mark.parametrize(("ray", "said"), [(None, "needs Ray >= 2.52: pip"), ("1.13.0", "here is Ray 1.13.0")])
def test_ray_is_missing_or_too_old(ray, said, monkeypatch):
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_USAGE_STATS_ENABLED", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"):
        monkeypatch.setenv(name, "")
    monkeypatch.setitem(sys.modules, "ray", ray and SimpleNamespace(__version__=ray))
    assert said in mistake(*S3, "--engine", "ray")


@pytest.mark.parametrize("terminal", [False, True])
def test_the_display_shows_workers_and_what_they_have_cost(terminal):
    crew, out = Crew(price=2.5, alive=3, seconds=3600.0), io.StringIO()
    with make_progress(Console(file=out, width=200, force_terminal=terminal), crew) as progress:
        progress.update(episodes_done=1, episodes=2, worlds_active=4, views=5, views_per_s=6.0, seconds_left=7.0)
    assert "worlds 4 · views 5 · 6.0 views/s · 0:07 left · 3 workers · cost 2.50" in out.getvalue()
    assert str(Crew(alive=1)) == "1 worker"
