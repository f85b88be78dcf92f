"""Conversion of data sets: byte equality with a bake of the format, resuming, and errors in one line, also of trajectories that lack
something. A package of others (tests/plugins) adds a format, a gripper and a layer, which are known as ours are."""

import ast
import dataclasses
import importlib
import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.conversion.run import check_formats, convert
from synpick_warp.cli.main import EXIT_MISTAKE
from synpick_warp.configs.schema import FORMATS, Config, Split
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.trajectory.arrays import OBJECTS, STORE
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.testing import box_views
from synpick_warp.testing.exporters import ExporterContract
from tests.builders import PICKING, assignments, mistake, once, refusal
from tests.builders import run as command
from tests.harness import scripted_bake
from tests.harness.environment import checkout_environment
from tests.harness.scripted_bake import INPUTS, snapshot


def settings(*formats: str, jpg: bool = False, keypoints: int = 0) -> Config:
    """Settings of two episodes with two layers: two splits as PNG, or one as JPEG."""
    given = {"bop.split": "train_pbr" if jpg else "train", "bop.color_format": "jpg" if jpg else "png", "bop.keypoints": keypoints}
    config = scripted_bake.settings(2, formats).with_values(given | {"render.layers": ("flow", "classes")})
    return dataclasses.replace(config, splits=() if jpg else (Split("train", 1, 0, "pick", "train"), Split("test", 1, 1, "pick", "test")))


WANTED = {
    "source": settings("bop", "zarr"),
    **{name: settings(name) for name in ("shards", "bop", "lerobot", "usd", "coco", "yolo", "points")},
    "keypoints": settings("bop", keypoints=8),
    "keypoints shards": settings("shards", keypoints=8),
    "keypoints coco": settings("coco", keypoints=8),
    "jpg": settings("bop", jpg=True),
    "jpg shards": settings("shards", jpg=True),
}


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> dict[str, Path]:
    """Data sets that were baked directly, by name."""

    def make(folder: Path) -> None:
        for name, config in WANTED.items():
            scripted_bake.bake(folder / name, config)

    folder, _ = once(tmp_path_factory, "conversion", make)
    return {name: folder / name for name in WANTED}


@pytest.fixture
def source(sets, tmp_path) -> Path:
    """A copy of the set of scenes and trajectories, to be edited."""
    return Path(shutil.copytree(sets["source"], tmp_path / "source"))


@pytest.fixture
def assets(monkeypatch):
    """Objects, lights and cameras of the scripted bake, in place of those that settings name."""
    monkeypatch.setattr("synpick_warp.scenes.catalog.load_catalog", lambda _: box_views.catalog())
    monkeypatch.setattr("synpick_warp.scenes.lights.load_lights", lambda _: skies())
    monkeypatch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: box_views.cameras(16, 12))
    monkeypatch.setattr("synpick_warp.dataset.commit.writing.digest_inputs", lambda *_: INPUTS)


def run(source: Path, out: Path, *formats: str, report=lambda *_: None):
    return convert(source, out, formats, 1, report)


BAKED = {
    "source": ("shards", "lerobot", "usd", "coco", "yolo", "points"),
    "shards": ("bop", "coco", "yolo", "points"),
    "keypoints": ("keypoints coco",),
    "keypoints shards": ("keypoints coco", "keypoints"),
    "jpg": ("jpg shards",),
    "jpg shards": ("jpg",),
}
"""What is made of each set."""


@pytest.mark.parametrize(("name", "baked"), [(name, baked) for name, made in BAKED.items() for baked in made])
def test_converted_sets_equal_baked_ones_byte_for_byte(sets, tmp_path, assets, name, baked):
    before = snapshot(sets[name])
    assert run(sets[name], tmp_path / "out", *WANTED[baked].bake.formats)[:2] == (2, 0)
    converted, expected = snapshot(tmp_path / "out"), snapshot(sets[baked])
    assert sorted(converted) == sorted(expected)
    assert [name for name in expected if converted[name] != expected[name]] == []
    assert snapshot(sets[name]) == before
    assert verify(tmp_path / "out").problem == ""


def test_several_formats_are_converted_at_once(sets, tmp_path):
    synpick_warp.convert(sets["source"], tmp_path / "out", ("shards", "lerobot"), threads=2)
    for name in ("test_web/shard-000003.tar", "lerobot/meta/stats.json", "lerobot/parts/000001.json"):
        baked = sets["lerobot" if name.startswith("lerobot") else "shards"]
        assert (tmp_path / "out" / name).read_bytes() == (baked / name).read_bytes()


