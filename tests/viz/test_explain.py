"""Attempts drawn from a data set's files: what is in the picture and where, the words, and what happens to damaged files."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.apps.viz import explain
from synpick_warp.apps.viz.drawing import FONT, instance_color, shorten
from synpick_warp.apps.viz.explain import load_chart, object_names, planning_camera, to_color_image, to_view, wrapped, write_explanation
from synpick_warp.apps.viz.explain_record import choice_words, labels, seal_words
from synpick_warp.cli.main import main
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config, Perception, Pick, Target
from synpick_warp.dataset.view import View
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.scenes.cameras import EpisodeCameras
from synpick_warp.scenes.types import Camera
from synpick_warp.testing.box_views import config
from synpick_warp.testing.exporters import export
from tests.builders import mistake, refusal
from tests.harness.charts import near, picture_of
from tests.worlds.cells import cell_config, make_camera
from tests.worlds.trajectories import attempt, nothing_seen, record, seen, seen_object

EPISODES = (0, 1)
TOP, LEFT = explain.MARGIN + explain.HEAD, explain.MARGIN
SCALE = explain.IMAGE_WIDTH / 96
NAMES = {1: "tin", 2: "box", 3: "mug"}


def bake(out: Path, **bop: object) -> Path:
    export(BopExporter, out, config(**bop), EPISODES, 0, 2)
    (out / "config.toml").write_text(config_to_toml(config(**bop)))
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return bake(tmp_path_factory.mktemp("explain") / "set", split="train", color_format="png")


@pytest.fixture
def dataset(made, tmp_path) -> Path:
    """Episode 1 with three attempts, from images 0 and 1."""
    folder = Path(shutil.copytree(made, tmp_path / "set"))
    boxes = [
        seen_object(2, 7, (50, 38)),
        seen_object(0, 3, (30, 20), above=[2], ancestors=[2]),
        seen_object(3, 3, (66, 36), above=[2], ancestors=[2]),
    ]
    observation = {"resolution": [96, 72], "instances": boxes, "votes": [[0, 2, 9.0], [3, 2, 12.0], [2, 3, 5.0]]}
    second = record(boxes[::-1], episode=1, attempt=1, frame=1, mode="target", picked=[], sentence="every seal broke during the lift")
    third = nothing_seen(episode=1, attempt=2, frame=1)
    return write(folder, third, record(boxes, episode=1, observation=observation), second, record(boxes, episode=4))


def write(folder: Path, *records: dict) -> Path:
    (folder / "attempts.jsonl").write_text("".join(json.dumps(line) + "\n" for line in records))
    return folder


def drawn(dataset: Path, number: int | None = 0) -> np.ndarray:
    return cv2.imread(str(write_explanation(dataset, dataset / "picture.png", 1, number)))


def colored(dataset: Path, frame: int = 0) -> np.ndarray:
    """The colour image as large as on the sheet."""
    color = cv2.imread(str(dataset / "train" / "000003" / "rgb" / f"{frame:06d}.png"))
    return cv2.resize(color, (explain.IMAGE_WIDTH, round(SCALE * 72)), interpolation=cv2.INTER_CUBIC)


def masked(dataset: Path, index: int, frame: int = 0) -> np.ndarray:
    mask = cv2.imread(str(dataset / "train" / "000003" / "mask_visib" / f"{frame:06d}_{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
    return cv2.resize(mask, (explain.IMAGE_WIDTH, round(SCALE * 72)), interpolation=cv2.INTER_LINEAR) > 127


def image_of(sheet: np.ndarray) -> np.ndarray:
    return sheet[TOP : TOP + round(SCALE * 72), LEFT : LEFT + explain.IMAGE_WIDTH]


def edge_share(image: np.ndarray, mask: np.ndarray, instance: int) -> float:
    """Share of a mask's border that has the instance's colour."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)
    border = mask & (inside == 0)
    return float((image[border] == instance_color(instance)).all(axis=1).mean())


