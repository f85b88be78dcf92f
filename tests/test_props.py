"""Props, which stand around the bin or follow the gripper: drawn, in the way of light and objects, and without labels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdPhysics

from synpick_warp.codes import Segment
from synpick_warp.configs.cell.bins import EMBEDDED, PropRow
from synpick_warp.configs.cell.cameras import GRIPPER, Pose
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.dataset.commit.writing import digest_inputs
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.props import make_props
from synpick_warp.scenes.types import Fixture, Prop
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING, boxes, mistake, refusal
from tests.worlds.cells import check_same
from tests.worlds.model_files import box, put
from tests.worlds.shapes import UPRIGHT, camera, surface
from tests.worlds.shapes import box as box_mesh
from tests.worlds.small_worlds import cluttered_catalog, settings
from tests.worlds.toy_scene import assert_same, one, render, with_render

CENTER, HEIGHT = (0.0, 0.0, 2.0), 0.1
"""Camera that looks down [m], and height of a prop under it."""


def shield(**given) -> Prop:
    """A box over the half of the scene with negative x, its lower side 1 m above the ground."""
    material = surface((0.8, 0.1, 0.1))
    return Prop(
        "shield", Fixture(box_mesh(1.0, 1.0, HEIGHT), material), (-0.5, 0.0, 1.0 + HEIGHT / 2, *UPRIGHT), **{"follows": False, **given}
    )


def half_hidden(**more):
    """A cube under the camera, half of which the shield hides."""
    return one(box_mesh(0.1, 0.1, 0.1), (0.0, 0.0, 0.05, *UPRIGHT), camera(96, 64, 300.0, CENTER), **more)


# ---- pictures ----


def test_a_prop_hides_what_is_behind_it(device):
    open_view, hidden = render(half_hidden(table=True), device), render(half_hidden(table=True, props=(shield(),)), device)
    left, right = np.s_[:, :, :48], np.s_[:, :, 48:]
    assert_same(open_view, hidden, "masks")
    np.testing.assert_array_equal(hidden.pixels[0, 0, :2], open_view.pixels[0, 0, :2])
    np.testing.assert_array_equal(hidden.boxes[0, 0, 0], open_view.boxes[0, 0, 0])
    assert 2 * hidden.pixels[0, 0, 2] == open_view.pixels[0, 0, 2] == open_view.pixels[0, 0, 0] > 0
    assert (hidden.instance[left] == Segment.TABLE).all()
    np.testing.assert_array_equal(hidden.instance[right], open_view.instance[right])
    np.testing.assert_allclose(hidden.exact_depth[left], CENTER[2] - 1.0 - HEIGHT, rtol=1e-6)
    np.testing.assert_array_equal(hidden.exact_depth[right], open_view.exact_depth[right])
    assert (hidden.radiance[left][..., 0] > 3.0 * hidden.radiance[left][..., 1]).all()
    assert hidden.radiance[right].mean() < 0.9 * open_view.radiance[right].mean()  # in the shadow, and beside a red mirror image


def test_a_prop_that_follows_the_gripper_is_where_that_is(device):
    def seen(*visible: int):
        poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.5, 0.0, -0.9, *UPRIGHT), (0.0, 0.0, 9.0, *UPRIGHT))
        given = {"fixture_poses": poses, "fixtures_visible": visible, "props": (shield(follows=True),)}
        return render(half_hidden(table=True, **given), device)

    shown = seen(0, 1, 0)
    np.testing.assert_allclose(shown.exact_depth, CENTER[2] - 2 * HEIGHT, rtol=1e-6)
    assert (shown.instance == Segment.TABLE).all()
    assert_same(seen(0, 0, 0), render(half_hidden(table=True), device), "instance", "exact_depth", "color")


def test_episodes_draw_no_looks_of_props(device):
    looks = Looks(Randomize(object_brightness=Distribution.parse(0.5)), (), ())
    plain, drawn = (
        render(half_hidden(props=(shield(),), looks=each, config=with_render(UNOCCLUDED)), device).radiance for each in (None, looks)
    )
    np.testing.assert_allclose(drawn[..., 8, :40, :], plain[..., 8, :40, :], rtol=1e-6)
    assert drawn[0, 32, 52].mean() < 0.7 * plain[0, 32, 52].mean()


# ---- data sets ----

SLAB = 0.03
"""Thickness of the colliding plate on which objects rest [m]."""
ROWS = (
    PropRow("slab", "", Pose(position=(0.0, 0.0, SLAB / 2)), collide=True),
    PropRow("frame", "frame", Pose(position=(0.0, 0.0, 0.0))),
    PropRow("arm", "", Pose(position=(0.0, 0.1, 0.5), quaternion=(0.0, 0.0, 1.0, 0.0)), scale=0.2, follows=GRIPPER),
)


def bake(out: Path, slab: str, worlds: int) -> None:
    given = {"render.reuse": worlds == 1} | {
        "bake.formats": ["bop", "usd"],
        "bake.episodes": 2,
        "bake.worlds": worlds,
        "cameras.resolution": [48, 27],
    }
    config = settings(**{**PICKING, **given, "bins.kind": "none", "bins.area": [0.2, 0.2], "render.layers": ["classes"]})
    config = replace(config, prop=tuple(replace(row, mesh=row.mesh or slab) for row in ROWS))
    with boxes(lambda: replace(cluttered_catalog(), distractors=(), props=make_props(config.prop, config.cell.bins))):
        run_bake(config, out, SilentProgress())


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A data set, baked in one world, and the file of its slab."""
    place = tmp_path_factory.mktemp("props")
    slab = str(put(place / "slab.ply", box(0.8, 0.8, SLAB)))
    bake(place / "1", slab, 1)
    return place / "1", slab


