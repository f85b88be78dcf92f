"""Distractors, which occlude others, but have no labels and are no targets; and all that can be randomized at once: the same bytes in any
number of worlds."""

import functools
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import zarr

import synpick_warp
from synpick_warp.codes import Ending, LookKind, Mode, Phase, Stream, Task
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.commit.writing import digest_inputs
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.build import count_distractor_slots
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.embedded.objects import procedural_objects, solids
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim import arrange
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING, boxes, refusal
from tests.twins import rng
from tests.worlds.cells import check_same, make_camera
from tests.worlds.kernel_worlds import arrangement_worlds
from tests.worlds.model_files import box, put
from tests.worlds.small_worlds import cluttered_catalog, settings

SEED = 7
ANY_COLOR = {"uniform": [[0, 0, 0], [1, 1, 1]]}
DRAWN: dict[str, Any] = {
    "object_hue": {"uniform": [-180, 180]},
    "object_brightness": {"log_uniform": [0.5, 2]},
    "object_roughness": {"normal": [0.5, 0.2]},
    "object_metallic": {"choice": [0, 0.9], "weights": [2, 1]},
    "object_transmission": {"choice": [0, 0.4, 0.9]},
    **{f"object_{wear}": {"uniform": [0, 0.8]} for wear in ("scratches", "rust", "stains", "dust")},
    **{f"bin_{wear}": {"uniform": [0, 0.8]} for wear in ("scratches", "stains", "dust")},
    "object_label": {"choice": [0, 0.03]},
    "bin_label": {"choice": [0.05, 0.1]},
    "bin_color": ANY_COLOR,
    "bin_roughness": {"uniform": [0.2, 0.9]},
    "bin_metallic": {"choice": [0, 1]},
    "table_color": ANY_COLOR,
    "table_roughness": {"uniform": [0.2, 0.9]},
    "texture_width": {"log_uniform": [0.05, 0.5]},
    "lamps": {"uniform": [0, 4]},
    "lamp_variants": 2,
    "lamp_elevation": {"uniform": [20, 80]},
    "lamp_radius": {"log_uniform": [1, 10]},
    "lamp_strength": {"uniform": [0.2, 0.8]},
    "lamp_temperature": {"choice": [2700, 6500]},
    "distractors": {"choice": [1, 2]},
    "surfaces": 3,
    "exposure": {"normal": [0, 1]},
}
CAMERAS = (
    make_camera(
        "jittered",
        (0.0, -0.6, 1.2),
        (0.0, 0.0, 0.1),
        resolution=[96, 54],
        fov=60.0,
        jitter={
            "position": {"normal": [0.0, 0.02]},
            "rotation": {"uniform": [-1.0, 1.0]},
            "focal_length": {"choice": [-0.02, 0.02]},
            "center": {"uniform": [-1.0, 1.0]},
        },
    ),
    make_camera("still", (0.0, 0.0, 1.4), (0.0, 0.0, 0.1), resolution=[32, 32], fov=50.0, distortion=[-0.1, 0.05, 0.0, 0.0, 0.0]),
)
FOLDERS = ("bin_textures", "table_textures", "background_textures", "distractor_models")
EVERYTHING = PICKING | {
    "arrangement.max_objects": 5,
    "arrangement.upright": 0.5,
    "bake.episodes": 2,
    "bake.formats": ["bop", "usd", "zarr"],
    "bins.shift": [0.05, 0.03],
    "bins.yaw": 20.0,
    "effects.exposure_jitter": 0.3,
    "render.layers": ["albedo", "classes", "nocs"],
    "render.table_size": [0.9, 0.6],
    **{f"randomize.{name}": value for name, value in DRAWN.items()},
}


# ---- draws ----


def drawn(device, count: object, worlds: int = 400, **more):
    """Worlds that have sampled two kinds of objects, of which the second is compound, and distractors of two kinds likewise."""
    made = arrangement_worlds(
        device,
        worlds,
        volume=np.array([0.1, 0.2, 9.0, 9.0]),
        compound=np.array([0, 1, 0, 1]),
        radius=np.full(4, 0.1),
        randomize=Randomize(distractors=Distribution.parse(count)),
        distractors=2,
        drop={"objects": 5},
        **more,
    )
    made.begin(Phase.START)
    made.run(arrange.sample_episodes, SEED)
    return made


