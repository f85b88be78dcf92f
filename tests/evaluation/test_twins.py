"""Twins of annotated images: what they change, what they keep, and runs that are interrupted or refused."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation import twins
from synpick_warp.apps.evaluation.twins import RECORD, write_twins
from tests.builders import mistake, run


def test_twins_differ_in_the_pixels_of_objects_alone(picked_set, tmp_path):
    """All but colour images has the bytes of the data set; a twin differs inside of visible masks, and is bright under a bright light."""
    out = tmp_path / "twins"
    code, text, error = run("gap", picked_set, "--out", out, "--device", "cpu", "--set", "render.exposure=2.0")
    assert code == 0, error
    real, made = synpick_warp.open(picked_set), synpick_warp.open(out)
    files = {path.relative_to(out): path for path in out.rglob("*") if path.is_file()}
    record = [json.loads(line) for line in files.pop(Path(RECORD)).read_text().splitlines()]
    assert files.keys() == {path.relative_to(picked_set) for path in picked_set.rglob("*") if path.is_file()}
    changed = {str(name.parent.name) for name, path in files.items() if path.read_bytes() != (picked_set / name).read_bytes()}
    assert changed == {"rgb"}
    brighter = 0
    for image, twin in zip(real.views(), made.views(), strict=True):
        shown = image.masks.any(axis=0)
        far = np.abs(image.rgb.astype(int) - twin.rgb).max(axis=2) > 40  # JPEG rings by less.
        assert not (far & ~shown).any()
        brighter += int((twin.rgb[shown].astype(int) - image.rgb[shown]).mean() > 20) if shown.any() else 0
    assert brighter > 1
    assert text.count("\n") == 3 + len({int(index) for view in real.views() for index in view.object_ids})
    likeness = [one for image in record for one in image["objects"]]
    assert len(record) == sum(len(view) > 0 for view in real.views())
    assert {Path(image["image"]) for image in record} <= files.keys()
    assert min(one["geometry"] for one in likeness) > 0.98  # Rendered from the poses of the images' own renderings.
    assert all(0.0 < one["score"] < 1.0 for one in likeness)


def test_twins_of_a_sensor_stand_where_its_images_do(picked_set, tmp_path):
    """A grey sensor's folder has its name, files have four digits, and no camera has a pose: twins are grey, the linked data set keeps its
    bytes, and another split is left out."""
    real = tmp_path / "real"
    shutil.copytree(picked_set / "models", real / "models")
    scene = shutil.copytree(next(picked_set.glob("*/000000/rgb")).parent, real / "test" / "000000")
    (scene / "rgb").rename(scene / "gray1")
    for path in list((scene / "gray1").iterdir()):
        cv2.imwrite(str(path.with_name(f"{path.stem[2:]}.png")), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        path.unlink()
    for path in list(scene.iterdir()):
        if re.fullmatch("(scene_(camera|gt|gt_info).json|depth|mask|mask_visib)", path.name):
            path.rename(path.with_name(f"{path.stem}_gray1{path.suffix}"))
    cameras = scene / "scene_camera_gray1.json"
    cameras.write_text(re.sub(r'"cam_[Rt]_w2c": ?\[[^]]*\],? ?', "", cameras.read_text()).replace(", }", "}"))
    before = {path: path.read_bytes() for path in real.rglob("*") if path.is_file()}
    shutil.copytree(scene, real / "train" / "000001")
    code, _, error = run("gap", real, "--out", tmp_path / "a" / "twins", "--device", "cpu", "--split", "test")
    assert code == 0, error
    assert "images without cam_R_w2c are taken as upright" in error
    made = {path.relative_to(tmp_path / "a" / "twins"): path for path in (tmp_path / "a" / "twins").rglob("*") if path.is_file()}
    del made[Path(RECORD)]
    assert {real / name for name in made} == before.keys()
    assert all(path.read_bytes() == data for path, data in before.items())
    changed = [path for name, path in made.items() if path.read_bytes() != before[real / name]]
    assert changed
    assert {path.parent.name for path in changed} == {"gray1"}
    assert {cv2.imread(str(path), cv2.IMREAD_UNCHANGED).ndim for path in changed} == {2}


def small_set(picked_set: Path, folder: Path) -> Path:
    """Scene folder of a data set of one split and scene, from another source."""
    shutil.copytree(picked_set / "models", folder / "models")
    return shutil.copytree(next(picked_set.glob("*/000000/rgb")).parent, folder / "test" / "000000")


def test_a_killed_run_goes_on_where_it_was(picked_set, tmp_path, monkeypatch):
    """After twins of half of the images, with the next image's file and line cut off: what is there stays, and the result is that of one
    run. Other settings start anew, and leave the first run's work alone."""
    small_set(picked_set, tmp_path / "real")
    real, settings = synpick_warp.open(tmp_path / "real"), synpick_warp.load_config(None, {"bake.device": "cpu", "render.table": False})
    whole = write_twins(real, tmp_path / "whole", settings, note=lambda text: None)
    views = len((tmp_path / "whole" / RECORD).read_text().splitlines())
    monkeypatch.setattr(twins, "BATCH_PIXELS", 1)

    def kill(label: str, done: int, count: int) -> None:
        if done == views // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_twins(real, tmp_path / "twins", settings, kill, lambda text: None)
    (part,) = tmp_path.glob(".twins-*")
    assert not (tmp_path / "twins").exists()
    with (part / RECORD).open("ab") as record:
        record.write(b'{"image":"te')
    done = [part / json.loads(line)["image"] for line in (part / RECORD).read_text().splitlines()[:-1]]
    before = {path: path.stat().st_mtime_ns for path in done}
    torn = next(path for path in sorted((part / "test" / "000000" / "rgb").iterdir()) if path not in done)
    torn.unlink()
    torn.write_bytes(b"torn")
    other = settings.with_values({"render.exposure": 2.0})
    with pytest.raises(KeyboardInterrupt):
        write_twins(real, tmp_path / "twins", other, kill, lambda text: None)
    counts = []
    assert write_twins(real, tmp_path / "twins", settings, lambda *state: counts.append(state[1]), lambda text: None) == whole
    assert counts == list(range(views // 2 + 1, views + 1))
    assert {path: (tmp_path / "twins" / path.relative_to(part)).stat().st_mtime_ns for path in done} == {**before}
    for path in (tmp_path / "whole").rglob("*"):
        assert path.is_dir() or path.read_bytes() == (tmp_path / "twins" / path.relative_to(tmp_path / "whole")).read_bytes()
    assert len(list(tmp_path.glob(".twins-*"))) == 1


def test_what_changed_after_an_interruption_is_made_anew(picked_set, tmp_path, monkeypatch):
    """Corrected poses hold for all twins; of a damaged record the lines before the damage count."""
    scene = small_set(picked_set, tmp_path / "real")
    real, settings = tmp_path / "real", synpick_warp.load_config(None, {"bake.device": "cpu", "render.table": False})
    monkeypatch.setattr(twins, "BATCH_PIXELS", 1)
    counts = []

    def kill(label: str, done: int, count: int) -> None:
        counts.append(done)
        if done == 3:
            raise KeyboardInterrupt

    def write(*given) -> list[twins.Likeness]:
        return write_twins(synpick_warp.open(real), tmp_path / "twins", settings, *given, note=lambda text: None)

    with pytest.raises(KeyboardInterrupt):
        write(kill)
    (part,) = tmp_path.glob(".twins-*")
    line, _, rest = (part / RECORD).read_bytes().partition(b"\n")
    (part / RECORD).write_bytes(line + b"\n\0\0\n" + rest)
    with pytest.raises(KeyboardInterrupt):
        write(kill)
    assert counts == [1, 2, 3, 2, 3]
    (scene / "scene_gt.json").write_text(re.sub(r'("cam_t_m2c": ?\[)[^]]*', r"\g<1>0, 0, -500", (scene / "scene_gt.json").read_text()))
    assert {one.score for one in write()} == {0.0}


def test_images_keep_their_channels_and_bits(picked_set, tmp_path):
    """The first image with 16 bits, the second with opacity: objects have the twin's 8 bits, all else stays."""
    scene = small_set(picked_set, tmp_path / "real")
    names = sorted((scene / "rgb").iterdir())
    stored = {}
    for number, path in enumerate(names):
        image = cv2.imread(str(path))
        path.unlink()
        if number == 0:
            image = image.astype(np.uint16) * 256 + 7
        if number == 1:
            image = np.dstack([image, np.full(image.shape[:2], 99, np.uint8)])
        stored[path.with_suffix(".png").name] = image
        cv2.imwrite(str(path.with_suffix(".png")), image)
    code, _, error = run("gap", tmp_path / "real", "--out", tmp_path / "twins", "--device", "cpu")
    assert code == 0, error
    assert error.count("images of 16 bits a channel are taken as sRGB over their whole range") == 1
    for number, (name, image) in enumerate(stored.items()):
        twin = cv2.imread(str(tmp_path / "twins" / "test" / "000000" / "rgb" / name), cv2.IMREAD_UNCHANGED)
        assert (twin.shape, twin.dtype) == (image.shape, image.dtype)
        changed = (twin != image).any(axis=2)
        assert changed.any() or number > 1  # In the last one no object is left.
        assert number or (twin[changed] % 257 == 0).all()
        assert number != 1 or (twin[..., 3] == 99).all()


def test_what_has_no_twins_is_one_line(picked_set, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert "allowed: a new or an empty folder" in mistake("gap", picked_set, "--out", tmp_path / "full")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "is_mount", lambda path: path.name == "new")
        assert "new, a mount point" in mistake("gap", picked_set, "--out", tmp_path / "new")
    assert "is not a data set" in mistake("gap", tmp_path / "full", "--out", tmp_path / "new")
    scene = small_set(picked_set, tmp_path / "real")
    truth = (scene / "scene_gt.json").read_text()
    (scene / "scene_gt.json").write_text(re.sub(r'("cam_R_m2c": ?\[)[^]]*', r"\g<1>1, 0, 0, 0, 1, 0, 0, 0, -1", truth))
    assert "cam_R_m2c that is no rotation" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new", "--device", "cpu")
    (scene / "scene_gt.json").write_text(truth)
    for damaged in (sorted((scene / "rgb").iterdir())[-1], sorted((scene / "mask_visib").iterdir())[-1]):
        content = damaged.read_bytes()
        damaged.write_bytes(b"no image")
        assert f"{damaged} is not an image" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new", "--device", "cpu")
        damaged.unlink()
        assert f"there is no {damaged.with_suffix('')}" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new", "--device", "cpu")
        damaged.write_bytes(content)
    assert {path.name for path in tmp_path.iterdir()} == {"full", "real"}
    (scene / "scene_gt.json").unlink()
    (scene / "scene_gt_info.json").unlink()
    assert "no image with objects" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()
