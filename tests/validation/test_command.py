"""The command `validate`: exit codes, lines, JSON, rules, options; and the same result from several processes. Of hostile and broken
folders it ends with violations or with one line, never with a traceback, and touches nothing else."""

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.apps.validation import run as running
from synpick_warp.apps.validation.registry import load_rules
from synpick_warp.system.inputs.files import MAX_JSON
from tests.builders import run as command
from tests.harness.hostile import hostile_contents
from tests.harness.scripted_bake import make_victim, snapshot
from tests.validation.faults import CAMERA, COCO, GT, INFO, MODELS, SCENE, TARGETS, edit, edit_entry


def run(*arguments: object) -> tuple[int, list[str], list[str]]:
    """Exit code, lines of the output, and of the standard error without progress."""
    code, out, err = command("validate", *arguments)
    return code, out.splitlines(), [line for line in err.splitlines() if line.startswith("synpick-warp")]


def test_of_a_correct_set_a_sample_of_views_is_rendered(good):
    for views, rendered, *options in ((6, 6), (6, 5, "--sample", 5), (6, 6, "--poses"), (0, 0, "--fast")):
        line = f"3 scenes, 2 models, {views} views, {rendered} of them rendered again: 0 errors, 0 warnings"
        assert run(good, *options)[:2] == (0, [line])


def test_a_violation_is_one_line_with_its_cure(copy):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    code, lines, _ = run(copy, "--sample", 0)
    assert code == 1
    text = "image 1, instance 0: visib_fract is 0.5, but the counts give 1"
    assert lines[0].startswith(f"error {SCENE}/scene_gt_info.json: visible-fraction: {text}. To mend it: compute it")
    assert lines[-1].endswith("6 views, 0 of them rendered again: 2 errors, 0 warnings") or lines[-1].endswith("1 errors, 0 warnings")


def test_nothing_is_rendered_without_models(copy):
    """And what to add fits what is missing."""
    for name in ("models", "models_eval"):
        shutil.rmtree(copy / name)
    _, lines, _ = run(copy)
    assert "3 scenes, 0 models, 6 views, none of them rendered again, without models: " in lines[-1]
    (said,) = [line for line in lines if line.startswith("warning models: set-files")]
    assert said.endswith("poses are not checked against pixels. To mend it: add what is missing: tools read it without asking.")


def test_warnings_alone_and_a_split_that_is_still_to_be_baked_are_no_failure(copy):
    (copy / "test_targets_bop19.json").unlink()
    (copy / "val_pbr").mkdir()
    code, lines, _ = run(copy, "--fast")
    assert code == 0
    assert any(line.startswith("warning test_targets_bop19.json: set-files: missing") for line in lines)
    assert not [line for line in lines if line.startswith("error")]


def test_json_lines(copy):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    code, lines, _ = run(copy, "--json", "--fast")
    records = [json.loads(line) for line in lines]
    assert code == 1
    assert [each._asdict() | {"cure": records[0]["cure"]} for each in synpick_warp.validate(copy, images=False)][:1] == records[:1]
    assert records[0] == {
        "level": "error",
        "file": f"{SCENE}/scene_gt_info.json",
        "rule": "visible-fraction",
        "text": "image 1, instance 0: visib_fract is 0.5, but the counts give 1",
        "cure": load_rules()["visible-fraction"].cure,
    }
    assert records[-1]["totals"]["errors"] == len(records) - 1


def test_many_violations_of_a_rule_are_counted(copy):
    for image in ("0", "1"):
        for index in range(3):
            edit_entry(copy, "gt_info", index, image, visib_fract=0.33)
    code, lines, _ = run(copy, "--fast", "--limit", 2)
    assert code == 1
    assert [line for line in lines if "more" in line] == ["visible-fraction: 4 more; --limit 0 prints all"]
    assert len(run(copy, "--fast", "--limit", 0)[1]) == 7


def test_rules_are_listed_and_say_what_holds_and_how_to_mend_it():
    for item in load_rules().values():
        assert item.sentence.endswith("."), item.name
        assert not item.cure.endswith("."), item.name
        assert item.name == item.name.lower().replace(" ", "-")
    code, lines, _ = run("--rules")
    assert code == 0
    assert [line.split(" ")[0] for line in lines] == list(load_rules())
    assert {json.loads(line)["rule"] for line in run("--rules", "--json")[1]} == set(load_rules())


WRONG = [("--fast", "--poses"), ("--poses", "--sample", 3), ("--sample", -1), ("--limit", -1), ("--threads", 9999)]
WRONG += [("--tolerance", value) for value in ("15", "0,3", "15,nan", "15,3,1", "a,b")]


def test_deviations_are_a_table_and_records(good):
    code, lines, _ = run(good, "--fast", "--tolerance", "15,3")
    assert code == 0
    assert lines[0].split() == ["deviation", "object", "instances", "median", "95", "%", "largest"]
    assert lines[1].split()[:2] == ["visible-fraction", "all"]
    record = json.loads(run(good, "--fast", "--tolerance", "15,3", "--json")[1][0])["deviation"]
    assert (record["rule"], record["obj_id"], record["unit"], record["largest"]) == ("visible-fraction", None, "px", 0.0)


@pytest.mark.parametrize("options", WRONG)
def test_bad_options_are_one_line(good, options):
    code, lines, err = run(good, *options)
    assert (code, lines, len(err)) == (2, [], 1)


