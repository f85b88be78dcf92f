"""Hostile and broken folders: a validation ends with violations or with one line, never with a traceback, and touches nothing else."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib
from itertools import islice

import pytest

from synpick_warp.cli.main import main
from synpick_warp.system.inputs.json import MAX_JSON
from tests.harness.hostile import hostile_contents
from tests.harness.scripted_bake import make_victim, snapshot
from tests.validation.planting import SCENE, edit

FILES = (
    f"{SCENE}/scene_camera.json",
    f"{SCENE}/scene_gt.json",
    f"{SCENE}/scene_gt_info.json",
    f"{SCENE}/scene_gt_coco.json",
    "models/models_info.json",
    "train_web/key_to_shard.json",
    "test_targets_bop19.json",
    "camera.json",
    "manifest.json",
    "config.toml",
)
EVERY = 23
"""Stride of the hostile contents of a file that are tried. They are listed by place, so all places and values have their turn."""


def run(capsys, *arguments: object) -> tuple[int, list[str], list[str]]:
    """Run the command; returns exit code, lines of the output, and of the standard error without progress."""
    capsys.readouterr()
    code = main(["validate", "--threads", "1", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out.splitlines(), [line for line in err.splitlines() if line.startswith("synpick-warp")]


@pytest.mark.parametrize("name", FILES)
def test_whatever_a_file_says_is_reported_in_lines(copy, check, name):
    path = copy / name
    other = [("text", b"[bake]\nmode = 3"), ("binary", b"\xff\0")]
    contents = list(hostile_contents(path.read_bytes())) if path.suffix == ".json" else other
    offset = FILES.index(name)
    whole = contents[:16]
    for description, content in [*whole, *islice(contents, 16 + offset, None, max(EVERY, len(contents) // 5))]:
        path.write_bytes(content)
        found = check(copy, sample=6 if name.startswith(SCENE) else 0, images=name.startswith(SCENE))
        assert all(violation.text and "Traceback" not in violation.text for violation in found), description


@pytest.mark.parametrize("part", ["rgb/000001.png", "depth/000001.png", "mask/000001_000000.png", "mask_visib/000001_000001.png"])
@pytest.mark.parametrize("content", ["empty", "text", "bomb", "truncated", "tiff"])
def test_images_that_do_not_decode_are_named(copy, check, part, content):
    path = copy / SCENE / part
    whole = path.read_bytes()
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60_000, 60_000, 8, 0, 0, 0, 0)
    bomb = header + struct.pack(">I", zlib.crc32(header[12:]))
    contents = {"empty": b"", "text": b"no image", "bomb": bomb, "truncated": whole[: len(whole) // 2], "tiff": b"II*\0\xff\xff\xff\0"}
    path.write_bytes(contents[content])
    found = [violation for violation in check(copy) if violation.rule == "image-decodes"]
    assert [violation.file for violation in found] == [f"{SCENE}/{part}"]


def test_names_with_line_breaks_and_terminal_sequences_stay_in_one_line(copy, capsys):
    (copy / SCENE / "rgb" / "a\nerror: b\x1b[31m.png").write_bytes(b"")
    os.close(os.open(os.fsencode(copy / SCENE / "mask") + b"/\xff\n.png", os.O_CREAT | os.O_WRONLY))
    (copy / "train" / "new\nline").mkdir()
    code, lines, errors = run(capsys, copy, "--fast")
    assert (code, errors) == (1, [])
    assert len(lines) == 4
    assert all(line.startswith("error train/") for line in lines[:3])
    assert not any("\x1b" in line for line in lines)
    code, lines, errors = run(capsys, copy, "--fast", "--json")
    assert len([json.loads(line) for line in lines]) == 4


def test_links_out_of_the_set_are_not_followed_and_nothing_is_written(copy, check, tmp_path):
    victim = make_victim(tmp_path)
    (victim / "scene_gt.json").write_text("{}")
    shutil.rmtree(copy / "models_eval")
    os.symlink(victim, copy / "models_eval")
    os.symlink(victim, copy / "train/000003")
    os.symlink(victim / "scene_gt.json", copy / SCENE / "scene_gt_coco_modal.json")
    os.symlink(copy / "loop", copy / "loop")
    os.symlink("/dev/zero", copy / SCENE / "mask/000001_000009.png")
    os.mkfifo(copy / SCENE / "depth/000005.png")
    before = snapshot(tmp_path / "victim"), set(copy.rglob("*"))
    found = check(copy)
    assert {violation.file for violation in found if violation.rule in ("link-outside", "scene-links")} == {
        "models_eval",
        "train/000003",
        "loop",
        f"{SCENE}/scene_gt_coco_modal.json",
        f"{SCENE}/mask/000001_000009.png",
        f"{SCENE}/depth/000005.png",
    }
    assert (snapshot(tmp_path / "victim"), set(copy.rglob("*"))) == before


def test_a_huge_file_is_not_read(copy, check):
    os.truncate(copy / SCENE / "scene_gt.json", MAX_JSON + 1)
    assert any("larger than" in violation.text for violation in check(copy, images=False))


def test_half_a_set_is_validated_as_far_as_it_goes(copy, check):
    shutil.rmtree(copy / "models")
    shutil.rmtree(copy / SCENE / "depth")
    shutil.rmtree(copy / "train/000002/mask")
    (copy / "train/000000/scene_gt.json").unlink()
    shutil.rmtree(copy / "train_web")
    rules = {violation.rule for violation in check(copy)}
    unread = {"same-images", "coco-instances", "target-images", "object-model", "picks-pixels", "picks-surface"}
    assert {"set-files", "ground-truth", "image-extra"} >= rules - unread
    edit(copy / "train/000002/scene_gt.json", lambda content: {})
    assert check(copy)


@pytest.mark.parametrize("kind", ["missing", "file", "empty", "pictures", "scene", "split", "link"])
def test_a_folder_that_is_no_set_is_one_line(good, tmp_path, capsys, kind):
    folder = tmp_path / kind
    if kind in ("empty", "pictures"):
        folder.mkdir()
    if kind == "pictures":
        (folder / "holiday").mkdir()
        (folder / "holiday/1.jpg").write_bytes(b"")
    elif kind == "file":
        folder.write_text("")
    elif kind == "link":
        os.symlink(folder, folder)
    elif kind == "scene":
        folder = good / SCENE
    elif kind == "split":
        folder = good / "train"
    code, lines, errors = run(capsys, folder)
    assert (code, lines, len(errors)) == (2, [], 1)
