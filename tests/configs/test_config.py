"""Loading, validation and serialization of the configuration."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.calibration.sensor_presets import ASSUMED, DEFINED, MEASURED, PUBLISHED, SENSORS, sensor_settings
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.configs.files.load import (
    COMMAND_LINE,
    load_config,
    override_config,
    parse_assignment,
    preset_names,
    sections,
)
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Config, ObjectRow
from synpick_warp.errors import ConfigError
from tests.builders import refusal
from tests.configs.test_presets import resolved

COUPLED = {
    "bake.formats",
    "bake.episodes",
    "perception.camera",
    "gripper.mesh",
    "randomize.background_textures",
    "pick.press_time",
    "bop.split",
    "bop.color_format",
    "bop.depth_scale",
    "depth_sensor.baseline",
    "depth_sensor.disparity_step",
    "depth_sensor.max_disparity",
    "depth_sensor.preset",
    "move.height",
    "move.start_height",
    "pick.near",
    "pick.appear_height",
    "pick.speed",
    "pick.near_speed",
    "pick.lift_height",
    "suction.radius",
    "gripper.cup_width",
    "gripper.kind",
    "gripper.valve",
    "suction.rays",
    "suction.tolerated_misses",
    "suction.good_force",
    "suction.poor_force",
    "suction.flow",
    "suction.compliance",
    "suction.surface",
    "suction.vacuum",
}
COUPLED_SECTIONS = {"tote", "bins", "cameras", "settle", "physics"}
"""Settings with constraints between them: independent random values mostly violate these."""


def write(folder: Path, text: str) -> str:
    path = folder / "my.toml"
    path.write_text(text)
    return str(path)


def message(name: str | None, overrides: dict[str, object]) -> str:
    return refusal(load_config, name, overrides, source=COMMAND_LINE)


def test_the_default_preset_has_the_papers_values():
    config = load_config(None, {})
    assert config == load_config("synpick", {})
    assert dataclasses.replace(config, object_rows=()) == Config()
    assert (config.physics.step, config.move.force, config.cameras.resolution, config.cameras.fov) == (0.002, 30.0, (1920, 1080), 20.0)
    assert [row.id for row in config.object_rows] == list(range(1, 22))
    assert [row.id for row in config.object_rows if row.concave] == [13, 14, 15]
    assert config.object_rows[11] == ObjectRow(12, "021_bleach_cleanser", 0.2594, 1.131, False, 0.1, 0.5)
    assert sum(row.mass for row in config.object_rows) == pytest.approx(6.899)


def test_object_rows_have_the_diameters_of_the_real_models(real_models):
    info = json.loads((real_models / "models_info.json").read_text())
    for row in load_config(None, {}).object_rows:
        assert row.diameter == pytest.approx(info[str(row.id)]["diameter"] / 1000, abs=1e-4)


def test_other_presets_build_on_the_default_preset():
    synpick = ["synpick", "synpick-hard", "synpick-released", "synpick-test"]
    assert preset_names() == ["full-bin", "randomized", "smoke", *synpick, "tabletop", "tabletop-train"]
    released = load_config("synpick-released", {})
    assert released.move.damping == 1.0
    assert released.object_rows == load_config(None, {}).object_rows
    smoke = load_config("smoke", {})
    assert (smoke.move.rounds, smoke.bop.color_format, len(smoke.object_rows)) == (1, "png", 21)


def test_the_released_generator_differs_in_exactly_this():
    paper, released = resolved("synpick"), resolved("synpick-released")
    assert {key: (paper[key], value) for key, value in released.items() if value != paper[key]} == {
        "move.damping": (60.0, 1.0),
        "pick.failures": (3, 4),
        "suction.tolerated_misses": (0, 2),
        "suction.poor_force": (2.0, 0.2),
        "bop.coco": (True, False),
    }


def test_the_smoke_preset_stirs_few_objects_in_small_images():
    paper, smoke = resolved("synpick"), resolved("smoke")
    changed = {key for key, value in smoke.items() if value != paper[key]}
    assert (paper["bake.mode"], smoke["bake.mode"]) == ("pick", "move")
    # Physics and the rules of picking are the paper's; settings in pixels shrink with the image.
    assert {key.split(".")[0] for key in changed} == {"bake", "cameras", "arrangement", "move", "perception", "bop"}
    assert {key for key in changed if key.startswith("perception.")} == {
        f"perception.{name}" for name in ("resolution", "contour_points", "contour_offset", "min_votes", "normal_window")
    }


def test_command_line_wins_over_file_and_file_over_preset(tmp_path):
    path = write(tmp_path, 'preset = "smoke"\n[bake]\nworlds = 7\nseed = 3\n')
    config = load_config(path, {"bake.seed": 9})
    assert (config.bake.worlds, config.bake.seed) == (7, 9)
    assert config.move.rounds == load_config("smoke", {}).move.rounds


def test_a_file_without_preset_builds_on_the_default_preset(tmp_path):
    assert load_config(write(tmp_path, ""), {}) == load_config(None, {})


def test_object_rows_of_a_file_replace_those_of_the_preset(tmp_path):
    config = load_config(write(tmp_path, '[[object_rows]]\nid = 5\ndiameter = 0.1\nname = "brick"\n'), {})
    assert config.object_rows == (ObjectRow(id=5, diameter=0.1, name="brick"),)


def test_paths_and_no_arguments_do_as_names_do(tmp_path):
    assert load_config() == load_config("synpick")
    assert load_config(Path(write(tmp_path, 'preset = "smoke"\n'))) == load_config("smoke", {})
    with pytest.raises(ConfigError, match=r"^bake.worlds is -1 in the settings passed; allowed: at least 0, at most 65536$"):
        load_config("smoke", {"bake.worlds": -1})


def test_values_of_other_libraries_are_read_as_pythons():
    given = {
        "bake.episodes": np.int64(3),
        "physics.friction": np.float32(0.5),
        "cameras.resolution": np.array([64, 48]),
        "bake.models": Path("m"),
    }
    config = load_config("smoke", given)
    assert (config.bake.episodes, config.physics.friction, config.cameras.resolution) == (3, 0.5, (64, 48))
    assert config.bake.models == "m"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"bake": {"episodes": 1}}, "bake is a section, set in the settings passed; set single keys, such as bake.mode"),
        ("bake.episodes=1", 'the settings passed are "bake.episodes=1"; allowed: a dict, of full keys such as bake.episodes'),
        ({1: 2}, "there is no section 1, set in the settings passed; sections: bake, "),
        ({"bake.episodes": np.array([1, 2])}, "bake.episodes is [1, 2] in the settings passed; allowed: a whole number"),
    ],
)
def test_settings_that_are_no_dict_of_keys_are_named(settings, said):
    assert refusal(load_config, "smoke", settings).startswith(said)


def test_whole_numbers_are_allowed_for_floats():
    gravity = load_config(None, {"physics.gravity": 10}).physics.gravity
    assert isinstance(gravity, float)
    assert gravity == 10.0


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("physics.step", 0.5, "physics.step is 0.5 on the command line; allowed: at least 1e-05, at most 0.02 [s]"),
        ("physics.step", 0, "physics.step is 0 on the command line; allowed: at least 1e-05, at most 0.02 [s]"),
        ("bake.worlds", -1, "bake.worlds is -1 on the command line; allowed: at least 0, at most 65536"),
        ("bake.worlds", 2.0, "bake.worlds is 2.0 on the command line; allowed: a whole number"),
        ("bake.worlds", True, "bake.worlds is true on the command line; allowed: a whole number"),
        ("physics.gravity", True, "physics.gravity is true on the command line; allowed: a finite number [m/s²]"),
        ("physics.gravity", float("nan"), "physics.gravity is NaN on the command line; allowed: a finite number [m/s²]"),
        ("physics.gravity", float("inf"), "physics.gravity is Infinity on the command line; allowed: a finite number [m/s²]"),
        ("render.table", 1, "render.table is 1 on the command line; allowed: true or false"),
        ("bake.models", 3, "bake.models is 3 on the command line; allowed: a string"),
        ("bake.mode", "mvoe", 'bake.mode is "mvoe" on the command line; allowed: pick, target, move, mixed, cycle; did you mean move?'),
        ("bake.mix", [1, -1, 1], "bake.mix is [1, -1, 1] on the command line; allowed: each at least 0, at most 1000"),
        ("bake.mix", [1, 1], "bake.mix is [1, 1] on the command line; allowed: 3 numbers in a list"),
        ("perception.exact_cycle", 13, "perception.exact_cycle is 13 on the command line; allowed: at least 2, at most 12"),
        ("suction.rays", 2, "suction.rays is 2 on the command line; allowed: at least 3, at most 64"),
        ("cameras.resolution", [0, 0], "cameras.resolution is [0, 0] on the command line; allowed: each at least 1, at most 8192 [px]"),
        ("cameras.resolution", [640], "cameras.resolution is [640] on the command line; allowed: 2 whole numbers in a list [px]"),
        ("cameras.ups", [[1, 2]], "cameras.ups is [[1, 2]] on the command line; allowed: a list of lists of 3 numbers"),
        (
            "render.layers",
            ["flow", "normal"],
            'render.layers is ["flow", "normal"] on the command line; allowed: any of normals, albedo, nocs, classes, flow, scene_flow, '
            "depth_sensor, ir_left, ir_right, depth_stereo, suction_seal, suction_wrench; did you mean normals?",
        ),
        ("render.layers", "flow", 'render.layers is "flow" on the command line; allowed: a list of strings'),
        ("tote.color", [0.5, 0.5, 1.5], "tote.color is [0.5, 0.5, 1.5] on the command line; allowed: each at least 0, at most 1 [sRGB]"),
    ],
)
def test_a_wrong_value_is_reported_with_what_is_allowed(key, value, expected):
    assert message(None, {key: value}) == expected


def test_whole_numbers_beyond_the_range_of_floats_are_refused():
    assert "allowed: a finite number" in message(None, {"physics.gravity": 10**400})


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("physics.stepp", "did you mean step?"),
        ("physics.spread", "did you mean arrangement.spread?"),
        ("phisics.step", "did you mean physics?"),
        ("friction", "did you mean physics.friction or picks.friction?"),
        ("object_rows.mass", "write [[object_rows]] tables into a file"),
    ],
)
def test_an_unknown_key_is_reported_with_a_suggestion(key, hint):
    assert message(None, {key: 1}).endswith(hint)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[physics]\nstep = 0.5\n", "physics.step is 0.5 in {path}; allowed: at least 1e-05, at most 0.02 [s]"),
        ("[physics]\nstepp = 1\n", "there is no key physics.stepp, set in {path}; keys of physics: step, "),
        ("[fysics]\nstep = 1\n", "there is no section fysics, set in {path}; sections: bake, objects, "),
        ("physics = 3\n", "physics is 3 in {path}; allowed: a section, [physics]"),
        ("worlds = 3\n", "there is no section worlds, set in {path}; "),
        ('preset = "synpik"\n', 'there is no preset "synpik" in {path}; presets: full-bin, randomized, smoke, synpick, synpick-hard, '),
        ("preset = 3\n", "preset is 3 in {path}; allowed: full-bin, randomized, smoke, synpick, synpick-hard, synpick-released, "),
        ("object_rows = 3\n", "object_rows is 3 in {path}; allowed: [[object_rows]] tables"),
        ("[[object_rows]]\nid = 1\n", "object_rows[0] has no diameter in {path}; a row needs id and diameter"),
        ("[[object_rows]]\nid = 1\nweight = 2\n", "there is no key object_rows[0].weight, set in {path}; keys: id, "),
        ("[[object_rows]]\nid = 1\ndiameter = 1\nmass = 0\n", "object_rows[0].mass is 0 in {path}; allowed: above 0 [kg]"),
        ("[physics\n", "{path} is not valid TOML: "),
    ],
)
def test_a_wrong_file_is_reported_with_its_name(tmp_path, text, expected):
    path = write(tmp_path, text)
    assert message(path, {}).startswith(expected.format(path=path))


def test_files_that_cannot_be_read(tmp_path):
    assert message(str(tmp_path / "none.toml"), {}).startswith(f"there is no file {tmp_path / 'none.toml'}; ")
    (tmp_path / "folder.toml").mkdir()
    assert message(str(tmp_path / "folder.toml"), {}) == f"{tmp_path / 'folder.toml'} is not a regular file"
    (tmp_path / "latin.toml").write_bytes(b"# \xe9\n")
    assert message(str(tmp_path / "latin.toml"), {}).endswith("is not valid TOML: byte 2 is not UTF-8")
    assert message("smok", {}).endswith("a file's name ends in .toml; did you mean smoke?")


def test_a_bad_value_in_the_file_is_reported_even_if_the_command_line_replaces_it(tmp_path):
    assert " in " in message(write(tmp_path, "[bake]\nworlds = -1\n"), {"bake.worlds": 1})


def test_object_ids_are_unique(tmp_path):
    row = "[[object_rows]]\nid = 4\ndiameter = 0.1\n"
    path = write(tmp_path, row * 2)
    assert message(path, {}) == f"object_rows has 2 rows in {path}; allowed: one row per id; 4 comes 2 times"


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("physics.step=0.001", "physics.step", 0.001),
        (" move.rounds =3", "move.rounds", 3),
        ("cameras.resolution=[640, 360]", "cameras.resolution", [640, 360]),
        ("bake.models=/a b/c", "bake.models", "/a b/c"),
        ('bake.models="/a=b"', "bake.models", "/a=b"),
        ("bop.split=5", "bop.split", "5"),
        ("render.table=false", "render.table", False),
        ("physics.step=fast", "physics.step", "fast"),
        ('render.layers=["normals", "flow"]', "render.layers", ["normals", "flow"]),
        ("render.layers=[normals,flow]", "render.layers", ["normals", "flow"]),
        ("render.layers=normals, flow", "render.layers", ["normals", "flow"]),
        ("render.layers=[]", "render.layers", []),
    ],
)
def test_assignments(text, key, value):
    assert parse_assignment(text) == (key, value)


@pytest.mark.parametrize("text", ["physics.step", "physics.stepp=1", "step=1", "=1", "object_rows.mass=1"])
def test_invalid_assignments(text):
    with pytest.raises(ConfigError):
        parse_assignment(text)


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("comments", [False, True])
def test_presets_survive_writing_and_reading(tmp_path, name, comments):
    config = load_config(name, {})
    text = config_to_toml(config, comments=comments)
    assert load_config(write(tmp_path, text), {}) == config
    assert ("[N·s/m]" in text) == comments


PATHS = sorted(f"{section}.{name}" for section, kind in sections().items() for name, item in settings_of(kind).items() if item.path)


def test_paths_in_a_file_are_relative_to_it_and_others_to_the_current_folder(tmp_path, monkeypatch):
    """Which both hold where a written configuration is read."""
    lines = {key: f'[{key.split(".")[0]}]\n{key.split(".")[1]} = "a/../{key}"\n' for key in PATHS}
    (tmp_path / "cell").mkdir()
    monkeypatch.chdir(tmp_path)
    for key in PATHS:
        Path("cell/cell.toml").write_text(f"[render]\ntable_size = [1, 1]\n{lines[key]}")
        others = {other: other for other in PATHS if other != key}
        config = load_config("cell/cell.toml", others | {"gripper.kind": "suction_array", "gripper.cups": [[0.0, 0.0]]})
        Path("cell/written.toml").write_text(config_to_toml(config))
        for found, expected in ((config, others), (load_config("cell/written.toml"), {other: str(tmp_path / other) for other in others})):
            assert {name: found.value(name) for name in PATHS} == expected | {key: str(tmp_path / "cell" / key)}
    assert len(PATHS) == 7


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)


def values(item: Setting) -> st.SearchStrategy:
    """Strategy for the allowed values of a setting."""
    bounds, kind = item.bounds, item.kind
    if item.choices:
        one = st.sampled_from(item.choices)
        min_size = 0 if item.default == () else 1
        return st.lists(one, min_size=min_size, unique=True).map(tuple) if kind == tuple[str, ...] else one
    if kind is float:
        low = bounds.above if bounds.above is not None else bounds.low
        return st.floats(low, bounds.high, exclude_min=bounds.above is not None, allow_nan=False, allow_infinity=False)
    if kind is int:
        return st.integers(bounds.low, bounds.high or 2**63 - 1)
    text = TEXT.map(lambda name: name and os.path.abspath(name)) if item.path else TEXT
    return st.booleans() if kind is bool else text


def free_settings() -> dict[str, st.SearchStrategy]:
    known = {f"{section}.{name}": item for section, kind in sections().items() for name, item in settings_of(kind).items()}
    free = {key: item for key, item in known.items() if key not in COUPLED and key.split(".")[0] not in COUPLED_SECTIONS}
    return {key: values(item) for key, item in free.items() if item.kind in (float, int, bool, str, tuple[str, ...])}


TURNS = {
    "symmetries_discrete": st.sampled_from([(), ((0.0, 0.0, 1.0, 4.0), (1.0, 0.0, 0.0, 2.0, 0.0, 0.1, 0.0))]),
    "symmetries_continuous": st.sampled_from([(), ((0.0, 1.0, 0.5),), ((0.0, 1.0, 0.0, 0.1, 0.0, 0.0),)]),
}
ROW = st.builds(ObjectRow, **{name: values(item) for name, item in settings_of(ObjectRow).items()} | TURNS)
ROWS = st.lists(ROW, max_size=3, unique_by=lambda row: row.id)


@given(overrides=st.fixed_dictionaries({}, optional=free_settings()), rows=ROWS, comments=st.booleans())
def test_any_settings_survive_writing_and_reading(tmp_path_factory, overrides, rows, comments):
    config = dataclasses.replace(load_config("smoke", overrides), object_rows=tuple(rows))
    path = tmp_path_factory.mktemp("config") / "written.toml"
    path.write_bytes(config_to_toml(config, comments=comments).encode())
    assert load_config(str(path), {}) == config


def test_values_by_key():
    config = Config().with_values({"bake.worlds": 7, "physics.step": 0.5, "bake.seed": 3})
    assert [config.value(key) for key in ("bake.worlds", "physics.step", "bake.seed")] == [7, 0.5, 3]
    assert config.with_values({"bake.worlds": 0, "physics.step": Config().physics.step, "bake.seed": 0}) == Config()
    with pytest.raises(TypeError):
        config.with_values({"bake.world": 1})


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_preset_sets_its_figures(name, tmp_path):
    """Also where a finished configuration is overridden, and read back from what is written of it."""
    sensor = load_config("smoke", {"depth_sensor.preset": name}).depth_sensor
    assert {key: getattr(sensor, key) for key in sensor_settings(name)} == sensor_settings(name)
    assert override_config(load_config("smoke"), {"depth_sensor.preset": name}).depth_sensor == sensor
    path = tmp_path / "config.toml"
    path.write_text(config_to_toml(load_config("smoke", {"depth_sensor.preset": name, "depth_sensor.disparity_noise": 0.5})))
    assert load_config(str(path)).depth_sensor == dataclasses.replace(sensor, disparity_noise=0.5)
    for key, figure in SENSORS[name].items():
        assert figure.trust in (PUBLISHED, MEASURED, ASSUMED, DEFINED), key
        assert figure.source


def test_a_sensor_preset_gives_way_to_what_stands_beside_it(tmp_path):
    path = write(tmp_path, 'preset = "smoke"\n[depth_sensor]\nbaseline = 0.06\npreset = "d435"\n')
    assert load_config(path).depth_sensor.baseline == 0.06
    assert load_config(path, {"depth_sensor.preset": "d415"}).depth_sensor.baseline == 0.055
    with pytest.raises(ConfigError, match=r"depth_sensor\.preset is \"d453\" .*; allowed: .*d435.*did you mean d4"):
        load_config("smoke", {"depth_sensor.preset": "d453"})
    # The paper's long lens at 2 m has more disparity than the D435 searches.
    with pytest.raises(ConfigError, match=r"depth_sensor\.baseline is 0\.05 .*; allowed: at most 0\.0[0-9]+, .* or a shorter lens"):
        load_config("synpick", {"depth_sensor.preset": "d435", "render.layers": ["depth_sensor"]})
