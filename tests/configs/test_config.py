"""Loading, validation and serialization of the configuration; constraints between settings."""

import dataclasses
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.calibration.tables import SENSORS, sensor_settings
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.configs.files.load import (
    COMMAND_LINE,
    config_to_toml,
    load_config,
    override_config,
    parse_assignment,
    preset_names,
    sections,
)
from synpick_warp.configs.schema import Config, ObjectRow
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.grippers import cup_collider, finger_collider
from tests.builders import refusal

RELATED = {
    "bake": "formats episodes",
    "perception": "camera",
    "gripper": "mesh cup_width kind valve",
    "randomize": "background_textures",
    "bop": "split color_format depth_scale",
    "still": "target_spread",
    "depth_sensor": "baseline disparity_step max_disparity preset",
    "move": "height start_height",
    "pick": "press_time near appear_height speed near_speed lift_height",
    "suction": "radius rays tolerated_misses good_force poor_force flow compliance surface vacuum",
}
COUPLED = {f"{section}.{name}" for section, names in RELATED.items() for name in names.split()}
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
    assert config == load_config("synpick", {}) == load_config()
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
    assert preset_names() == ["bracket-bin", "full-bin", "randomized", "smoke", "stills", *synpick, "tabletop", "tabletop-train"]
    assert load_config("synpick-released", {}).object_rows == load_config(None, {}).object_rows
    smoke = load_config("smoke", {})
    assert (smoke.move.rounds, smoke.bop.color_format, len(smoke.object_rows)) == (1, "png", 21)


def test_command_line_wins_over_file_and_file_over_preset(tmp_path):
    path = write(tmp_path, 'preset = "smoke"\n[bake]\nworlds = 7\nseed = 3\n')
    config = load_config(path, {"bake.seed": 9})
    assert (config.bake.worlds, config.bake.seed) == (7, 9)
    assert config.move.rounds == load_config("smoke", {}).move.rounds
    assert load_config(Path(write(tmp_path, 'preset = "smoke"\n'))) == load_config("smoke", {})
    assert load_config(write(tmp_path, ""), {}) == load_config(None, {})
    rows = load_config(write(tmp_path, '[[object_rows]]\nid = 5\ndiameter = 0.1\nname = "brick"\n'), {}).object_rows
    assert rows == (ObjectRow(id=5, diameter=0.1, name="brick"),)
    # A bad value is reported even if the command line replaces it.
    assert " in " in message(write(tmp_path, "[bake]\nworlds = -1\n"), {"bake.worlds": 1})


def test_values_of_other_libraries_are_read_as_pythons_and_whole_numbers_as_floats():
    given = {"bake.episodes": np.int64(3), "physics.friction": np.float32(0.5), "cameras.resolution": np.array([64, 48])}
    config = load_config("smoke", given | {"bake.models": Path("m"), "physics.gravity": 10})
    assert (config.bake.episodes, config.physics.friction, config.cameras.resolution) == (3, 0.5, (64, 48))
    assert config.bake.models == "m"
    assert isinstance(config.physics.gravity, float)
    assert config.physics.gravity == 10.0


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"bake": {"episodes": 1}}, "bake is a section, set in the settings passed; set single keys, such as bake.mode"),
        ("bake.episodes=1", 'the settings passed are "bake.episodes=1"; allowed: a dict, of full keys such as bake.episodes'),
        ({1: 2}, "there is no section 1, set in the settings passed; sections: bake, "),
        ({"bake.episodes": np.array([1, 2])}, "bake.episodes is [1, 2] in the settings passed; allowed: a whole number"),
        ({"bake.worlds": -1}, "bake.worlds is -1 in the settings passed; allowed: at least 0, at most 65536"),
    ],
)
def test_settings_that_are_no_dict_of_keys_are_named(settings, said):
    assert refusal(load_config, "smoke", settings).startswith(said)


LAYERS = "normals, albedo, nocs, classes, flow, scene_flow, depth_sensor, ir_left, ir_right, depth_stereo, suction_seal, suction_wrench"


