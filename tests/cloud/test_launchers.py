"""Launchers: the worker script under the variables of its schedulers, and files that name what there is."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import time
from pathlib import Path

import pytest
import yaml

from synpick_warp.cli.main import app

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