@pytest.mark.parametrize(("number", "index", "instance"), [(0, 1, 2), (1, 2, 3)])
def test_the_target_is_bright_tinted_and_has_a_contour_where_its_mask_is(dataset, number, index, instance):
    """Attempt, which is at the frame of its number; index of the target's mask, and the target."""
    color, image = colored(dataset, number), image_of(drawn(dataset, number))
    target, other = masked(dataset, index, number), masked(dataset, 0, number)
    assert target.sum() > 500
    inside, beside = (cv2.erode(mask.astype(np.uint8), np.ones((15, 15))) > 0 for mask in (target, other))
    tinted = 0.72 * color[inside] + 0.28 * np.array(instance_color(instance))
    assert np.median(np.abs(image[inside] - tinted).max(axis=1)) <= 1
    assert np.median(np.abs(image[beside] - 0.62 * color[beside]).max(axis=1)) <= 1
    assert edge_share(image, target, instance) > 0.9
    assert edge_share(image, other, 0) > 0.8
    away = cv2.distanceTransform((~target).astype(np.uint8), cv2.DIST_L2, 5)
    around = (away > 3) & (away < 4)
    assert (image[around] > 230).all(axis=1).mean() > 0.8


def test_sets_of_several_sensors_look_the_same(dataset, tmp_path):
    other = bake(tmp_path / "sensors", split="train", color_format="png", layout="multisensor")
    shutil.copy(dataset / "attempts.jsonl", other)
    np.testing.assert_array_equal(drawn(dataset)[TOP:], drawn(other)[TOP:])


@pytest.mark.parametrize(("resolution", "factor"), [([96, 72], 1.0), ([192, 144], 2.0), ([48, 36], 0.5)])
def test_suction_points_are_drawn_where_they_are_at_any_sight_resolution(dataset, resolution, factor):
    near = (21.0, 52.0)  # Nothing else is drawn there.
    pixel = tuple(round((value + 0.5) * factor - 0.5) for value in near)
    place = tuple((value + 0.5) / factor - 0.5 for value in pixel)
    boxes = [seen_object(2, 7, pixel)]
    write(dataset, record(boxes, episode=1, observation={"resolution": resolution, "instances": boxes, "votes": []}))
    rows, columns = np.nonzero((image_of(drawn(dataset)) == instance_color(2)).all(axis=2))
    x, y = (SCALE * (value + 0.5) - 0.5 for value in place)
    disc = np.hypot(columns - x, rows - y) < 8
    assert disc.sum() > 20
    assert abs(columns[disc].mean() - x) < 0.5
    assert abs(rows[disc].mean() - y) < 0.5


def test_a_sight_of_another_shape_is_the_middle_of_the_colour_image():
    assert to_color_image((0.0, 0.0), (96, 36), (96, 72)) == (0.0, 18.0)