def test_distractors_follow_the_objects_which_are_those_of_a_cell_without_any(device):
    plain, some = (drawn(device, count).state.catalog_index.numpy() for count in (0, {"choice": [0, 1, 3]}))
    objects, others = (some >= 0) & (some < 2), some >= 2
    np.testing.assert_array_equal(np.where(objects, some, -1), plain)
    counts = others.sum(axis=1)
    assert set(counts) == {0, 1, 3}
    assert all(abs((counts == count).sum() - 400 / 3) < 4 * np.sqrt(400 * 2 / 9) for count in (0, 1, 3))
    kinds = some[others]
    assert abs((kinds == 2).sum() - len(kinds) / 2) < 4 * np.sqrt(len(kinds) / 4)
    present = some >= 0
    assert (present[:, :-1] >= present[:, 1:]).all()
    assert (np.diff(objects.astype(int), axis=1) <= 0).all()


def test_each_body_has_a_slot_of_its_type_of_its_own(device):
    made = drawn(device, 3)
    index, slot = made["catalog_index"], made["body_slot"]
    for row, slots in zip(index, slot, strict=True):
        used = slots[row >= 0]
        assert len(set(used)) == len(used)
        assert ((used >= made.single_slots) == (row[row >= 0] % 2 == 1)).all()


def test_draws_are_those_of_the_episode_and_its_arrangement(device):
    many, few = drawn(device, {"uniform": [0, 3]}), drawn(device, {"uniform": [0, 3]}, worlds=3)
    few.begin(Phase.START, [399, 7, 200])
    few.run(arrange.sample_episodes, SEED)
    np.testing.assert_array_equal(few["catalog_index"], many.state.catalog_index.numpy()[[399, 7, 200]])
    key = rng.stream_key(SEED, 7, 0, Stream.DISTRACTORS)
    assert (many.state.catalog_index.numpy()[7] >= 2).sum() == round(3 * float(rng.uniform(key, 6 * 7)))


def test_distractors_lie_anywhere_in_the_column(device):
    made = drawn(device, 1)
    made.run(arrange.drop_objects, SEED)
    index, slot = made["catalog_index"], made["body_slot"]
    heights = made.coordinates()[..., 2]
    ranks = []
    for world in range(400):
        z = heights[world, slot[world, index[world] >= 0]]
        assert np.diff(np.sort(z)).min() >= 0.2
        ranks.append((z < z[-1]).sum() / max(1, len(z) - 1))
    assert np.histogram(ranks, 3, (0.0, 1.0))[0].min() > 70


def test_slots_suffice_but_for_the_accepted_share():
    arrangement = settings(arrangement__slot_shortfall=0.01).arrangement
    assert count_distractor_slots(0, cluttered_catalog(), arrangement) == (0, 0)
    assert count_distractor_slots(4, replace(cluttered_catalog(), distractors=()), arrangement) == (0, 0)
    assert count_distractor_slots(10, cluttered_catalog(), arrangement) == (9, 9)  # More than 9 of 10 in a share of 2^-10.


def test_a_bin_is_emptied_when_distractors_alone_are_left(device):
    made = drawn(device, 2, worlds=3)
    made.begin(Phase.ACT)
    made.put(mode=Mode.PICK, task=Task.LOOK)
    made.scene.pick.failures = 1
    left = np.full((3, made.instances), -1)
    left[0, 3], left[1, :2] = 2, (1, 3)
    made.put(catalog_index=left)
    made.run(arrange.judge_episodes)
    assert made["ending"].tolist() == [Ending.EMPTIED, Ending.RUNNING, Ending.EMPTIED]


# ---- data sets ----


def bake(place: Path, worlds: int) -> Path:
    """Bake boxes; returns the folder."""
    textures = place.parent / "textures"
    textures.mkdir(exist_ok=True)
    for index, color in enumerate(((30, 60, 200), (200, 180, 20))):
        image = np.full((8, 8, 3), color, np.uint8)
        image[:4] //= 2
        cv2.imwrite(str(textures / f"{index}.png"), image)
    folders = {f"randomize.{name}": str(textures) for name in FOLDERS}
    with boxes(cluttered_catalog):
        run_bake(replace(settings(**(EVERYTHING | folders | {"bake.worlds": worlds})), camera=CAMERAS), place, SilentProgress())
    return place


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    """A data set, baked in one world."""
    return bake(tmp_path_factory.mktemp("randomized") / "1", 1)


