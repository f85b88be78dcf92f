"""Evaluation of a data set that was baked: its truth as an estimate, from BOP folders and from shards."""

from __future__ import annotations

import csv
import os
import shutil

import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation.results import write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.cli.main import main


@pytest.fixture(scope="module", params=["bop,zarr", "shards"])
def folder(request, picked_set, tmp_path_factory):
    others = ("train", "trajectory.zarr") if request.param == "shards" else ("train_web",)
    return shutil.copytree(picked_set, tmp_path_factory.mktemp("baked") / "set", ignore=lambda *_: others, copy_function=os.link)


def test_the_truth_of_a_bake_scores_100(folder, tmp_path, capsys):
    data = synpick_warp.open(folder)
    truth = read_truth(data)
    assert len(truth.images) == sum(len(episode) for episode in data.values()) * data.camera_count
    assert set(truth.mode) == {"pick"}
    assert np.isfinite(truth.speed).all()
    assert 0.0 <= truth.speed.min() <= truth.speed.max() < 10.0
    results, table = tmp_path / "truth.csv", tmp_path / "table.csv"
    write_results(results, truth.poses)
    options = ("--format", "csv", "--out", str(table), "--visib-min", "0")
    assert main(["eval", "--data", str(folder), "--results", str(results), *options]) == 0
    capsys.readouterr()
    rows = list(csv.DictReader(table.read_text().splitlines()))
    values = [float(row[column]) for row in rows for column in row if column.startswith("ADD")]
    assert (min(values), max(values)) == pytest.approx((100.0, 100.0))
    labels = {row["label"] for row in rows if row["group"] == "object"}
    assert labels <= ({"boxes_1", "boxes_2", "boxes_3"} if data.has_store else {"obj_000001", "obj_000002", "obj_000003"})