@pytest.mark.parametrize("distortion", [{}, {"distortion": [-0.12, 0.08, 0.0005, -0.0003]}])
def test_points_lie_where_the_drawn_camera_sees_them(distortion):
    """Points that perception sees with the camera of the table, in a view of the camera that an episode has drawn, through its lens."""
    jitter = {"position": {"uniform": [-0.02, 0.02]}, "rotation": {"uniform": [-2, 2]}, "center": {"uniform": [-3, 3]}}
    rig = cell_config((make_camera("a", fov=50.0, jitter=jitter, **distortion), make_camera("b", fov=50.0))).rig
    drawn, planned = EpisodeCameras(rig, 3).of_episode(1)[0], planning_camera(rig, 0)
    points = np.array([[x, y, 0.1] for x in (-0.2, 0.0, 0.15) for y in (-0.1, 0.1)])

    def slopes_of(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        there = points @ camera.rotation.T + camera.translation
        return there[:, :2] / there[:, 2:], there[:, 2]

    flat, _ = slopes_of(planned)
    slopes, depth = slopes_of(drawn)
    expected = np.column_stack((slopes, np.ones(len(points)))) @ drawn.matrix.T if drawn.lens is None else drawn.lens.project(slopes)
    view = View.__new__(View)
    pose = np.vstack((np.column_stack((drawn.rotation, drawn.translation)), (0.0, 0.0, 0.0, 1.0)))
    vars(view).update(lens=drawn.lens, intrinsics=drawn.matrix, world_to_camera=pose, rgb=np.zeros((72, 96, 3)))
    vars(view).update(depth=np.full((72, 96), depth.mean()), has=lambda name: True)
    places = (np.column_stack((flat, np.ones(len(points)))) @ planned.matrix.T)[:, :2] - 0.5
    found = np.array(to_view(view, planned, [tuple(place) for place in places.tolist()]))
    np.testing.assert_allclose(found, expected[:, :2] - 0.5, atol=0.1)  # Depth is even here.
    assert np.abs(places - (expected[:, :2] - 0.5)).max() > 1.0
    assert planning_camera(rig, 1) is None


def test_all_attempts_stand_below_each_other_in_order(dataset):
    rows = [drawn(dataset, number) for number in range(3)]
    np.testing.assert_array_equal(drawn(dataset, None), np.concatenate(rows))


def test_without_masks_there_are_points_but_no_contours_and_it_says_so(made, tmp_path):
    boxes = [seen_object(2, 7, (50, 38))]
    bare = write(bake(tmp_path / "bare", split="train", color_format="png", masks=False), record(boxes, episode=1))
    full = write(Path(shutil.copytree(made, tmp_path / "full")), record(boxes, episode=1))
    first, second = drawn(bare), drawn(full)
    assert edge_share(image_of(second), masked(full, 1), 2) > 0.9
    assert edge_share(image_of(first), masked(full, 1), 2) < 0.1
    captions = [sheet[TOP - 24 : TOP - 2, : LEFT + explain.IMAGE_WIDTH] < 200 for sheet in (first, second)]
    ends_at = [np.flatnonzero(caption.any(axis=(0, 2))).max() for caption in captions]
    assert ends_at[0] > ends_at[1] + 50


def test_a_target_that_is_not_in_the_ground_truth_of_the_image_is_drawn_without_contour(dataset):
    write(dataset, record([seen_object(1, 9, (40, 40))], episode=1))
    assert drawn(dataset).shape[1] == drawn(dataset, None).shape[1]


def test_names_come_from_the_models_or_from_the_object_table(dataset):
    assert object_names(dataset, {3, 7}) == {3: "box 3", 7: "box 7"}
    assert object_names(dataset, {5}) == {}
    from synpick_warp.configs.files.load import load_config

    (dataset / "models" / "models_info.json").write_text(json.dumps({"2": {"diameter": 269.6}, "4": {"diameter": 60.0}}))
    config = load_config("synpick", {})
    assert object_names(dataset, {2, 4}, config.object_rows, config.objects.diameter_tolerance) == {2: "003_cracker_box"}


def test_objects_that_come_twice_get_letters():
    assert labels(attempt((seen(0, object_id=4), seen(3, object_id=2), seen(5, object_id=4)), {})) == {0: "4a", 5: "4f", 3: "2"}


FIRST, SECOND, THIRD = seen(0, visible_fraction=0.4), seen(1, visible_fraction=0.6), seen(2, frozenset({0}), visible_fraction=0.3)


@pytest.mark.parametrize(
    ("objects", "target", "mode", "said"),
    [
        ((FIRST,), 0, "pick", "1 tin: 0 objects above; the only visible object"),
        ((FIRST, SECOND, THIRD), 1, "pick", "2 box: 0 objects above; visible area 0.60 of its box's largest face, the largest of 2 such"),
        ((FIRST, THIRD), 0, "pick", "1 tin: 0 objects above, the fewest of all"),
        ((FIRST, SECOND, THIRD), 2, "target", "3 mug: 1 object above, the most of all"),
        ((FIRST, SECOND), 0, "target", "1 tin: 0 objects above; visible area 0.40 of its box's largest face, the smallest of 2 such"),
        ((FIRST, SECOND, THIRD), 0, "pick", "1 tin: 0 objects above; the rule would name 2 box"),
        ((), None, "pick", "none, nothing is visible"),
    ],
)
def test_why_it_was_chosen(objects, target, mode, said):
    assert choice_words(attempt(objects, {}, target, mode=mode), NAMES, Config().target, Config().pick)[0] == f"target: {said}"


@pytest.mark.parametrize(
    ("mode", "settings", "said"),
    [
        ("target", Config(target=Target(random_after_failure=True)), "chosen at random after a failed attempt"),
        ("pick", Config(pick=Pick(retry="another")), "attempts have failed at 2 box"),
    ],
)
def test_a_choice_after_failures_is_named_where_the_settings_have_it(mode, settings, said):
    words = choice_words(attempt((FIRST, SECOND, THIRD), {}, 0, mode=mode), NAMES, settings.target, settings.pick)
    assert words[0] == f"target: 1 tin: 0 objects above; {said}"


@pytest.mark.parametrize(
    ("suction", "said"),
    [
        ((10.0, 10.0), "suction point: pole of inaccessibility; cup tilted by 90 degrees"),
        ((18.0, 10.0), "suction point: centroid, 0.50 of the pole's distance; cup tilted by 90 degrees"),
        ((14.0, 13.0), "suction point: drawn where the surface is flattest; cup tilted by 90 degrees"),
        ((14.0, 11.0), "suction point: half-way point, 0.85 of the pole's distance; cup tilted by 90 degrees"),
    ],
)
def test_where_the_suction_point_is(suction, said):
    one = attempt((seen(0, grasp_pixel=suction),), {}, 0, tilt=-np.pi / 2)
    assert choice_words(one, NAMES, Config().target, Config().pick)[1] == said


def test_what_the_seal_bore():
    good = attempt((FIRST, SECOND), {}, 0, engaged=(0, 1), picked=(1,), peak_force=(1.0, 6.25, 3.0))
    assert seal_words(good, NAMES, Config().suction) == [
        "rays: 10 of 10 hit; good seal, breaks at 40 N",
        "engaged: 1 tin, 2 box; largest force 6.2 N",
        "picked: 2 box",
    ]
    poor = attempt((FIRST,), {}, 0, hits=3, good_seal=False, engaged=(7,))
    said = ["rays: 3 of 10 hit; poor seal, breaks at 2 N", "engaged: instance 7, unseen", "picked: nothing"]
    assert seal_words(poor, NAMES, Config().suction) == said
    four = attempt((FIRST,), {}, 0, rays=40, hits=37, good_seal=False, sealed=[0, 1, 3], engaged=(7,))
    assert seal_words(four, NAMES, Config().suction)[0] == "rays: 37 of 40 hit; 3 of 4 cups with a good seal, break at 40 N"
    weak = attempt((FIRST,), {}, 0, rays=304, hits=290, good_seal=False, break_force=3.456)
    assert seal_words(weak, NAMES, Config().suction)[0] == "rays: 290 of 304 hit; poor seal, breaks at 3.46 N"
    assert seal_words(attempt((FIRST,), {}, 0, hits=0, peak_force=(0.0, 0.0)), NAMES, Config().suction) == ["rays: 0 of 10 hit"]
    assert seal_words(attempt((), {}), NAMES, Config().suction) == []


def test_a_load_of_half_the_limit_lies_half_way_below_it():
    plot = picture_of(
        load_chart(attempt((FIRST,), {}, 0, peak_force=(20.0,) * 9), Config().suction, Config().physics.tick_time, 400, 200), 1.0
    )
    limit, curve = (np.flatnonzero(near(plot, color, 30)[:, 300]) for color in ("#c83c3c", "#145aaa"))
    axis = np.flatnonzero(near(plot, "#1e1e1e", 30)[:, 300:303].all(axis=1))[:1]
    assert plot.shape == (200, 400, 3)
    assert abs(curve.mean() - (limit.mean() + axis.mean()) / 2) < 1


def test_a_lift_without_a_seal_says_so():
    nothing = load_chart(attempt((FIRST,), {}, 0, hits=0), Config().suction, Config().physics.tick_time, 400, 100)
    assert "nothing was engaged" in str(nothing)
    assert picture_of(nothing, 1.0).shape == (190, 400, 3)


def test_text_fits():
    text = "target: 5 mustard_bottle: 0 objects above; visible area 0.61 of its box's largest face, the largest of 3 such"
    lines = wrapped(text, 0.5, 200)
    assert " ".join(" ".join(lines).split()) == text
    assert all(cv2.getTextSize(line, FONT, 0.5, 1)[0][0] <= 200 for line in lines)
    assert shorten("tin", 200, 0.5) == "tin"
    assert shorten(text, 200, 0.5).endswith("...")
    assert cv2.getTextSize(shorten(text, 200, 0.5), FONT, 0.5, 1)[0][0] <= 200


def second(line: str | None = None, **changes: object) -> Callable[[Path], None]:
    """Harm: a second line of attempts.jsonl after a good one, by default a record with changes."""
    good = record([seen_object(2, 7, (50, 38))], episode=1)
    lines = [json.dumps(good | {"episode": 0}), json.dumps(good | changes) if line is None else line]
    return lambda folder: (folder / "attempts.jsonl").write_text("\n".join(lines) + "\n")


def observed(*seen: dict) -> dict[str, object]:
    return {"resolution": [96, 72], "instances": list(seen), "votes": []}


CIRCLE = observed(seen_object(2, 7, (5, 5), above=[3]), seen_object(3, 3, (9, 9), above=[2]))


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (second("{"), r"attempts\.jsonl, line 2, is damaged: input data was truncated; restore the file, "),
        (second('{"episode": 1, "attempt": "0"}'), r"line 2, is damaged: expected int, got str - at \$\.attempt"),
        (second(target=9), r"line 2, is damaged: target is 9, which was not visible"),
        (second(observation=CIRCLE), r"the clutter graph of attempt 0 of episode 1 has a cycle"),
        (second(frame=77), r"000003 has no image 77, as .*attempts\.jsonl names frame 77"),
        (lambda folder: shutil.rmtree(folder), r"there is no folder .*set; name the folder of a BOP data set"),
        (
            lambda folder: (folder / "attempts.jsonl").unlink(),
            r"has no attempts\.jsonl: it has no pick attempts; .*mode pick, target, mixed or cycle",
        ),
        (lambda folder: (folder / "attempts.jsonl").write_bytes(b"\xff"), r"attempts\.jsonl, line 1, is damaged: JSON is malformed"),
        (lambda folder: (folder / "attempts.jsonl").write_text(""), r"has no attempt of episode 1; episodes that have: none"),
        (lambda folder: (folder / "config.toml").unlink(), r"has no config\.toml"),
        (lambda folder: shutil.rmtree(folder / "train" / "000003"), r"has no images of episode 1"),
        (lambda folder: (folder / "train/000003/rgb/000000.png").unlink(), r"there is no .*rgb/000000\.png or \.jpg"),
        (lambda folder: (folder / "train/000003/mask_visib/000000_000001.png").unlink(), r"there is no .*000000_000001\.png"),
    ],
)
def test_what_is_damaged_or_missing_is_named_in_one_line(dataset, tmp_path, harm, said):
    harm(dataset)
    assert re.search(said, refusal(write_explanation, dataset, tmp_path / "picture.png", 1, 0))
    assert not (tmp_path / "picture.png").exists()