@pytest.mark.parametrize("name", ["lerobot", "coco", "yolo", "points"])
def test_sets_without_views_have_episodes_and_attempts(sets, name):
    data = synpick_warp.open(sets[name])
    assert {split: list(part) for split, part in data.splits.items()} == {"train": [0], "test": [1]}
    assert (data[1].row["split"], len(data[1].attempts)) == ("test", 1)
    with pytest.raises(DatasetError, match="has no images of episode 1; bake with --formats bop or shards"):
        data[1].view(0)
    assert "2 episodes have no images" in command("stats", sets[name]).out
    mistake("validate", sets[name])
    mistake("preview", sets[name], "--out", sets[name].parent / "sheet.png")


def test_an_interrupt_leaves_no_files_beside_committed_episodes(sets, tmp_path):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(sets["source"], tmp_path / "out", "shards", report=interrupt)
    assert not (tmp_path / "out").exists()


def test_episodes_that_delivered_nothing_stay_in_the_lists(source, tmp_path):
    """An edited source: the second episode gave up while it settled."""
    entry = source / "manifest" / "000001.json"
    content = json.loads(entry.read_text())
    content["row"] |= {"ending": "unsettled", "sentence": "the objects did not come to rest"}
    entry.write_text(json.dumps(content))
    assert run(source, tmp_path / "out", "shards").episodes == 2
    assert {path.name for path in (tmp_path / "out").glob("*_web/*.tar")} == {f"shard-{scene:06d}.tar" for scene in range(3)}
    assert len((tmp_path / "out" / "episodes.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("name", "formats", "error", "message"),
    [
        ("source", ("zarr",), ConfigError, "allowed: bop, shards, usd, lerobot, coco, yolo, points; no other format has the physics"),
        ("source", ("hdf5",), ConfigError, "--to names hdf5; allowed"),
        ("source", ("bop",), ConfigError, "has already"),
        ("usd", ("shards",), DatasetError, "has no images"),
        ("bop", ("usd",), DatasetError, r"has no trajectory\.zarr"),
        ("bop", ("lerobot",), DatasetError, r"has no trajectory\.zarr"),
    ],
)
def test_what_cannot_be_converted_is_one_error_and_leaves_nothing(sets, tmp_path, name, formats, error, message):
    with pytest.raises(error, match=message):
        run(sets[name], tmp_path / "out", *formats)
    assert not (tmp_path / "out").exists()


def test_sets_of_several_sensors_are_refused():
    with pytest.raises(ConfigError, match=r"has bop.layout = .*, which convert does not"):
        check_formats(("shards",), "multisensor", ("bop", "zarr"), Path("DATA"))


def test_the_objects_of_the_bake_are_needed(sets, tmp_path, assets, monkeypatch):
    """Of keypoints and of USD files."""
    source = tmp_path / "source"
    shutil.copytree(sets["keypoints"], source)
    truth = source / "train/000000/scene_gt.json"
    truth.write_text(truth.read_text().replace('"obj_id":7', '"obj_id":8'))
    with pytest.raises(DatasetError, match="obj_id 8, which is none of the bake's objects"):
        run(source, tmp_path / "first", "coco")
    monkeypatch.setattr("synpick_warp.dataset.commit.writing.digest_inputs", lambda *_: {"objects": "other"})
    for name, to in (("keypoints", "coco"), ("source", "usd")):
        with pytest.raises(DatasetError, match="have changed since its bake"):
            run(sets[name], tmp_path / "second", to)
    assert not (tmp_path / "second").exists()


@pytest.mark.parametrize("place", [".", "inside", ".."])
def test_output_folders_lie_apart_from_the_source(sets, place):
    with pytest.raises(DatasetError, match="holds or lies in"):
        run(sets["source"], sets["source"] / place, "shards")


DEPTH = "test/000004/depth/000001.png"
FAULTS = {
    "missing image": (DEPTH, Path.unlink),
    "no image": (DEPTH, lambda path: path.write_bytes(b"text")),
    "other size": (DEPTH, lambda path: cv2.imwrite(str(path), np.zeros((4, 4), np.uint16))),
    "damaged json": ("test/000004/scene_gt.json", lambda path: path.write_text("{")),
    "missing model": ("models/obj_000003.ply", Path.unlink),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damaged_sources_are_one_error(source, tmp_path, fault):
    name, damage = FAULTS[fault]
    damage(source / name)
    said = refusal(run, source, tmp_path / "out", "shards")
    assert ("obj_000003" if fault == "missing model" else "000004") in said
    assert "cannot write" not in said


def test_masks_beyond_their_boxes_are_read_whole(sets, source, tmp_path):
    """An edited source whose boxes are wrong: masks are what counts."""
    for scene in source.glob("t*/00000?"):
        infos = json.loads((scene / "scene_gt_info.json").read_text())
        for rows in infos.values():
            for row in rows:
                row["bbox_visib"] = [0, 0, 1, 1]
        (scene / "scene_gt_info.json").write_text(json.dumps(infos))
    run(source, tmp_path / "out", "shards")
    views = [next(iter(synpick_warp.open(folder).views())) for folder in (tmp_path / "out", sets["source"])]
    np.testing.assert_array_equal(views[0].masks, views[1].masks)
    assert views[0].masks.any()


def test_command_says_what_it_made(sets, tmp_path):
    ran = command("convert", sets["source"], "--to", "shards", "--out", tmp_path / "out", "--threads", 1)
    assert (ran.code, "2 episodes converted to shards" in ran.out) == (0, True)
    mistake("convert", sets["source"], "--to", "shards,tar", "--out", tmp_path / "other")
    mistake("convert", tmp_path / "none", "--to", "shards", "--out", tmp_path / "other")
    assert not (tmp_path / "other").exists()


EPISODE = STORE / "episodes" / "000001"
NEEDED = ("time", "object_id", "pose", "fixture_pose", "fixture_visible")
GRIPPER = (*(f"ticks/{name}" for name in ("task", "attached")), "steps/setpoint", "steps")


def converted(source: Path, to: str) -> str:
    """The line with which a conversion ends that writes nothing; empty if it succeeds."""
    out = source.parent / "out"
    code, _, error = command("convert", source, "--to", to, "--out", out, "--threads", 1)
    assert (code, error.count("\n"), out.exists()) in ((0, 0, True), (EXIT_MISTAKE, 1, False)), error
    return error


@pytest.mark.parametrize("to", ["lerobot", "usd"])
@pytest.mark.parametrize("array", [*(f"ticks/{name}" for name in NEEDED), "ticks", "", *GRIPPER])
def test_an_array_that_is_missing_is_one_line(source, assets, to, array):
    shutil.rmtree(source / EPISODE / array)
    line = converted(source, to)
    if to == "usd" and array in GRIPPER:
        assert line == ""
    else:
        assert "000001" in line
        assert array.rpartition("/")[2] in line


@pytest.mark.parametrize("to", ["lerobot", "usd"])
@pytest.mark.parametrize("change", ["light", "light.map", "light.yaw", "light.exposure", "light.map = 99", "light.yaw = null", "light = 3"])
def test_an_attribute_that_is_missing_or_wrong_is_one_line(source, assets, to, change):
    edit(source / EPISODE / "zarr.json", change)
    line = converted(source, to)
    assert "light" in line or change.split(" ")[0].rpartition(".")[2] in line


@pytest.mark.parametrize("place", [STORE, EPISODE, STORE / "objects"])
@pytest.mark.parametrize("change", ["", "names", "steps_per_tick", "steps_per_tick = 3", "lights"])
def test_a_group_without_metadata_or_with_others_ends_in_one_line_or_the_same_files(source, assets, place, change):
    """Whatever of the metadata is lost: a line, or a conversion that did not need it."""
    edit(source / place / "zarr.json", change) if change else (source / place / "zarr.json").unlink()
    converted(source, "lerobot")


@pytest.mark.parametrize("name", sorted(OBJECTS.arrays))
def test_an_array_of_the_object_table_that_is_missing_is_one_line(source, assets, name):
    shutil.rmtree(source / STORE / "objects" / name)
    assert name in converted(source, "lerobot")


@pytest.mark.parametrize("key", ["outcome", "frame", "end_frame", "object_id", "outcome = 3", "frame = -1", "row.arrangement"])
def test_an_attempt_without_what_tasks_are_made_of_is_one_line(source, assets, key):
    path = source / "manifest" / "000001.json"
    entry = json.loads(path.read_text())
    change(entry["row"] if key.startswith("row.") else entry["attempts"][0], key.removeprefix("row."))
    path.write_text(json.dumps(entry))
    assert converted(source, "lerobot")


def test_setpoints_that_were_not_baked_are_named(source, assets):
    """Without recorded setpoints (trajectory.steps = false) actions would repeat the cup's positions."""
    shutil.rmtree(source / STORE / "episodes" / "000000" / "steps")
    line = converted(source, "lerobot")
    assert "has no steps" in line
    assert "trajectory.steps = true" in line


def edit(path: Path, text: str) -> None:
    content = json.loads(path.read_text())
    change(content["attributes"], text)
    path.write_text(json.dumps(content))


def change(content: dict, text: str) -> None:
    """Remove a key, such as "light.map", or set it, as "light.map = 99" does."""
    key, _, value = text.partition(" = ")
    *parents, last = key.split(".")
    for parent in parents:
        content = content[parent]
    if value:
        content[last] = json.loads(value)
    else:
        content.pop(last, None)


# ---- a package of others ----

PLUGINS = Path(__file__).parents[1] / "plugins"


@pytest.fixture
def boxes(monkeypatch) -> None:
    monkeypatch.syspath_prepend(PLUGINS)
    from synpick_extras.boxes import FORMAT

    monkeypatch.setitem(FORMAT_TABLE, "boxes", FORMAT)


RUN_COMMANDS = "from synpick_warp.cli.main import main; print([main(line) for line in {}])"
READ_RANGE = """
import numpy as np, synpick_warp
view = synpick_warp.open("DATA")[0].view(0)
rows, columns = np.indices(view.depth.shape)
rays = np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)], axis=2) @ np.linalg.inv(np.asarray(view.intrinsics)).T
np.testing.assert_allclose(view.layer("range"), 1e3 * view.depth * np.linalg.norm(rays, axis=2), atol=1.1)  # rounded [mm]
"""


BROKEN = {
    ("formats", "absent"): (None, "cannot be loaded: ModuleNotFoundError"),
    ("formats", "wrong"): ("FORMAT =", "cannot be loaded: SyntaxError"),
    ("formats", "hollow"): ("class FORMAT: ...", "is broken_hollow:FORMAT, which has no "),
    ("layers", "hollow"): ("class FORMAT: ...", "is broken_hollow:FORMAT, which has no "),
}
"""Group and name of what a package adds: its module, and what is said of it."""


@pytest.mark.slow
def test_packages_of_others_bake_their_format_with_their_gripper_and_layer_and_broken_ones_harm_only_what_uses_them(tmp_path):
    folder = tmp_path / "extras" / "broken_extras-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-extras\nVersion: 1.0\n")
    lines = {group: [f"[synpick_warp.{group}]", "bop = broken_hollow:FORMAT"] for group, _ in BROKEN}
    for (group, name), (module, _) in BROKEN.items():
        lines[group].append(f"{name} = broken_{name}:FORMAT")
        if module is not None:
            (folder.parent / f"broken_{name}.py").write_text(module)
    (folder / "entry_points.txt").write_text("\n".join(itertools.chain.from_iterable(lines.values())))
    given = PICKING | {"gripper.kind": "triangle", "render.layers": ["range"], "bop.masks": False, "cameras.resolution": [96, 54]}
    options = ("--formats", "boxes,bop,zarr", "--device", "cpu", *assignments(given | {"bake.episodes": 1}))
    bake = ["bake", "--config", "smoke", "--out"]
    uses = [["--formats", name] if group == "formats" else ["--set", f'render.layers=["{name}"]'] for group, name in BROKEN]
    commands = [[*bake, "DATA", *options], ["verify", "DATA"], *([*bake, "NONE", *use] for use in uses)]
    environment = checkout_environment()
    environment["PYTHONPATH"] += f":{PLUGINS}:{folder.parent}"
    program = [sys.executable, "-c", f"{RUN_COMMANDS.format(commands)}{READ_RANGE}"]
    done = subprocess.run(program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("[0, 0, 2, 2, 2, 2]\n"), done.stderr
    assert len(list((tmp_path / "DATA" / "boxes").glob("*/*.json"))) > 10
    assert "triangle" in (tmp_path / "DATA" / "config.toml").read_text()
    errors = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(errors) == len(BROKEN)
    for (_, name), (_, said), error in zip(BROKEN, BROKEN.values(), errors, strict=True):
        assert name in error
        assert said in error
    assert "Traceback" not in done.stderr


class TestFormatOfOthers(ExporterContract):
    """As a package of others tests its format: `synpick_warp.testing`."""

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def installed(cls):
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(PLUGINS)
            patch.setenv("PYTHONPATH", str(PLUGINS), prepend=os.pathsep)
            module = importlib.import_module("synpick_extras.boxes")
            cls.exporter_class, cls.row = module.BoxesExporter, module.FORMAT
            yield


def test_a_new_format_is_converted_for_free(tmp_path, boxes, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: box_views.cameras(16, 12))
    for name in ("bop", "shards", "boxes"):
        scripted_bake.bake(tmp_path / name, settings(name))
    baked = snapshot(tmp_path / "boxes")
    assert sum(name.endswith("_flow.png") for name in baked) == 2 * 3 * scripted_bake.FRAMES
    for source in ("bop", "shards"):
        convert(tmp_path / source, tmp_path / f"{source}-boxes", ("boxes",), 1, lambda *_: None)
        assert snapshot(tmp_path / f"{source}-boxes") == baked


def test_nothing_else_lists_formats():
    """Collections that name three formats or more, besides settings and their rules, which must not import exporters."""
    listing = set()
    root = Path(synpick_warp.__file__).parent
    for path in set(root.rglob("*.py")) - set((root / "configs").rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if sum(f'"{name}"' in text for name in FORMATS) >= 3 else ():
            values = node.keys if isinstance(node, ast.Dict) else node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else ()
            if sum(isinstance(value, ast.Constant) and value.value in FORMATS for value in values) >= 3:
                listing.add(path.name)
    assert listing == {"formats.py"}