@pytest.mark.parametrize(
    ("key", "value", "allowed"),
    [
        ("physics.step", 0.5, "at least 1e-05, at most 0.02 [s]"),
        ("physics.step", 0, "at least 1e-05, at most 0.02 [s]"),
        ("bake.worlds", -1, "at least 0, at most 65536"),
        ("bake.worlds", 2.0, "a whole number"),
        ("bake.worlds", True, "a whole number"),
        ("physics.gravity", True, "a finite number [m/s²]"),
        ("physics.gravity", float("nan"), "a finite number [m/s²]"),
        ("physics.gravity", float("inf"), "a finite number [m/s²]"),
        ("render.table", 1, "true or false"),
        ("bake.models", 3, "a string"),
        ("bake.mode", "mvoe", "pick, target, move, mixed, cycle, still; did you mean move?"),
        ("bake.mix", [1, -1, 1], "each at least 0, at most 1000"),
        ("bake.mix", [1, 1], "3 numbers in a list"),
        ("perception.exact_cycle", 13, "at least 2, at most 12"),
        ("suction.rays", 2, "at least 3, at most 64"),
        ("cameras.resolution", [0, 0], "each at least 1, at most 8192 [px]"),
        ("cameras.resolution", [640], "2 whole numbers in a list [px]"),
        ("cameras.ups", [[1, 2]], "a list of lists of 3 numbers"),
        ("render.layers", ["flow", "normal"], f"any of {LAYERS}; did you mean normals?"),
        ("render.layers", "flow", "a list of strings"),
        ("tote.color", [0.5, 0.5, 1.5], "each at least 0, at most 1 [sRGB]"),
    ],
)
def test_a_wrong_value_is_reported_with_what_is_allowed(key, value, allowed):
    assert message(None, {key: value}) == f"{key} is {json.dumps(value)} on the command line; allowed: {allowed}"


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
    # Whole numbers beyond the range of floats.
    assert "allowed: a finite number" in message(None, {"physics.gravity": 10**400})


EVERY_ROW = "keys that may hold for every row: mass, concave, metallic, roughness"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[physics]\nstep = 0.5\n", "physics.step is 0.5 in {path}; allowed: at least 1e-05, at most 0.02 [s]"),
        ("[physics]\nstepp = 1\n", "there is no key physics.stepp, set in {path}; keys of physics: step, "),
        ("[fysics]\nstep = 1\n", "there is no section fysics, set in {path}; sections: bake, objects, "),
        ("physics = 3\n", "physics is 3 in {path}; allowed: a section, [physics]"),
        ("worlds = 3\n", "there is no section worlds, set in {path}; "),
        (
            'preset = "synpik"\n',
            'there is no preset "synpik" in {path}; presets: bracket-bin, full-bin, randomized, smoke, stills, synpick, synpick-hard, ',
        ),
        ("preset = 3\n", "preset is 3 in {path}; allowed: bracket-bin, full-bin, randomized, smoke, stills, synpick, synpick-hard, "),
        ("object_rows = 3\n", "object_rows is 3 in {path}; allowed: [[object_rows]] tables"),
        ("[[object_rows]]\nid = 1\n", "object_rows[0] has no diameter in {path}; a row needs id and diameter"),
        ("[[object_rows]]\nid = 1\nweight = 2\n", "there is no key object_rows[0].weight, set in {path}; keys: id, "),
        ("[[object_rows]]\nid = 1\ndiameter = 1\nmass = 0\n", "object_rows[0].mass is 0 in {path}; allowed: above 0 [kg]"),
        (2 * "[[object_rows]]\nid = 4\ndiameter = 1\n", "object_rows has 2 rows in {path}; allowed: one row per id; 4 comes 2 times"),
        ("[object_rows]\nid = 1", f"[object_rows] has the key id in {{path}}; {EVERY_ROW}; "),
        ("[object_rows]\ndiameter = 1", "[object_rows] has the key diameter in {path}; "),
        ("[object_rows]\nmetalic = 1", "[object_rows] has the key metalic in {path}; "),
        ("[object_rows]\nmass = 0", "object_rows.mass is 0 in {path}; allowed: above 0 [kg]"),
        ("[object_rows]\nroughness = [1]", "object_rows.roughness is [1] in {path}; allowed: a finite number"),
        ("splits = 3", "splits is 3 in {path}; allowed: tables such as [splits.train]"),
        ("splits = {}", "splits is {{}} in {path}; allowed: tables"),
        ("[splits]\ntrain = 3", 'splits is {{"train": 3}} in {path}; allowed: tables'),
        ("[splits.'a/b']\nepisodes = 1", "the split a/b in {path} has no name of up to 32"),
        ("[splits.'..']\nepisodes = 1", "the split .. in {path} has no name of up to 32"),
        ("[splits.train]\nepisode = 1", "there is no key splits.train.episode, set in {path}; keys of splits.train: episodes, "),
        ("[splits.train]\nepisodes = 0", "splits.train.episodes is 0 in {path}; allowed: at least 1"),
        ("[splits.train]\nmode = 'stir'", 'splits.train.mode is "stir" in {path}; allowed: '),
        ("[splits.train]\nfirst = 2147483647", "splits.train ends with episode 2147483647 in {path}; allowed: less than"),
        ("[splits.train]\nfolder = '../out'", 'splits.train.folder is "../out" in {path}; allowed: train, val or test'),
        ("[splits.train]\nfolder = 'train'", 'bop.color_format is "jpg" by default; allowed: png with the split train'),
        ("[splits.extra]\nepisodes = 1", 'splits.extra.folder is "extra_pbr" in {path}; allowed: train, val or test'),
        (
            "[splits.train]\nepisodes = 5\n[splits.test]\nfirst = 4",
            "splits.test.first is 4 in {path}; allowed: at least 5, after the episodes of train",
        ),
        (
            "[splits.train]\n[splits.test]\nfolder = 'train_pbr'",
            "splits.test would write to train_pbr/ in {path}, as would train; set another folder",
        ),
        ("[bake]\nepisodes = 3\n[splits.train]\nepisodes = 4", "bake.episodes is 3 in {path}; allowed: 4 or none"),
        ("[bake]\nmode = 'mixed'\nmix = [0, 0, 0]\n[splits.train]\nepisodes = 4", "bake.mix is "),
        ("".join(f"[splits.train_{index}]\n" for index in range(65)), "splits has 65 tables"),
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
        ('render.layers=[\n"flow",\n]\n', "render.layers", ["flow"]),
    ],
)
def test_assignments(text, key, value):
    assert parse_assignment(text) == (key, value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("physics.step", "--set physics.step has no value"),
        ("physics.stepp=1", "there is no key physics.stepp"),
        ("step=1", "there is no section step"),
        ("=1", "there is no section "),
        ("object_rows.mass=1", "object_rows cannot be set on the command line"),
    ],
)
def test_invalid_assignments(text, said):
    assert refusal(parse_assignment, text).startswith(said)


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
    with pytest.raises(TypeError, match="world"):
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
        assert figure.trust in ("published", "measured", "assumed", "defined"), key
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