def test_settings_decide_which_votes_make_edges(dataset):
    before = drawn(dataset)
    (dataset / "config.toml").write_text(
        config_to_toml(replace(config(split="train", color_format="png"), perception=Perception(min_votes=5.5)))
    )
    assert (drawn(dataset) != before).any()


def test_the_command(dataset, tmp_path, capsys):
    assert main(["explain", str(dataset), "--episode", "1"]) == 0
    assert main(["explain", str(dataset), "--episode", "1", "--attempt", "2"]) == 0
    assert main(["explain", str(dataset), "--episode", "1", "--attempt", "0", "--out", str(tmp_path / "deep" / "a.jpg")]) == 0
    files = [tmp_path / "set-explain-000001.png", tmp_path / "set-explain-000001-002.png", tmp_path / "deep" / "a.jpg"]
    assert capsys.readouterr().out == "".join(f"explanation: {file}\n" for file in files)
    heights = [cv2.imread(str(file)).shape[0] for file in files]
    assert heights[0] > heights[1] + heights[2]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--episode", "2"], "attempts.jsonl has no attempt of episode 2; episodes that have: 1, 4"),
        (["--episode", "1", "--attempt", "3"], "attempts.jsonl has no attempt 3 of episode 1; attempts: 0 to 2"),
        (["--episode", "1", "--out", "a.txt"], "a.txt is not an image file; its name must end in .png, .jpg, .jpeg"),
        (["--attempt", "1"], "--attempt is 1, but no episode is named; add --episode"),
    ],
)
def test_a_mistake_at_the_command_line_is_one_line_and_exit_code_2(dataset, monkeypatch, arguments, said):
    monkeypatch.chdir(dataset)
    assert mistake("explain", ".", *arguments) == said