def lines(folder: Path, name: str) -> list[dict]:
    return [json.loads(line) for line in (folder / f"{name}.jsonl").read_text().splitlines()]


def distractors_of(folder: Path, episode: int) -> dict[int, str]:
    rows = lines(folder, "episodes")
    return {one["instance"]: one["name"] for one in rows[episode]["looks"]["distractors"]}


def test_labels_have_no_distractors_but_are_occluded_by_them(single):
    hidden, data = 0, synpick_warp.open(single)
    for view in data.views():
        named = distractors_of(single, view.episode)
        assert named.keys().isdisjoint(view.instance_ids.tolist())
        assert set(view.object_ids.tolist()) <= {1, 2}
        classes, nocs = view.layer("classes"), view.layer("nocs")
        union = np.zeros(classes.shape, int)
        for mask, obj_id in zip(view.masks, view.object_ids, strict=True):
            union += np.where(mask, obj_id, 0)
        np.testing.assert_array_equal(classes, union)
        np.testing.assert_array_equal(nocs.any(axis=2), union > 0)
        for mask, whole, share, info in zip(view.masks, view.amodal_masks, view.visibility, view.records.gt_info, strict=True):
            assert share == pytest.approx(mask.sum() / max(1, info["px_count_all"]), abs=1e-6)
            hidden += (whole & (union == 0)).sum()
    assert hidden > 50


def test_distractors_are_no_targets_and_no_objects_of_attempts(single):
    assert lines(single, "attempts")
    for row in lines(single, "attempts"):
        named = distractors_of(single, row["episode"]).keys()
        seen = {one["instance"] for one in row["observation"]["instances"]}
        votes = {instance for vote in row["observation"]["votes"] for instance in vote[:2]}
        graph = {instance for one in row["observation"]["instances"] for instance in one["above"] + one["ancestors"]}
        assert named.isdisjoint({row["target"]} | seen | votes | graph | set(row["engaged"]) | set(row["picked"]))
    for row in lines(single, "episodes"):
        assert row["objects"] == row["picked"] + row["lost"] + row["left"]


def test_stores_and_stages_have_the_distractors_poses(single):
    from pxr import Usd, UsdSemantics

    store = zarr.open_group(single / "trajectory.zarr", mode="r")
    names = store.attrs["distractors"]["names"]
    assert names == {"-2": "plate", "-3": "angle"}
    for episode in range(2):
        group = store[f"episodes/{episode:06d}"]
        ids, poses = group["ticks/object_id"][:], group["ticks/pose"][:]
        assert np.isfinite(poses[ids != -1]).all()
        assert np.isnan(poses[ids == -1]).all()
        named = distractors_of(single, episode)
        assert {index: names[str(ids[0, index])] for index in np.flatnonzero(ids[0] < -1).tolist()} == named
        assert (group["arrangement/mass"][:] > 0.0).all()
        stage = Usd.Stage.Open(str(single / f"usd/{episode:06d}.usdc"))
        for index, name in named.items():
            prim = stage.GetPrimAtPath(f"/Episode/Objects/distractor_{index:02d}")
            assert prim.GetDisplayName() == name
            assert not UsdSemantics.LabelsAPI.GetDirectTaxonomies(prim)
            np.testing.assert_allclose(prim.GetAttribute("xformOp:translate").Get(0), poses[0, index, :3], atol=1e-6)
        assert len(stage.GetPrimAtPath("/Episode/Objects").GetChildren()) == (ids != -1).any(axis=0).sum()


def test_inputs_without_distractors_have_the_digest_that_they_had():
    with_some = digest_inputs(cluttered_catalog(), ())
    assert with_some.pop("distractors")
    assert digest_inputs(Catalog(cluttered_catalog().entries), ()).items() <= with_some.items()


# ---- settings ----


made_solids = functools.cache(solids)


@pytest.mark.parametrize(("own", "surfaces"), [(False, 0), (True, 1)])
def test_distractors_of_no_folder_are_solids(tmp_path, own, surfaces):
    """Household objects look like those of labelled classes, such as the banana of the YCB models."""
    models = str(put(tmp_path / "own" / "cube.stl", box(0.05, 0.05, 0.05, kind="stl")).parent) if own else ""
    loaded = load_catalog(load_config("smoke", {"bake.models": models, "randomize.distractors": 2, "randomize.surfaces": surfaces}))
    assert [body.name for body in loaded.distractors] == [raw.name for raw in made_solids(surfaces > 0)]
    assert loaded.object_ids.tolist()[len(loaded) :] == [-2 - index for index in range(len(loaded.distractors))]


