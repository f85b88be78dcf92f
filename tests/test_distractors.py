"""Distractors: objects in the pile that are rendered and occlude others, but have no labels and are no targets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import zarr

import synpick_warp
from synpick_warp.codes import Ending, Mode, Phase, Stream, Task
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.commit.writing import digest_inputs
from synpick_warp.scenes.build import count_distractor_slots
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.embedded.solids import solids
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim import arrange
from tests.builders import PICKING, bake_boxes, refusal
from tests.harness.exporter_contract import digests
from tests.twins import rng
from tests.worlds.kernel_worlds import arrangement_worlds
from tests.worlds.small_worlds import cluttered_catalog, settings

SEED = 7
GIVEN = PICKING | {
    "arrangement.max_objects": 5,
    "arrangement.volume": 3e-4,
    "bake.episodes": 2,
    "bake.formats": ["bop", "usd", "zarr"],
    "cameras.resolution": [96, 54],
    "randomize.distractors": {"choice": [1, 2]},
    "render.layers": ["classes", "nocs"],
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
    arrange.sample_episodes(made.scene, made.state, SEED)
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
    index, slot = made.state.catalog_index.numpy(), made.state.body_slot.numpy()
    for row, slots in zip(index, slot, strict=True):
        used = slots[row >= 0]
        assert len(set(used)) == len(used)
        assert ((used >= made.single_slots) == (row[row >= 0] % 2 == 1)).all()


def test_draws_are_those_of_the_episode_and_its_arrangement(device):
    many, few = drawn(device, {"uniform": [0, 3]}), drawn(device, {"uniform": [0, 3]}, worlds=3)
    few.begin(Phase.START, [399, 7, 200])
    arrange.sample_episodes(few.scene, few.state, SEED)
    np.testing.assert_array_equal(few.state.catalog_index.numpy(), many.state.catalog_index.numpy()[[399, 7, 200]])
    key = rng.stream_key(SEED, 7, 0, Stream.DISTRACTORS)
    assert (many.state.catalog_index.numpy()[7] >= 2).sum() == round(3 * float(rng.uniform(key, 6 * 7)))


def test_distractors_lie_anywhere_in_the_column(device):
    made = drawn(device, 1)
    arrange.drop_objects(made.scene, made.state, made.physics, SEED)
    index, slot = made.state.catalog_index.numpy(), made.state.body_slot.numpy()
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
    made.set(made.state.mode, Mode.PICK)
    made.set(made.attempts.task, Task.LOOK)
    made.scene.pick.failures = 1
    left = np.full((3, made.instances), -1)
    left[0, 3], left[1, :2] = 2, (1, 3)
    made.set(made.state.catalog_index, left)
    arrange.judge_episodes(made.scene, made.state, made.attempts, made.observation, made.physics)
    assert made.state.ending.numpy().tolist() == [Ending.EMPTIED, Ending.RUNNING, Ending.EMPTIED]


# ---- data sets ----


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A data set, baked in one world."""
    place = tmp_path_factory.mktemp("distractors") / "1"
    bake_boxes(place, GIVEN | {"bake.worlds": 1}, objects=cluttered_catalog)
    return place


def distractors_of(folder, episode: int) -> dict[int, str]:
    rows = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    return {one["instance"]: one["name"] for one in rows[episode]["looks"]["distractors"]}


@pytest.mark.slow  # `test_randomized_bakes` has distractors among all else.
def test_bytes_do_not_depend_on_worlds(baked, tmp_path):
    bake_boxes(tmp_path / "2", GIVEN | {"bake.worlds": 2}, objects=cluttered_catalog)
    one, two = ({name: value for name, value in digests(folder).items() if "config.toml" not in name} for folder in (baked, tmp_path / "2"))
    assert {name for name in one if one[name] != two[name]} <= {"manifest.json"}


def test_labels_have_no_distractors_but_are_occluded_by_them(baked):
    hidden, data = 0, synpick_warp.open(baked)
    for view in data.views():
        named = distractors_of(baked, view.episode)
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