def test_objects_lie_on_a_prop_that_collides(baked):
    scenes = sorted(baked[0].glob("train_pbr/*/scene_gt.json"))
    cameras = [json.loads(scene.with_name("scene_camera.json").read_text())["0"] for scene in scenes]
    found = [(entry, view) for scene, view in zip(scenes, cameras, strict=True) for entry in json.loads(scene.read_text())["0"]]
    assert {entry["obj_id"] for entry, _ in found} <= {1, 2}
    halves = np.array([0.08, 0.06, 0.04]) / 2, np.full(3, 0.05) / 2
    for entry, view in found:
        turn = np.reshape(view["cam_R_w2c"], (3, 3)).T
        place = turn @ (np.array(entry["cam_t_m2c"]) - view["cam_t_w2c"]) / 1e3
        rotation = turn @ np.reshape(entry["cam_R_m2c"], (3, 3))
        lowest = place[2] - np.abs(rotation[2]) @ halves[entry["obj_id"] - 1]
        assert abs(lowest - SLAB) < 1e-3 or lowest > SLAB  # on the slab, or on another object


def test_episodes_are_the_same_in_any_number_of_worlds(baked, tmp_path):
    bake(tmp_path / "2", baked[1], 2)
    check_same(baked[0], tmp_path / "2")


def test_usd_scenes_have_props(baked):
    stage = Usd.Stage.Open(str(baked[0] / "usd" / "000000.usdc"))
    cache = UsdGeom.BBoxCache(Usd.TimeCode(0), [UsdGeom.Tokens.default_])
    slab = stage.GetPrimAtPath("/Episode/Props/slab")
    bounds = cache.ComputeWorldBound(slab).ComputeAlignedRange()
    np.testing.assert_allclose([*bounds.GetMin(), *bounds.GetMax()], [-0.4, -0.4, 0.0, 0.4, 0.4, SLAB], atol=1e-6)
    assert [str(prim.GetName()) for prim in Usd.PrimRange(slab) if prim.HasAPI(UsdPhysics.CollisionAPI)] == ["piece_00"]
    frame = UsdGeom.Mesh(stage.GetPrimAtPath("/Episode/Props/frame/Visual"))
    assert len(frame.GetPointsAttr().Get()) > 100
    arm = UsdGeom.Xformable(stage.GetPrimAtPath("/Episode/Gripper/Finger/arm"))
    np.testing.assert_allclose(arm.GetLocalTransformation().ExtractTranslation(), [0.0, 0.1, 0.5])


