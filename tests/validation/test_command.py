"""The command `validate`: exit codes, lines, JSON, rules, options; and the same result from several processes."""

from __future__ import annotations

import json
import shutil

import pytest

import synpick_warp
from synpick_warp.apps.validation import run as running
from synpick_warp.apps.validation.registry import load_rules
from synpick_warp.cli.main import main
from tests.validation.planting import SCENE, edit_entry


def run(capsys, *arguments: object) -> tuple[int, list[str], str]:
    capsys.readouterr()
    code = main(["validate", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out.splitlines(), err


def test_a_correct_set(good, capsys):
    code, lines, _ = run(capsys, good)
    assert code == 0
    assert lines == ["3 scenes, 2 models, 6 views, 6 of them rendered again: 0 errors, 0 warnings"]


def test_a_violation_is_one_line_with_its_cure(copy, capsys):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    code, lines, _ = run(capsys, copy, "--sample", 0)
    assert code == 1
    text = "image 1, instance 0: visib_fract is 0.5, but the counts give 1"
    assert lines[0].startswith(f"error {SCENE}/scene_gt_info.json: visible-fraction: {text}. To mend it: compute it")
    assert lines[-1].endswith("6 views, 0 of them rendered again: 2 errors, 0 warnings") or lines[-1].endswith("1 errors, 0 warnings")


def test_nothing_is_rendered_without_models(copy, capsys):
    """And what to add fits what is missing."""
    for name in ("models", "models_eval"):
        shutil.rmtree(copy / name)
    _, lines, _ = run(capsys, copy)
    assert "3 scenes, 0 models, 6 views, none of them rendered again, without models: " in lines[-1]
    (said,) = [line for line in lines if line.startswith("warning models: set-files")]
    assert said.endswith("poses are not checked against pixels. To mend it: add what is missing: tools read it without asking.")


def test_warnings_alone_are_no_failure(copy, capsys):
    (copy / "test_targets_bop19.json").unlink()
    code, lines, _ = run(capsys, copy, "--fast")
    assert code == 0
    assert lines[0].startswith("warning test_targets_bop19.json: set-files: missing")


def test_a_split_that_is_still_to_be_baked_is_no_error(copy, capsys):
    (copy / "val_pbr").mkdir()
    code, lines, _ = run(capsys, copy, "--fast")
    assert code == 0
    assert not [line for line in lines if line.startswith("error")]


def test_json_lines(copy, capsys):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    code, lines, _ = run(capsys, copy, "--json", "--fast")
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


def test_many_violations_of_a_rule_are_counted(copy, capsys):
    for image in ("0", "1"):
        for index in range(3):
            edit_entry(copy, "gt_info", index, image, visib_fract=0.33)
    code, lines, _ = run(capsys, copy, "--fast", "--limit", 2)
    assert code == 1
    assert [line for line in lines if "more" in line] == ["visible-fraction: 4 more; --limit 0 prints all"]
    assert len(run(capsys, copy, "--fast", "--limit", 0)[1]) == 7


def test_rules_are_listed(capsys):
    code, lines, _ = run(capsys, "--rules")
    assert code == 0
    assert [line.split(" ")[0] for line in lines] == list(load_rules())
    assert {json.loads(line)["rule"] for line in run(capsys, "--rules", "--json")[1]} == set(load_rules())


def test_a_sample_of_views_is_rendered(good, capsys):
    assert "6 views, 5 of them" in run(capsys, good, "--sample", 5)[1][-1]
    assert "6 views, 6 of them" in run(capsys, good, "--poses")[1][-1]
    assert "0 views, 0 of them" in run(capsys, good, "--fast")[1][-1]


WRONG = [("--fast", "--poses"), ("--poses", "--sample", 3), ("--sample", -1), ("--limit", -1), ("--threads", 9999)]
WRONG += [("--tolerance", value) for value in ("15", "0,3", "15,nan", "15,3,1", "a,b")]


def test_deviations_are_a_table_and_records(good, capsys):
    code, lines, _ = run(capsys, good, "--fast", "--tolerance", "15,3")
    assert code == 0
    assert lines[0].split() == ["deviation", "object", "instances", "median", "95", "%", "largest"]
    assert lines[1].split()[:2] == ["visible-fraction", "all"]
    record = json.loads(run(capsys, good, "--fast", "--tolerance", "15,3", "--json")[1][0])["deviation"]
    assert (record["rule"], record["obj_id"], record["unit"], record["largest"]) == ("visible-fraction", None, "px", 0.0)


@pytest.mark.parametrize("options", WRONG)
def test_bad_options_are_one_line(good, capsys, options):
    code, lines, err = run(capsys, good, *options)
    assert (code, lines, len(err.splitlines())) == (2, [], 1)


def test_a_folder_is_needed(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # A data set in the current folder would be taken.
    assert run(capsys)[0] == 2


def test_processes_find_the_same_in_the_same_order(copy, check, monkeypatch):
    edit_entry(copy, "gt_info", 0, visib_fract=0.5)
    edit_entry(copy, "gt", 2, cam_t_m2c=[0.0, 0.0, 1400.0])
    alone = check(copy)
    monkeypatch.setattr(running, "VIEWS_PER_PROCESS", 1)
    monkeypatch.setattr(running, "PART", 1)
    assert check(copy, threads=2) == alone
    assert {violation.rule for violation in alone} >= {"visible-fraction", "pose"}


def test_every_rule_says_what_holds_and_how_to_mend_it():
    for item in load_rules().values():
        assert item.sentence.endswith("."), item.name
        assert not item.cure.endswith("."), item.name
        assert item.name == item.name.lower()
        assert " " not in item.name
