"""A small data set of all formats, and a copy of it in which every name is hostile."""

import json
import shutil
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.apps.report import write_report
from tests.harness.scripted_bake import bake, settings

EVIL = "</script><script>window.ran=1</script><img src=x onerror=window.ran=2><!--<script>\"'`${window.ran=3}"
"""A name that would run in a page that does not escape it."""


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """Three episodes of mode pick as scenes, shards and trajectories, with layers."""
    folder = tmp_path_factory.mktemp("report") / "set"
    bake(folder, settings(3, ("bop", "shards", "zarr")).with_values({"bop.split": "train", "bop.color_format": "png"}))
    return folder


@pytest.fixture(scope="session")
def page(data, tmp_path_factory) -> Path:
    """The report of `data`."""
    return write_report(synpick_warp.open(data), tmp_path_factory.mktemp("page") / "report.html")


@pytest.fixture(scope="session")
def hostile_page(data, tmp_path_factory) -> Path:
    """The report of a set whose objects, lights, sentences and folder have hostile names."""
    folder = tmp_path_factory.mktemp("hostile") / EVIL.replace("/", "\\")
    shutil.copytree(data, folder)
    for model in (folder / "models").glob("*.ply"):
        header, end, body = model.read_bytes().partition(b"end_header")
        lines = [line for line in header.splitlines() if b"millimetres" not in line]
        model.write_bytes(b"\n".join([*lines[:2], f"comment {EVIL}, millimetres".encode(), *lines[2:], b""]) + end + body)
    for scene in (folder / "train").glob("*/scene_camera.json"):
        content = json.loads(scene.read_text())
        for entry in content.values():
            entry["light"]["map"] = EVIL
        scene.write_text(json.dumps(content))
    for entry in (folder / "manifest").glob("0*.json"):
        content = json.loads(entry.read_text())
        for record in (content["row"], *content["attempts"]):
            record["sentence"] = EVIL
        entry.write_text(json.dumps(content))
    return write_report(synpick_warp.open(folder), folder.parent / "report.html")
