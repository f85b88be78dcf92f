"""Bakes on a Ray cluster, and launchers: the worker script under the variables of its schedulers, and files that name what there is."""

from __future__ import annotations

import io
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

from synpick_warp.cli.display import make_progress
from synpick_warp.cli.main import app
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


# ---- launchers ----


ROOT = Path(__file__).parents[2]
PLACE = ROOT / "synpick_warp/cloud/launchers"
STUBS = {
    "synpick-warp": 'echo "$*" >> said; trap "exit 143" TERM; touch started; [ "$CODE" = wait ] || exit "$CODE"; sleep 60 & wait',
    "scontrol": 'echo "scontrol $*" >> said',
}


def start(folder: Path, code: str, *arguments: str, **variables: str) -> subprocess.Popen:
    """Start the worker script with stubs in place of the programs that it calls; the bake ends with this code, or waits for SIGTERM."""
    for name, text in STUBS.items():
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    kept = {name: os.environ[name] for name in os.environ if not name.startswith("SLURM_")}
    environment = kept | {"PATH": f"{folder}:{os.environ['PATH']}", "CODE": code} | variables
    return subprocess.Popen(["bash", PLACE / "worker.sh", *arguments], env=environment, cwd=folder)


@pytest.mark.parametrize(("code", "ends"), [("0", 0), ("1", 0), ("2", 2), ("143", 143)])
def test_the_worker_ends_as_its_bake_but_for_episodes_that_were_given_up(code, ends, tmp_path):
    assert start(tmp_path, code, "--out", "s3://a b/c").wait(30) == ends
    assert (tmp_path / "said").read_text() == "bake --claim --out s3://a b/c\n"


@pytest.mark.parametrize("variables", [{"SLURM_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"}, {"JOB_COMPLETION_INDEX": "3"}])
def test_a_signal_reaches_the_bake_and_slurm_alone_is_asked_to_start_it_again(variables, tmp_path):
    worker = start(tmp_path, "wait", **variables)
    while not (tmp_path / "started").exists():
        time.sleep(0.01)
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(30) == 143
    assert (tmp_path / "said").read_text() == "bake --claim\n" + ("scontrol requeue 7\n" if "SLURM_JOB_ID" in variables else "")


def commands() -> list[list[str]]:
    """Arguments of synpick-warp in the launchers and their page."""
    pod = yaml.safe_load((PLACE / "kubernetes.yaml").read_text())["spec"]["template"]["spec"]["containers"][0]
    assert pod["command"] == ["worker.sh"]
    task = yaml.safe_load((PLACE / "skypilot.yaml").read_text())
    (sky,) = re.findall(r"worker\.sh (.*)", task["run"])
    sky = sky.replace("$OPTIONS", task["envs"]["OPTIONS"]).replace("$OUT", task["envs"]["OUT"])
    docker = (PLACE / "Dockerfile").read_text()
    (warm,) = re.findall(r'ARG WARM="(.*)"', docker)
    page = (PLACE / "README.md").read_text().replace("\\\n", " ").replace('"$(pwd)"', ".")
    found = [["bake", "--claim", *pod["args"]], ["bake", "--claim", *shlex.split(sky)], ["warmup", *shlex.split(warm)]]
    found += [["bake", "--claim", *shlex.split(line)] for line in re.findall(r"worker\.sh (--.*)", page)]
    return found + [
        shlex.split(line, comments=True) for line in re.findall(r"synpick-warp ((?:bake|warmup) --.*)", page) if "OPTIONS" not in line
    ]


def test_launchers_and_their_page_name_options_that_exist():
    lines = commands()
    assert len(lines) >= 6
    for line in lines:
        app.parse_args(line, exit_on_error=False, print_error=False)


def test_the_image_copies_what_there_is():
    copied = re.findall(r"^COPY (?:--\S+ )?(.*) \S+$", (PLACE / "Dockerfile").read_text(), re.MULTILINE)
    assert all((ROOT / name).exists() for names in copied for name in names.split())