def test_a_folder_is_needed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # A data set in the current folder would be taken.
    assert run()[0] == 2


def test_processes_find_the_same_in_the_same_order(copy, check, monkeypatch):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    edit_entry(copy, "gt", 2, cam_t_m2c=[0.0, 0.0, 1400.0])
    alone = check(copy)
    monkeypatch.setattr(running, "VIEWS_PER_PROCESS", 1)
    monkeypatch.setattr(running, "PART", 1)
    assert check(copy, threads=2) == alone
    assert {violation.rule for violation in alone} >= {"visible-fraction", "pose"}


# ---- hostile and broken folders ----

FILES = (CAMERA, GT, INFO, COCO, MODELS, TARGETS, "train_web/key_to_shard.json", "camera.json", "manifest.json", "config.toml")
EVERY = 23
"""Stride of the hostile contents of a file that are tried. They are listed by place, so all places and values have their turn."""


@pytest.mark.parametrize("name", FILES)
def test_whatever_a_file_says_is_reported_in_lines(copy, check, name):
    path = copy / name
    other = [("text", b"[bake]\nmode = 3"), ("binary", b"\xff\0")]
    contents = list(hostile_contents(path.read_bytes())) if path.suffix == ".json" else other
    offset = FILES.index(name)
    whole = contents[offset % 4 : 16 : 4]
    for description, content in [*whole, *islice(contents, 16 + offset, None, max(EVERY, len(contents) // 5))]:
        path.write_bytes(content)
        found = check(copy, sample=3 if name.startswith(SCENE) else 0, images=name.startswith(SCENE))
        assert all(violation.text and "Traceback" not in violation.text for violation in found), description


@pytest.mark.parametrize(
    ("part", "content"),
    [
        *(("depth/000001.png", content) for content in ("empty", "text", "bomb", "truncated", "tiff")),
        ("rgb/000001.png", "text"),
        ("mask/000001_000000.png", "truncated"),
        ("mask_visib/000001_000001.png", "bomb"),
    ],
)
def test_images_that_do_not_decode_are_named(copy, check, part, content):
    path = copy / SCENE / part
    whole = path.read_bytes()
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60_000, 60_000, 8, 0, 0, 0, 0)
    bomb = header + struct.pack(">I", zlib.crc32(header[12:]))
    contents = {"empty": b"", "text": b"no image", "bomb": bomb, "truncated": whole[: len(whole) // 2], "tiff": b"II*\0\xff\xff\xff\0"}
    path.write_bytes(contents[content])
    found = [violation for violation in check(copy) if violation.rule == "image-decodes"]
    assert [violation.file for violation in found] == [f"{SCENE}/{part}"]


def test_names_with_line_breaks_and_terminal_sequences_stay_in_one_line(copy):
    (copy / SCENE / "rgb" / "a\nerror: b\x1b[31m.png").write_bytes(b"")
    os.close(os.open(os.fsencode(copy / SCENE / "mask") + b"/\xff\n.png", os.O_CREAT | os.O_WRONLY))
    (copy / "train" / "new\nline").mkdir()
    code, lines, errors = run(copy, "--fast")
    assert (code, errors) == (1, [])
    assert len(lines) == 4
    assert all(line.startswith("error train/") for line in lines[:3])
    assert not any("\x1b" in line for line in lines)
    code, lines, errors = run(copy, "--fast", "--json")
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
    names = {"scene_gt_coco_modal.json", "mask/000001_000009.png", "depth/000005.png"}
    linked = {violation.file for violation in found if violation.rule in ("link-outside", "scene-links")}
    assert linked == {"models_eval", "train/000003", "loop"} | {f"{SCENE}/{name}" for name in names}
    assert (snapshot(tmp_path / "victim"), set(copy.rglob("*"))) == before


def test_half_a_set_is_validated_as_far_as_it_goes_and_a_huge_file_is_not_read(copy, check):
    shutil.rmtree(copy / "models")
    shutil.rmtree(copy / SCENE / "depth")
    shutil.rmtree(copy / "train/000002/mask")
    (copy / "train/000000/scene_gt.json").unlink()
    shutil.rmtree(copy / "train_web")
    rules = {violation.rule for violation in check(copy)}
    unread = {"same-images", "coco-instances", "target-images", "object-model", "picks-pixels", "picks-surface"}
    assert {"set-files", "ground-truth", "image-extra"} >= rules - unread
    edit(copy / "train/000002/scene_gt.json", lambda content: {})
    os.truncate(copy / GT, MAX_JSON + 1)
    assert any("larger than" in violation.text for violation in check(copy))


def holiday(folder: Path) -> None:
    (folder / "holiday").mkdir(parents=True)
    (folder / "holiday/1.jpg").write_bytes(b"")


KINDS: dict[str, Callable[[Path], object]] = {
    "missing": lambda folder: None,
    "file": lambda folder: folder.write_text(""),
    "empty": Path.mkdir,
    "pictures": holiday,
    "link": lambda folder: os.symlink(folder, folder),
}


@pytest.mark.parametrize("kind", [*KINDS, SCENE, "train"])
def test_a_folder_that_is_no_set_is_one_line(good, tmp_path, kind):
    """Nor a scene or a split of one."""
    folder = tmp_path / kind if kind in KINDS else good / kind
    if kind in KINDS:
        KINDS[kind](folder)
    code, lines, errors = run(folder)
    assert (code, lines, len(errors)) == (2, [], 1)