def test_distractors_are_no_targets_and_no_objects_of_attempts(baked):
    rows = [json.loads(line) for line in (baked / "attempts.jsonl").read_text().splitlines()]
    assert rows
    for row in rows:
        named = distractors_of(baked, row["episode"]).keys()
        seen = {one["instance"] for one in row["observation"]["instances"]}
        votes = {instance for vote in row["observation"]["votes"] for instance in vote[:2]}
        graph = {instance for one in row["observation"]["instances"] for instance in one["above"] + one["ancestors"]}
        assert named.isdisjoint({row["target"]} | seen | votes | graph | set(row["engaged"]) | set(row["picked"]))
    for row in map(json.loads, (baked / "episodes.jsonl").read_text().splitlines()):
        assert row["objects"] == row["picked"] + row["lost"] + row["left"]


def test_stores_and_stages_have_the_distractors_poses(baked):
    from pxr import Usd, UsdSemantics

    store = zarr.open_group(baked / "trajectory.zarr", mode="r")
    names = store.attrs["distractors"]["names"]
    assert names == {"-2": "plate", "-3": "angle"}
    for episode in range(2):
        group = store[f"episodes/{episode:06d}"]
        ids, poses = group["ticks/object_id"][:], group["ticks/pose"][:]
        assert np.isfinite(poses[ids != -1]).all()
        assert np.isnan(poses[ids == -1]).all()
        named = distractors_of(baked, episode)
        assert {index: names[str(ids[0, index])] for index in np.flatnonzero(ids[0] < -1).tolist()} == named
        assert (group["arrangement/mass"][:] > 0.0).all()
        stage = Usd.Stage.Open(str(baked / f"usd/{episode:06d}.usdc"))
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


def make_folder(folder: Path, *sides: float) -> Path:
    """A folder of cubes as STL files."""
    folder.mkdir()
    for index, side in enumerate(sides):
        trimesh.creation.box((side, side, side)).export(folder / f"cube_{index}.stl")
    return folder


@pytest.mark.parametrize(
    ("own", "surfaces"),
    [(True, 0), (False, 0), (True, 1)],
)
def test_distractors_of_no_folder_are_solids(tmp_path, own, surfaces):
    """Household objects look like those of labelled classes, such as the banana of the YCB models."""
    models = str(make_folder(tmp_path / "own", 0.05)) if own else ""
    loaded = load_catalog(load_config("smoke", {"bake.models": models, "randomize.distractors": 2, "randomize.surfaces": surfaces}))
    assert [body.name for body in loaded.distractors] == [raw.name for raw in solids(surfaces > 0)]
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
    lines: list[str] = []
    loaded = load_catalog(load_config("smoke", given | {"objects.concave_ratio": 0.0}), tmp_path / "cache", lines.append)
    assert [body.name for body in loaded.distractors] == ["carton"]
    said = [line.removeprefix("left out: the distractor ") for line in lines if "labelled" in line and "left out" in line]
    pairs = [("drill", "drill"), ("fruit", "banana"), ("tool", "drill")]
    assert said == [f"{name}: it looks like {twin}, whose instances are labelled" for name, twin in pairs]


@pytest.mark.parametrize(("textured", "largest"), [(False, 0.2), (True, 0.32)])
def test_solids_are_closed_convex_and_as_large_as_other_parts(textured, largest):
    made = solids(textured)
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


@pytest.mark.parametrize(
    ("folder", "said"),
    [
        ("missing", "missing"),
        ("empty", "empty"),
        ("wide", "too large for the tote"),
    ],
)
def test_distractors_that_cannot_be_used_are_one_line(folder, said, tmp_path):
    make_folder(tmp_path / "empty")
    make_folder(tmp_path / "wide", 3.0)
    config = load_config("smoke", {"randomize.distractors": 1, "randomize.distractor_models": str(tmp_path / folder)})
    assert said in refusal(load_catalog, config)
