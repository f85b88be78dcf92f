"""Constraints between settings, and limits of each."""

from __future__ import annotations

import re

import pytest

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import load_config, sections
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.grippers.mechanism import finger_collider
from synpick_warp.scenes.grippers.suction1 import cup_collider
from tests.configs.test_config import message


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({"cameras.ups": [[0, 1, 0]]}, "cameras.ups is [[0.0, 1.0, 0.0]] on the command line; allowed: one direction for each of the 3"),
        (
            {"cameras.ups": [[0, 0, 0]] * 3},
            "cameras.ups is .*; allowed: up vectors that are not zero or parallel to the viewing direction, as that of camera 0 ",
        ),
        ({"cameras.target": [0, 0, 2]}, "cameras.positions is .* by default; allowed: positions other than cameras.target"),
        ({"cameras.positions": [], "cameras.ups": []}, r"cameras.positions is \[\] on the command line; allowed: at least one position"),
        ({"tote.floor_size": [0.6, 0.3]}, "tote.rim_size is .* by default; allowed: at least tote.floor_size on both sides"),
        ({"tote.outer_size": [0.55, 0.373, 0.2]}, r"tote.outer_size is .*; allowed: at least .* two walls, \[0.554, 0.361\] \[m\]"),
        ({"settle.min_time": 20}, r"settle.max_time is [0-9.]+ by default; allowed: at least settle.min_time, 20 \[s\]"),
        ({"settle.rest_ticks": 1000}, "settle.max_time is [0-9.]+ by default; allowed: at least the time of settle.rest_ticks ticks"),
        ({"move.start_height": 0.01}, r"move.start_height is 0.01 on the command line; allowed: at least move.height, 0.02 \[m\]"),
        (
            {"bake.mode": "mixed", "bake.mix": [0, 0, 0]},
            r"bake.mix is \[0.0, 0.0, 0.0\] on the command line; allowed: at least one weight above 0, with the mode mixed",
        ),
        ({"pick.near": 1.5}, r"pick.appear_height is 1.0 by default; allowed: at least pick.near, 1.5 \[m\]"),
        ({"pick.near_speed": 1.5}, r"pick.speed is 1.0 by default; allowed: at least pick.near_speed, 1.5 \[m/s\]"),
        ({"pick.lift_height": 0.1}, r"pick.lift_height is 0.1 on the command line; allowed: at least the inner height of the tote, 0.195"),
        ({"suction.radius": 0.022}, r"suction.radius is 0.022 on .*; allowed: at most half of gripper.cup_width, 0.021 \[m\]"),
        ({"suction.rays": 4, "suction.tolerated_misses": 4}, "suction.tolerated_misses is 4 on .*; allowed: less than suction.rays, 4: "),
        ({"suction.flow": 30.0}, r"suction.flow is 30.0 on .*; allowed: none without suction.vacuum, such as 60 \[kPa\]"),
        (
            {"suction.vacuum": 60, "suction.rays": 10},
            "suction.rays is 10 on .*; allowed: at least 48 with suction.vacuum: fewer miss holes",
        ),
        ({"suction.vacuum": 60, "suction.surface": "hull"}, 'suction.surface is "hull" on .*; allowed: mesh with suction.vacuum'),
        ({"suction.vacuum": 60, "suction.good_force": 40}, r"suction.good_force is 40.0 on .*; allowed: none .*, 83.1265 \[N\]"),
        ({"suction.poor_force": 41}, r"suction.poor_force is 41.0 on the command line; allowed: at most suction.good_force, 40 \[N\]"),
        (
            {"physics.sleep": 2e-4, "bop.graph": True},
            r"physics.sleep is 0.0002 on the command line; allowed: 0 with bop.graph, which reads",
        ),
        ({"bop.split": "train"}, 'bop.color_format is "jpg" by default; allowed: png with the split train: '),
        ({"bop.color_format": "png"}, 'bop.color_format is "png" on the command line; allowed: jpg with the split train_pbr: '),
        ({"bop.split": "a/b"}, 'bop.split is "a/b" on the command line; allowed: train, val or test'),
        (
            {"render.layers": ["flow", "nocs", "flow"]},
            r'render.layers is \["flow", "nocs", "flow"\] on .*; allowed: each layer once: \["flow", "nocs"\]',
        ),
        (
            {"bake.formats": ["shards"], "bake.episodes": 333_334},
            "bake.episodes is 333334 on the command line; allowed: episode indices below 333333 with the format shards",
        ),
        # Labels that would be empty or wrong: depth that overflows or is 0, cameras that see no object, sensors out of range.
        ({"bop.depth_scale": 0.01}, "bop.depth_scale is 0.01 on the command line; allowed: at least 0.03"),
        ({"bop.depth_scale": 1e6}, r"bop.depth_scale is 1000000.0 on the command line; allowed: above 0, at most 10 \[mm\]"),
        (
            {"cameras.positions": [[0, 0, 60]], "cameras.ups": [[0, 1, 0]], "bop.depth_scale": 0.5},
            r"bop.depth_scale is 0.5 on .*; allowed: at least 0.916, so that 16 bits reach the tote at 60 m \[mm\]",
        ),
        ({"cameras.positions": [[0, 0, 1e9]] * 3}, r"cameras.positions is .*; allowed: each at least -100, at most 100 \[m\]"),
        ({"cameras.positions": [[0, 0.5, -0.3]] * 3}, "cameras.positions is .*; allowed: positions above the tote's floor, z > 0"),
        ({"cameras.target": [3, 0, 0]}, "cameras.target is .*; allowed: a point that lets each camera see the tote.* camera 0"),
        ({"cameras.target": [0, 0.5, 1.9], "cameras.fov": 40}, "cameras.target is .*; allowed: a point that lets each camera see the tote"),
        (
            {"render.layers": ["depth_sensor"], "depth_sensor.distances": [5, 9]},
            r"depth_sensor.distances is \[5.0, 9.0\] on .*; allowed: a range that reaches the tote, 1.8 to 2 m from camera 0 \[m\]",
        ),
        (
            {"render.layers": ["depth_sensor"], "depth_sensor.distances": [0.1, 1]},
            r"depth_sensor.distances is \[0.1, 1.0\] on .*; allowed: a range that reaches the tote",
        ),
        (
            {"render.layers": ["depth_sensor"], "depth_sensor.baseline": 1e-5},
            "depth_sensor.baseline is 1e-05 on .*; allowed: at least 4.6e-05, so that the disparity of the tote is a disparity_step",
        ),
        (
            {"render.layers": ["ir_right"], "depth_sensor.distances": [5, 9]},
            r"depth_sensor.distances is \[5.0, 9.0\] on .*; allowed: a range that reaches the tote, 1.8 to 2 m from camera 0 \[m\]",
        ),
        (
            {"render.layers": ["depth_stereo"], "depth_sensor.baseline": 0.3},
            r"depth_sensor.distances is \[0.4, 5.0\] .*; allowed: a maximum of at most 2.5\d, from which on 256 disparities are searched, "
            r"as the tote begins at 1.8 m; or a shorter lens \[m\]",
        ),
        ({"depth_sensor.grazing_angle": 1}, "depth_sensor.grazing_angle is 1 on .*; allowed: at least 10, at most 89"),
        ({"render.exposure": 1e9}, "render.exposure is .*; allowed: at least 0.01, at most 100"),
        ({"render.exposure": 1e-9}, "render.exposure is .*; allowed: at least 0.01, at most 100"),
        ({"gripper.cup_length": 1e6}, r"gripper.cup_length is 1000000.0 on .*; allowed: at least 0.005, at most 0.5 \[m\]"),
        ({"gripper.finger_width": 1e-9}, r"gripper.finger_width is 1e-09 on .*; allowed: at least 0.005, at most 1 \[m\]"),
        ({"move.speed": 1e-9}, r"move.speed is 1e-09 on .*; allowed: at least 0.001, at most 100 \[m/s\]"),
        ({"pick.floor": -1000}, r"pick.floor is -1000.* on .*; allowed: at least -10, at most 0 \[m\]"),
        ({"physics.step": 1e-30}, r"physics.step is 1e-30 on .*; allowed: at least 1e-05, at most 0.02 \[s\]"),
        ({"tote.outer_size": [1e6, 1e6, 0.2]}, r"tote.outer_size is .*; allowed: each above 0, at most 10 \[m\]"),
    ],
)
def test_values_that_contradict_each_other(overrides, expected):
    assert re.match(expected.replace("[[", r"\[\[").replace("]]", r"\]\]"), message(None, overrides))


