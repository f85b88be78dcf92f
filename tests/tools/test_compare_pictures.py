"""Comparison of rendered outputs between devices: differences and tolerances per output, and error messages."""

from __future__ import annotations

import json
from dataclasses import fields

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import FAST, LAYERS, REFERENCE, RENDER_MODES
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers
from tests.builders import ONE_OBJECT, assignments
from tools.compare import pictures as tool


def values(difference) -> tuple[float, ...]:
    return difference.differing, difference.mean, difference.largest, difference.beyond


def test_every_output_has_a_tolerance():
    arrays = {item.name for item in fields(ViewBuffers)}
    assert arrays - set(tool.PACKED) | set(LAYERS) | {"masks"} == {*tool.TOLERANCES, "color"}
    assert set(tool.PACKED) < arrays
    assert set(tool.COLORS) == set(RENDER_MODES)


def test_equal_outputs_do_not_differ():
    for name, array in (
        ("color", np.full((1, 2, 5, 3), 7, np.uint8)),
        ("masks", np.full((1, 2, 5, 3), True)),
        ("boxes", np.full((1, 2, 2, 4), -1, np.int32)),
        ("flow", np.full((1, 2, 5, 2), np.nan, np.float32)),
    ):
        difference = tool.compare(FAST, name, array, array.copy())
        assert values(difference) == (0.0, 0.0, 0.0, 0.0)
        assert difference.holds


def test_a_pixel_differs_if_one_of_its_channels_does():
    a = np.zeros((1, 2, 5, 3), np.uint8)
    b = a.copy()
    b[0, 0, 0] = 255, 0, 0
    b[0, 1, 4] = 1, 2, 0
    # The second differs by no more than the tolerance.
    assert values(tool.compare(FAST, "color", a, b)) == pytest.approx((20.0, 25.7, 255.0, 10.0))
    assert values(tool.compare(FAST, "color", b, a)) == pytest.approx((20.0, 25.7, 255.0, 10.0))
    assert not tool.compare(FAST, "color", a, b).holds


def test_labels_are_equal_or_not():
    a = np.zeros((1, 2, 5, 3), bool)
    b = a.copy()
    b[0, 0, 0, 2] = True
    assert values(tool.compare(REFERENCE, "masks", a, b)) == pytest.approx((10.0, 0.1, 1.0, 10.0))


def test_a_rounded_depth_may_be_one_count_off():
    a = np.zeros((1, 2, 5), np.uint16)
    assert tool.compare(FAST, "depth", a, a + 1).holds
    assert not tool.compare(FAST, "depth", a, a + 2).holds


def test_nan_on_one_device_only_is_a_difference():
    a = np.full((1, 2, 5, 2), np.nan, np.float32)
    b = a.copy()
    b[0, 1, 2] = 0.0
    assert values(tool.compare(FAST, "flow", a, b)) == pytest.approx((10.0, 0.0, np.inf, 10.0))


def test_counts_and_boxes_are_compared_value_by_value():
    a = np.zeros((2, 3, 2, 4), np.int32)
    b = a.copy()
    b[0, 0, 0, 0] = 2
    assert values(tool.compare(FAST, "boxes", a, b)) == pytest.approx((100 / 48, 2 / 48, 2.0, 100 / 48))


@pytest.mark.slow
def test_a_device_equals_itself(tmp_path):
    file = tmp_path / "numbers.json"
    options = ["--devices", "cpu,cpu", "--scenes", "1", "--size", "16x9", "--samples", "2", "--json", str(file), *assignments(ONE_OBJECT)]
    assert tool.main(options) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {(row["mode"], row["output"]) for row in rows} == {(mode, name) for mode in RENDER_MODES for name in (*tool.TOLERANCES, "color")}
    assert all(row["differing"] == 0.0 for row in rows)


@pytest.mark.skipif(wp.get_cuda_device_count() > 0, reason="this machine has a GPU")
def test_a_missing_gpu_is_an_error(capsys):
    assert tool.main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "compare pictures: cuda:0 was requested, but Warp finds no CUDA device here; use --device cpu"


@pytest.mark.parametrize("devices", ["cpu", "cpu,cpu,cpu", "cpu,tpu", ""])
def test_invalid_device_lists_are_errors(capsys, devices):
    assert tool.main(["--devices", devices]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_exceeded_tolerances_exit_with_1(monkeypatch, capsys):
    a = np.zeros((1, 2, 5), np.uint8)
    monkeypatch.setattr(tool, "compare_devices", lambda *_: [tool.compare(FAST, "instance", a, a + 1)])
    assert tool.main(["--devices", "cpu,cpu"]) == 1
    assert "VIOLATED" in capsys.readouterr().out


def test_the_next_frame_displaces_objects_and_keeps_the_rest(device):
    snapshot = allocate(Snapshot, {"world": 1, "instance": 2, "fixture": 3}, device)
    snapshot.frame.fill_(7)
    snapshot.pose.fill_(wp.transform((1.0, 2.0, 3.0), wp.quat_identity()))
    after = tool.next_frame(snapshot, 0.5)
    assert after.frame.numpy().tolist() == [8]
    assert after.follows.numpy().tolist() == [1]
    assert after.pose.numpy()[0, 1, :3].tolist() == [1.5, 2.0, 3.0]
    assert np.array_equal(after.last_pose.numpy(), snapshot.pose.numpy())
    assert snapshot.frame.numpy().tolist() == [7]