# ---- constraints between settings, and limits of each ----


SENSOR = {"render.layers": ["depth_sensor"]}
VACUUM = {"suction.vacuum": 60}
FROM_ABOVE = {"cameras.positions": [[0, 0, 60]], "cameras.ups": [[0, 1, 0]]}
UPRIGHT = "up vectors that are not zero or parallel to the viewing direction, as that of camera 0 "
FINE = "at least 4.6e-05, so that the disparity of the tote is a disparity_step"
SEES = "a point that lets each camera see the tote"
REACHES = r"a range that reaches the tote, 1.8 to 2 m from camera 0 \[m\]"
SEARCHED = r"a maximum of at most 2.5\d, from which on 256 disparities are searched, as the tote begins at 1.8 m; or a shorter lens \[m\]"


@pytest.mark.parametrize(
    ("overrides", "key", "allowed"),
    [
        ({"cameras.ups": [[0, 1, 0]]}, "cameras.ups", "one direction for each of the 3"),
        ({"cameras.ups": [[0, 0, 0]] * 3}, "cameras.ups", UPRIGHT),
        ({"cameras.target": [0, 0, 2]}, "cameras.positions", "positions other than cameras.target"),
        ({"cameras.positions": [], "cameras.ups": []}, "cameras.positions", "at least one position"),
        ({"tote.floor_size": [0.6, 0.3]}, "tote.rim_size", "at least tote.floor_size on both sides"),
        ({"tote.outer_size": [0.55, 0.373, 0.2]}, "tote.outer_size", r"at least .* two walls, \[0.554, 0.361\] \[m\]"),
        ({"settle.min_time": 20}, "settle.max_time", r"at least settle.min_time, 20 \[s\]"),
        ({"settle.rest_ticks": 1000}, "settle.max_time", "at least the time of settle.rest_ticks ticks"),
        ({"move.start_height": 0.01}, "move.start_height", r"at least move.height, 0.02 \[m\]"),
        ({"bake.mode": "mixed", "bake.mix": [0, 0, 0]}, "bake.mix", "at least one weight above 0, with the mode mixed"),
        ({"pick.near": 1.5}, "pick.appear_height", r"at least pick.near, 1.5 \[m\]"),
        ({"pick.near_speed": 1.5}, "pick.speed", r"at least pick.near_speed, 1.5 \[m/s\]"),
        ({"pick.lift_height": 0.1}, "pick.lift_height", "at least the inner height of the tote, 0.195"),
        ({"suction.radius": 0.022}, "suction.radius", r"at most half of gripper.cup_width, 0.021 \[m\]"),
        ({"suction.rays": 4, "suction.tolerated_misses": 4}, "suction.tolerated_misses", "less than suction.rays, 4: "),
        ({"suction.flow": 30.0}, "suction.flow", r"none without suction.vacuum, such as 60 \[kPa\]"),
        (VACUUM | {"suction.rays": 10}, "suction.rays", "at least 48 with suction.vacuum: fewer miss holes"),
        (VACUUM | {"suction.surface": "hull"}, "suction.surface", "mesh with suction.vacuum"),
        (VACUUM | {"suction.good_force": 40}, "suction.good_force", r"none .*, 83.1265 \[N\]"),
        ({"suction.poor_force": 41}, "suction.poor_force", r"at most suction.good_force, 40 \[N\]"),
        ({"physics.sleep": 2e-4, "bop.graph": True}, "physics.sleep", "0 with bop.graph, which reads"),
        ({"bop.split": "train"}, "bop.color_format", "png with the split train: "),
        ({"bop.color_format": "png"}, "bop.color_format", "jpg with the split train_pbr: "),
        ({"bop.split": "a/b"}, "bop.split", "train, val or test"),
        ({"render.layers": ["flow", "nocs", "flow"]}, "render.layers", r'each layer once: \["flow", "nocs"\]'),
        ({"bake.formats": ["shards"], "bake.episodes": 333_334}, "bake.episodes", "episode indices below 333333 with the format shards"),
        # Labels that would be empty or wrong: depth that overflows or is 0, cameras that see no object, sensors out of range.
        ({"bop.depth_scale": 0.01}, "bop.depth_scale", "at least 0.03"),
        ({"bop.depth_scale": 1e6}, "bop.depth_scale", r"above 0, at most 10 \[mm\]"),
        (FROM_ABOVE | {"bop.depth_scale": 0.5}, "bop.depth_scale", r"at least 0.916, so that 16 bits reach the tote at 60 m \[mm\]"),
        ({"cameras.positions": [[0, 0, 1e9]]}, "cameras.positions", r"each at least -100, at most 100 \[m\]"),
        ({"cameras.positions": [[0, 0.5, -0.3]] * 3}, "cameras.positions", "positions above the tote's floor, z > 0"),
        ({"cameras.target": [3, 0, 0]}, "cameras.target", f"{SEES}.* camera 0"),
        ({"cameras.target": [0, 0.5, 1.9], "cameras.fov": 40}, "cameras.target", SEES),
        (SENSOR | {"depth_sensor.distances": [5, 9]}, "depth_sensor.distances", REACHES),
        (SENSOR | {"depth_sensor.distances": [0.1, 1]}, "depth_sensor.distances", "a range that reaches the tote"),
        (SENSOR | {"depth_sensor.baseline": 1e-5}, "depth_sensor.baseline", FINE),
        ({"render.layers": ["ir_right"], "depth_sensor.distances": [5, 9]}, "depth_sensor.distances", REACHES),
        ({"render.layers": ["depth_stereo"], "depth_sensor.baseline": 0.3}, "depth_sensor.distances", SEARCHED),
        ({"depth_sensor.grazing_angle": 1}, "depth_sensor.grazing_angle", "at least 10, at most 89"),
        ({"depth_sensor.multipath": 1.5}, "depth_sensor.multipath", "at least 0, at most 1"),
        ({"render.exposure": 1e9}, "render.exposure", "at least 0.01, at most 100"),
        ({"render.exposure": 1e-9}, "render.exposure", "at least 0.01, at most 100"),
        ({"gripper.cup_length": 1e6}, "gripper.cup_length", r"at least 0.005, at most 0.5 \[m\]"),
        ({"gripper.finger_width": 1e-9}, "gripper.finger_width", r"at least 0.005, at most 1 \[m\]"),
        ({"move.speed": 1e-9}, "move.speed", r"at least 0.001, at most 100 \[m/s\]"),
        ({"pick.floor": -1000}, "pick.floor", r"at least -10, at most 0 \[m\]"),
        ({"physics.step": 1e-30}, "physics.step", r"at least 1e-05, at most 0.02 \[s\]"),
        ({"tote.outer_size": [1e6, 1e6, 0.2]}, "tote.outer_size", r"each above 0, at most 10 \[m\]"),
    ],
)
def test_values_that_contradict_each_other(overrides, key, allowed):
    """The message names the setting with its value, whether it comes from the command line or by default, and what is allowed."""
    found = re.match(rf"{key} is (.*) (on the command line|by default); allowed: {allowed}", message(None, overrides))
    assert found
    value, source = found.groups()
    assert source == ("on the command line" if key in overrides else "by default")
    assert json.loads(value) == overrides.get(key, json.loads(json.dumps(load_config().value(key))))


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
