"""Figures: runs as JSON, the newest of each stage, and READMEs whose tables follow from them."""

from __future__ import annotations

import re
import sys

import msgspec
import pytest

from tools import docs, figures
from tools.options import MeasuredRow

RUN = {"stage": "pictures", "date": "2030-01-02", "card": "H100", "commit": None, "command": "c", "limit": "rays", "rows": []}


def run(**changes) -> figures.Run:
    """A run of one value."""
    row = {"name": "views", "value": 1234.5, "unit": "1/s"}
    return msgspec.convert(RUN | {"rows": [row]} | changes, type=figures.Run)


@pytest.mark.parametrize("path", docs.REFERENCES, ids=lambda path: path.relative_to(docs.ROOT).as_posix())
def test_generated_documents_are_up_to_date(path):
    assert path.read_text(encoding="utf-8") == docs.REFERENCES[path](), "run python -m tools.docs"


def test_the_readme_of_the_tools_is_short():
    assert len(docs.FIGURES.read_text(encoding="utf-8").splitlines()) <= 150


def test_every_published_run_says_what_when_how_and_why():
    tables = set(re.findall(r"<!-- results: (\w+) -->", docs.FIGURES.read_text(encoding="utf-8")))
    tables |= {"sensor", "photographs", "store", "episodes"}  # Of other pages.
    runs = figures.read_runs()
    assert runs
    for name, each in runs.items():
        assert name.partition("_")[0] in tables, name
        assert all((each.stage, each.command, each.limit, each.rows)), name
        assert each.date is None or re.fullmatch(r"20\d\d-\d\d-\d\d", each.date), name
        assert set(each.shown) <= {row.name for row in each.rows}, name
        assert "/" not in each.command.replace("://", ""), f"{name} names a folder"


@pytest.mark.parametrize("fault", [{"unit": 3}, {"rows": [{"name": "views"}]}, {"rows": [{"name": "a", "value": "fast"}]}, {"date": 3}])
def test_a_file_that_is_no_run_is_refused(tmp_path, fault):
    (tmp_path / "speed_x.json").write_bytes(msgspec.json.encode(RUN | fault))
    with pytest.raises(msgspec.ValidationError):
        figures.read_runs(tmp_path)


def test_the_newest_run_of_a_stage_is_shown():
    runs = {"speed_a.json": run(), "speed_b.json": run(date="2030-01-03", card="H200"), "speed_c.json": run(date=None)}
    assert list(figures.newest_runs(runs)) == ["speed_b.json"]
    assert figures.newest_runs({"speed_c.json": run(date=None)}) == {"speed_c.json": run(date=None)}


def test_a_table_has_values_with_units_and_numbered_conditions():
    rows = [{"name": "views", "value": 1234.5, "unit": "1/s"}, {"name": "share", "value": 50, "unit": "%"}, {"name": "no", "value": 1}]
    noted = run(rows=rows, shown=["views", "share"], conditions="cold; alone", commit="abc")
    tables = figures.figures_tables(
        {"speed_a.json": noted, "speed_b.json": run(stage="other", conditions="alone"), "peers_a.json": run(stage="x")}
    )
    assert set(tables) == {"speed", "peers"}
    _, _, first, second, _, notes = tables["speed"].split("\n")
    assert first.startswith("| pictures | views **1,234.5/s**; share **50 %** | [H100, 2 Jan 2030](results/speed_a.json) (1, 2) |")
    assert first.endswith("| rays |")
    assert second.startswith("| other | views **1,234.5/s** | [H100, 2 Jan 2030](results/speed_b.json) (2) |")
    assert notes == "(1) cold; (2) alone."


def test_what_a_tool_writes_is_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["bench", "--models", str(tmp_path / "YCB"), "--seconds", "1"])
    machine = [("device", "cuda:0: NVIDIA H100"), ("CPU cores", "16")]
    rows = [MeasuredRow("views", 2.0, "1/s", part="pictures"), MeasuredRow("failed", float("nan"))]
    record = figures.describe_run("tools.bench", machine, rows, traces={"a": [1]})
    figures.write_run(tmp_path / "run.json", record)
    found = msgspec.json.decode((tmp_path / "run.json").read_bytes())
    assert found == record
    assert (found["command"], found["card"]) == ("python -m tools.bench --models YCB --seconds 1", "NVIDIA H100")
    assert [row["value"] for row in found["rows"]] == [2.0, None]
    assert msgspec.convert(found | {"rows": found["rows"][:1]}, type=figures.Run).more == {"traces": {"a": [1]}}
    figures.write_run(None, record)