@pytest.mark.parametrize(
    "overrides",
    [
        {"bake.mode": "move", "bake.mix": [0, 0, 0]},
        {"bake.mode": "mixed", "bake.mix": [0, 0.5, 0]},
        {"pick.near": 1.0, "pick.near_speed": 1.0, "pick.lift_height": 0.2},
        {"suction.radius": 0.021, "suction.tolerated_misses": 9, "suction.poor_force": 40},
        {"perception.resolution": [640, 160]},
        {"cameras.fov": 1.0, "cameras.target": [0.25, 0.15, 0.0]},
        {"cameras.positions": [[0, 0, 0.1]] * 3},
        {"cameras.positions": [[0, 0, 60]] * 3, "cameras.ups": [[0, 1, 0]] * 3, "bop.depth_scale": 1.0},
        {"depth_sensor.distances": [5, 9]},
        {"render.layers": ["depth_sensor"], "cameras.resolution": [320, 180]},
    ],
)
def test_values_at_the_limits_of_their_constraints(overrides):
    load_config(None, overrides)


def test_every_number_has_limits_at_both_ends():
    """Of a setting with one end open, some value makes labels meaningless, such as depth in counts of a kilometre."""
    for section, kind in sections().items():
        for name, item in settings_of(kind).items():
            if any(word in str(item.kind) for word in ("float", "int")):
                assert item.bounds.high is not None, f"{section}.{name}"
                assert (item.bounds.low is None) != (item.bounds.above is None), f"{section}.{name}"


@pytest.mark.parametrize("size", [{"cup_length": 0.5, "cup_width": 0.005}, {"cup_length": 0.005, "cup_width": 0.5}])
@pytest.mark.parametrize("shaft", [{"finger_length": 2.0, "finger_width": 0.005}, {"finger_length": 0.005, "finger_width": 1.0}])
def test_grippers_at_the_limits_have_volume(size, shaft):
    """Beyond them "all vertices lie in one plane" came, without a key."""
    gripper = load_config(None, {f"gripper.{name}": value for name, value in {**size, **shaft}.items()} | {"suction.radius": 0.002}).gripper
    for piece in (cup_collider(gripper), finger_collider(gripper)):
        assert hull_size(piece.vertices).volume > 0.0