def test_distractors_that_look_like_a_labelled_object_are_left_out(tmp_path):
    """By shape whatever their names, sizes and poses, or by name; a carton of other proportions is none of them."""
    labelled = {
        raw.name: trimesh.Trimesh(raw.mesh.vertices, raw.mesh.faces) for raw in procedural_objects() if raw.name in ("banana", "drill")
    }
    turn = trimesh.transformations.rotation_matrix(1.0, (1.0, 2.0, 3.0))
    others = {"fruit": labelled["banana"].copy().apply_scale(0.7).apply_transform(turn), "tool": labelled["drill"].subdivide()}
    others |= {"drill": trimesh.creation.box((0.1, 0.1, 0.1)), "carton": trimesh.creation.box((0.06, 0.1, 0.02))}
    for folder, meshes in (("labelled", labelled), ("others", others)):
        (tmp_path / folder).mkdir()
        for name, mesh in meshes.items():
            mesh.export(tmp_path / folder / f"{name}.stl")
    given = {"randomize.distractors": 1, "bake.models": str(tmp_path / "labelled"), "randomize.distractor_models": str(tmp_path / "others")}
    told: list[str] = []
    loaded = load_catalog(load_config("smoke", given | {"objects.concavity": 1.0, "objects.pieces": 1}), tmp_path / "cache", told.append)
    assert [body.name for body in loaded.distractors] == ["carton"]
    said = [line.removeprefix("left out: the distractor ") for line in told if "labelled" in line and "left out" in line]
    pairs = [("drill", "drill"), ("fruit", "banana"), ("tool", "drill")]
    assert said == [f"{name}: it looks like {twin}, whose instances are labelled" for name, twin in pairs]


@pytest.mark.parametrize(("textured", "largest"), [(False, 0.2), (True, 0.32)])
def test_solids_are_closed_convex_and_as_large_as_other_parts(textured, largest):
    made = made_solids(textured)
    assert len({body.name for body in made}) == len(made)
    for body in made:
        assert (body.material.texture is not None) == textured
        assert np.ptp(body.mesh.uv) >= 0.1 * textured
        mesh = trimesh.Trimesh(body.mesh.vertices, body.mesh.faces)
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(body.hull.volume, rel=1e-3)
        assert 0.04 < body.hull.diameter < largest


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"randomize.distractors": 24}, "at least 0, at most 16"),
        ({"randomize.distractors": {"uniform": [0, 17]}}, "at most 16"),
        ({"randomize.distractors": 4, "arrangement.max_objects": 4}, "less than arrangement.max_objects, 4"),
        ({"randomize.distractors": {"normal": [1, 1]}, "arrangement.max_objects": 5}, "less than arrangement.max_objects, 5"),
        ({"randomize.distractors": 1, "bake.models": "some", "randomize.distractor_models": "some/"}, "another folder than bake.models"),
    ],
)
def test_distractors_without_room_are_one_line(given, said):
    assert said in refusal(load_config, "smoke", given)


@pytest.mark.parametrize(("folder", "said"), [("missing", "missing"), ("empty", "empty"), ("wide", "too large for the tote")])
def test_distractors_that_cannot_be_used_are_one_line(folder, said, tmp_path):
    (tmp_path / "empty").mkdir()
    put(tmp_path / "wide" / "cube.stl", box(3.0, 3.0, 3.0, kind="stl"))
    config = load_config("smoke", {"randomize.distractors": 1, "randomize.distractor_models": str(tmp_path / folder)})
    assert said in refusal(load_catalog, config)


# ---- everything at once ----


def test_all_settings_and_kinds_of_distributions_are_on():
    assert {item.name for item in fields(Randomize)} == {*DRAWN, *FOLDERS}
    kinds = {value.kind for value in vars(settings(**EVERYTHING).randomize).values() if isinstance(value, Distribution)}
    assert kinds == {kind.name.lower() for kind in LookKind} - {"off", "fixed"}


def test_bytes_do_not_depend_on_worlds(single):
    check_same(single, bake(single.with_name("two"), 2))


def test_episodes_look_different(single):
    first, second = (cv2.imread(str(path)).astype(int) for path in sorted(single.glob("train/*/rgb/000000.png"))[::2])
    assert np.abs(first - second).mean() > 10