def test_resumed_bakes_know_props_by_their_content(baked):
    objects = replace(cluttered_catalog(), props=(shield(),))
    assert "props" not in digest_inputs(cluttered_catalog(), ())
    moved = replace(objects, props=(shield(follows=True),))
    assert digest_inputs(objects, ())["props"] != digest_inputs(moved, ())["props"]


def test_memory_plans_count_props(device):
    plain = settings(arrangement__max_objects=3)
    some = replace(plain, prop=(PropRow("a", "conveyor", Pose(position=(0.0, 1.0, 0.0)), collide=True),))
    sizes = [{term.name: term.size for term in plan_memory(config, device)} for config in (plain, some)]
    assert all(sizes[1].get(name, 0) >= size for name, size in sizes[0].items())
    assert sum(sizes[1].values()) > sum(sizes[0].values())


# ---- settings ----


def write(folder: Path, text: str) -> Path:
    return put(folder / "cell.toml", f'preset = "smoke"\n{text}')


def row(name: str = "a", mesh: str = "frame", pose: str = "{ position = [0, 0, 0] }", more: str = "") -> str:
    return f'[[prop]]\nname = "{name}"\nmesh = "{mesh}"\npose = {pose}\n{more}\n'


def test_settings_are_read_and_written(tmp_path):
    put(tmp_path / "box.ply", box(1.0, 1.0, 1.0))
    text = row() + row("b", "box.ply", '{ position = [0, 0, 1], quaternion = [0, 0, 1, 0], axes = "opengl" }')
    config = load_config(write(tmp_path, text), {})
    assert [each.mesh for each in config.prop] == ["frame", str(tmp_path / "box.ply")]
    assert load_config(put(tmp_path / "again.toml", config_to_toml(config)), {}).prop == config.prop
    a, b = make_props(config.prop, config.cell.bins)
    assert a.pose == (0, 0, 0, *UPRIGHT)
    np.testing.assert_allclose(np.abs(b.pose), [0, 0, 1, 0, 1, 0, 0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (row() + row(), "prop[0].name"),
        (row("Big"), "prop[0].name"),
        (row(pose="{ look_at = [0, 0, 0] }"), "prop[0].pose"),
        (row(more="scale = 0.0"), "prop[0].scale is 0.0"),
        (row(more='follows = "gripper"\ncollide = true'), "prop[0].collide"),
        ('[[prop]]\nname = "a"\nmesh = "frame"\n', "prop[0] has no pose"),
        ("".join(row(f"p{index}") for index in range(249)), "arrangement.max_objects"),
    ],
)
def test_contradictions_are_refused(tmp_path, text, said):
    assert said in refusal(load_config, write(tmp_path, text), {})


def flat(folder: Path) -> str:
    return str(put(folder / "flat.ply", trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(file_type="ply")))


@pytest.mark.parametrize(
    ("mesh", "more", "said"),
    [
        ("conveyer", {}, "did you mean conveyor?"),
        ("missing.ply", {}, "missing.ply cannot be read"),
        ("broken.ply", {}, "broken.ply"),
        ("box.ply", {"scale": 1e-4}, "allowed: a longest side"),
        ("flat.ply", {"collide": True}, "what collides needs a volume"),
        ("box.ply", {"collide": True}, "fills 100% of the tote"),
    ],
)
def test_meshes_that_cannot_be_used_are_refused(tmp_path, mesh, more, said):
    flat(tmp_path)
    put(tmp_path / "broken.ply", "ply\n")
    put(tmp_path / "box.ply", box(1.0, 1.0, 1.0))
    table = PropRow("a", str(tmp_path / mesh), Pose(position=(0.0, 0.0, 0.0)), **more)
    message = refusal(make_props, (table,), settings().cell.bins)
    assert message.startswith("prop a")
    assert said in message


def test_a_bake_refuses_an_unknown_prop(tmp_path):
    said = mistake("bake", "--config", write(tmp_path, row(mesh="crane")), "--out", tmp_path / "out")
    assert "prop a" in said
    assert "conveyor, frame" in said


def test_embedded_props_may_collide():
    rows = tuple(PropRow(name, name, Pose(position=(0.0, 1.0, 0.0)), collide=True) for name in EMBEDDED)
    assert [len(prop.pieces) for prop in make_props(rows, settings().cell.bins)] == [21, 9]
