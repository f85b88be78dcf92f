"""Contact sheets: what is on them, and what happens without a data set."""

import itertools
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.apps.viz.drawing import bin_scale, color_depth, instance_color, pooled_scale, short_labels
from synpick_warp.apps.viz.preview import (
    COLUMN,
    LINE,
    MAX_VIEWS,
    Box,
    draw_legend,
    find_scenes,
    legend_width,
    place_labels,
    read_baked,
    sample,
    write_contact_sheet,
)
from synpick_warp.cli.main import main
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop.scene import write_layer
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.view import write_rendered_layer
from synpick_warp.testing.box_views import cameras, config
from synpick_warp.testing.exporters import export
from tests.builders import mistake
from tests.harness.scripted_bake import bake, settings

FRAMES = 5
LEGEND = COLUMN + 4
"""Width of the legend and the gap beside it [px]."""
EPISODES = (0, 1)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("preview") / "set"
    return export(BopExporter, out, config(), EPISODES, 0, FRAMES)


@pytest.fixture
def dataset(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


def test_a_row_a_view_four_pictures_and_a_legend_a_row(dataset, tmp_path):
    out = write_contact_sheet(dataset, tmp_path / "new" / "sheet.png", 4)
    sheet = cv2.imread(str(out))
    assert sheet.shape == (4 * (20 + 360 + 4), 4 * (480 + 4) + LEGEND, 3)
    first = sheet[20:380, :480]
    scene, frame = sample(find_scenes(dataset), 4)[0]
    color = cv2.imread(str(scene.folder / f"rgb{scene.sensor}" / f"{frame:06d}.jpg"))
    np.testing.assert_array_equal(first[2::5, 2::5], color)


def test_layers_get_columns_of_their_own(dataset, tmp_path):
    shape = (cameras()[0].height, cameras()[0].width)
    flow = np.full((*shape, 2), np.nan, np.float32)
    flow[:, 10:20] = 4.0, 0.0
    flow[:, 20:40] = 0.0, 0.0
    values = {
        "normals": np.broadcast_to(np.array([0, 0, -1], np.float32), (*shape, 3)),
        "albedo": np.broadcast_to(np.array([200, 100, 50], np.uint8), (*shape, 3)),
        "nocs": np.broadcast_to(np.array([1.0, 0.0, 0.2], np.float32), (*shape, 3)),
        "classes": np.zeros(shape, np.uint16),
        "flow": flow,
        "scene_flow": np.full((*shape, 3), np.nan, np.float32),
    }
    for scene in (each.folder for each in find_scenes(dataset)):
        for name, layer in values.items():
            (scene / name).mkdir()
            for frame in range(FRAMES):
                write_rendered_layer(layer, write_layer, scene, 0, name, frame)
    sheet = cv2.imread(str(write_contact_sheet(dataset, tmp_path / "sheet.png", 1)))
    assert sheet.shape[1] == 10 * (480 + 4) + LEGEND
    panels = {name: sheet[20:380, LEGEND + 484 * (4 + i) : LEGEND + 484 * (4 + i) + 480] for i, name in enumerate(values)}
    expected = {"normals": (255, 128, 128), "albedo": (50, 100, 200), "nocs": (51, 0, 255), "classes": (0, 0, 0)}
    for name, color in (expected | {"scene_flow": (64, 64, 64)}).items():
        assert (panels[name] == color).all(), name
    # Flow to the right is red, none is black, unknown is grey.
    scale = 480 // shape[1]
    assert [panels["flow"][100, scale * column].tolist() for column in (5, 15, 30)] == [[64, 64, 64], [0, 0, 255], [0, 0, 0]]
    (find_scenes(dataset)[0].folder / "flow" / "000002.png").unlink()
    with pytest.raises(DatasetError, match=r"there is no .*flow/000002.png"):
        write_contact_sheet(dataset, tmp_path / "sheet.png", 100)


def test_support_is_drawn_from_the_load_to_what_bears_it(dataset, tmp_path):
    """An arrow in the colour of the first instance, between the middles of both boxes."""
    for scene in (each.folder for each in find_scenes(dataset)):
        graph = {"occlusion": [], "support": [[0, 1, 9.0], [1, -1, 3.0]], "order": [[0], [1]]}
        (scene / "scene_graph.json").write_text(json.dumps({str(frame): graph for frame in range(FRAMES)}))
    sheet = cv2.imread(str(write_contact_sheet(dataset, tmp_path / "sheet.png", 1)))
    assert sheet.shape[1] == 5 * (480 + 4) + LEGEND
    scene, frame = sample(find_scenes(dataset), 1)[0]
    infos = json.loads((scene.folder / "scene_gt_info.json").read_text())[str(frame)][:2]
    (x, y), (u, v) = ((box[0] + box[2] / 2, box[1] + box[3] / 2) for box in (info["bbox_visib"] for info in infos))
    panel, scale = sheet[20:380, -484:-4], 5.0
    middle = panel[round(scale * (y + v) / 2), round(scale * (x + u) / 2)]
    record = json.loads((scene.folder / "scene_gt.json").read_text())[str(frame)][0]
    np.testing.assert_allclose(middle, instance_color(record["instance_id"]), atol=40)


def test_views_are_spread_over_cameras_scenes_and_time(dataset):
    views = sample(find_scenes(dataset), 6)
    assert [int(scene.folder.name) for scene, _ in views] == [0, 1, 2, 3, 4, 5]
    assert len({frame for _, frame in views}) >= 4
    assert {int(scene.folder.name) % 3 for scene, _ in sample(find_scenes(dataset), 3)} == {0, 1, 2}
    most = sample(find_scenes(dataset), 200)
    assert len(most) == len(set(most)) <= len(EPISODES) * 3 * FRAMES


def test_instances_and_boxes_are_drawn_where_they_are(dataset, tmp_path):
    sheet = cv2.imread(str(write_contact_sheet(dataset, tmp_path / "sheet.png", 1)))
    scene, frame = sample(find_scenes(dataset), 1)[0]
    index = 1
    mask = cv2.imread(str(scene.folder / f"mask_visib{scene.sensor}" / f"{frame:06d}_{index:06d}.png"), cv2.IMREAD_GRAYSCALE) > 0
    instances = sheet[20:380, 2 * 484 : 2 * 484 + 480][2::5, 2::5]
    assert len(np.unique(instances[mask], axis=0)) == 1
    color = instances[mask][0]
    boxes = sheet[20:380, 3 * 484 : 3 * 484 + 480]
    rows, columns = np.nonzero((boxes == color).all(axis=2))
    x, y, width, height = json.loads((scene.folder / "scene_gt_info.json").read_text())[str(frame)][index]["bbox_obj"]
    assert abs(columns.min() - 5 * x) <= 2
    assert abs(rows.min() - 5 * y) <= 2
    assert abs(columns.max() - 5 * (x + width + 1)) <= 2
    assert abs(rows.max() - 5 * (y + height + 1)) <= 2


@pytest.mark.parametrize("count", [1, 4, 32])
def test_labels_overlap_neither_each_other_nor_the_border(count):
    """The boxes of a full tote, some of them equal, as those of objects that lie on each other are."""
    draw = np.random.default_rng(count)
    boxes = [Box(*draw.uniform(-20, (400, 200)), *draw.uniform(5, 120, 2)) for _ in range(count)]
    boxes[1::4] = boxes[0::4][: len(boxes[1::4])]
    labels = place_labels(boxes, [(34, 15)] * count, (480, 270))
    assert None not in labels
    assert not any(first.meets(second) for first, second in itertools.combinations(labels, 2))
    assert all(0 <= each.x <= 480 - 34 and 0 <= each.y <= 270 - 15 for each in labels)


def test_labels_that_find_no_room_are_left_out():
    assert place_labels([Box(0, 0, 9, 9)] * 3, [(34, 15)] * 3, (40, 34)).count(None) == 1
    assert place_labels([Box(0, 0, 9, 9)], [(34, 15)], (20, 32)) == [None]


def test_instances_of_an_object_have_letters():
    assert short_labels([(5, 9), (2, 4), (0, 9)]) == {5: "9f", 2: "4", 0: "9a"}
    assert short_labels([(5, 9), (7, 9)])[5] == "9f", "as before instance 0 was picked"
    assert short_labels([(index, 1) for index in range(28)])[27] == "1ab"


def test_the_legend_has_every_object_in_its_colour_or_counts_the_rest():
    truth = [({"obj_id": 7, "instance_id": index}, {"visib_fract": 0.5, "px_count_visib": 9 * (index != 2)}) for index in range(12)]
    width = legend_width(360, len(truth))
    assert width == COLUMN
    panel = draw_legend((width, 360), ["mode pick"], truth, {7: "mug"})
    grounds = [tuple(round(0.85 * value) for value in instance_color(index)) for index in range(12)]
    assert all((panel == ground).all(axis=2).sum() > 100 for ground in grounds)
    short = draw_legend((legend_width(120, 40), 120), [], truth * 4, {})
    assert short.shape == (120, 2 * COLUMN, 3)
    assert short[-LINE:, COLUMN:].any()


def test_depth_has_one_scale_the_totes(dataset, tmp_path):
    """The depth range is one for all views: from the rim's corner nearest to a camera to the floor's farthest corner."""
    (dataset / "config.toml").write_text(config_to_toml(config()))
    views = sample(find_scenes(dataset), 6)
    records = [scene.files().camera(frame) for scene, frame in views]
    near, far = bin_scale(read_baked(dataset, set()).config.cell.bins, records)
    tote = config().tote
    heights = {"near": tote.outer_size[2] - tote.wall, "far": 0.0}
    sizes = {"near": tote.rim_size, "far": tote.floor_size}
    depths = {name: [] for name in heights}
    for record in records:
        rotation, offset = np.array(record["cam_R_w2c"]).reshape(3, 3), np.array(record["cam_t_w2c"])
        for name, corners in depths.items():
            for x, y in itertools.product((-0.5, 0.5), repeat=2):
                point = 1000 * np.array([x * sizes[name][0], y * sizes[name][1], heights[name]])
                corners.append((rotation @ point + offset)[2])
    assert (near, far) == pytest.approx((min(depths["near"] + depths["far"]), max(depths["near"] + depths["far"])))
    sheet = cv2.imread(str(write_contact_sheet(dataset, tmp_path / "sheet.png", 6)))
    for row, (scene, frame) in enumerate(views):
        depth = (
            cv2.imread(str(scene.folder / f"depth{scene.sensor}" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED) * records[row]["depth_scale"]
        )
        expected = color_depth(depth, (near, far))
        np.testing.assert_array_equal(sheet[384 * row + 20 : 384 * row + 380, 484 : 484 + 480][2::5, 2::5], expected)


def test_without_a_tote_the_scale_is_that_of_all_views_together():
    depths = [np.full((70, 70), 500.0), np.full((70, 70), 900.0), np.zeros((70, 70))]
    assert pooled_scale(depths) == (500.0, 900.0)
    assert pooled_scale(depths[2:]) is None
    assert (color_depth(depths[2]) == 0).all()


def test_mode_time_and_light_of_a_view_are_told(dataset, tmp_path):
    bake(tmp_path / "baked", settings(2, ("bop",)))
    scene = find_scenes(tmp_path / "baked")[3]
    told = read_baked(tmp_path / "baked", set()).facts(scene, 1, {"light": {"map": "studio"}})
    assert told == ["train_pbr/000003, image 1", "episode 1, 0.01 s, mode pick", "light studio"]
    assert read_baked(dataset, set()).facts(find_scenes(dataset)[3], 1, {"light": 3}) == told[:1]


def test_unfinished_scenes_of_a_running_bake_are_not_drawn(tmp_path):
    bake(tmp_path / "set", settings(1, ("bop",)))
    scenes = find_scenes(tmp_path / "set")
    for name in ("000000", "000007"):
        shutil.copytree(scenes[0].folder, tmp_path / "set" / ".partial" / name)
    assert find_scenes(tmp_path / "set") == scenes


def test_sets_of_several_sensors_are_drawn_as_the_classic_layout(tmp_path):
    sheets = []
    for layout in ("classic", "multisensor"):
        folder = export(BopExporter, tmp_path / layout, config(("flow",), layout=layout), EPISODES, 0, FRAMES)
        sheets.append(cv2.imread(str(write_contact_sheet(folder, tmp_path / f"{layout}.png", 6))))
    first, second = (np.delete(sheet.reshape(6, 384, -1), np.s_[:20], axis=1) for sheet in sheets)
    np.testing.assert_array_equal(first, second)
    assert {scene.sensor for scene in find_scenes(tmp_path / "multisensor")} == {"_cam0", "_cam1", "_cam2"}


def test_a_set_without_masks_and_with_png_colour(tmp_path):
    export(BopExporter, tmp_path / "set", config(masks=False, color_format="png"), (0,), 0, 1)
    assert write_contact_sheet(tmp_path / "set", tmp_path / "sheet.jpg", 2).is_file()


def shrunk(name: str, dtype: type) -> Callable[[Path], None]:
    """Harm of a scene: images of 5 x 3 px."""
    data = cv2.imencode(".png", np.zeros((3, 5), dtype))[1].tobytes()
    return lambda scene: [path.write_bytes(data) for path in (scene / name).iterdir()]


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda scene: (scene / "scene_gt.json").unlink(), r"there is no file .*scene_gt\.json"),
        (lambda scene: (scene / "scene_gt.json").write_text(json.dumps({"0": []})), "do not agree about image"),
        (lambda scene: [shutil.rmtree(scene / name) for name in ("rgb", "depth")], r"there is no .*rgb/.*\.png or \.jpg"),
        (shrunk("depth", np.uint16), r"depth/.*\.png has 5 x 3 pixels; the images of this camera have"),
        (lambda scene: shutil.rmtree(scene), "has no complete scene"),
        (lambda scene: shutil.rmtree(scene.parent.parent, ignore_errors=True), "there is no folder"),
    ],
)
def test_a_damaged_data_set_is_one_clear_line(dataset, tmp_path, monkeypatch, harm, said):
    for scene in list((dataset / "train_pbr").iterdir()):
        harm(scene)
    monkeypatch.chdir(dataset.parent)
    assert re.search(said, mistake("preview", dataset.name, "--out", tmp_path / "sheet.png", "--views", 3))
    assert not (tmp_path / "sheet.png").exists()


def test_what_can_not_be_written_is_one_clear_line(dataset, tmp_path):
    with pytest.raises(OutputError, match="must end in"):
        write_contact_sheet(dataset, tmp_path / "sheet.bmp", 1)
    with pytest.raises(OutputError, match="at least 1"):
        write_contact_sheet(dataset, tmp_path / "sheet.png", 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_contact_sheet(dataset, tmp_path / "file" / "sheet.png", 1)


def test_a_sheet_has_at_most_the_views_of_the_set_and_at_most_max_views(dataset, tmp_path):
    arguments = ["preview", str(dataset), "--out", str(tmp_path / "sheet.png"), "--views", "1000000000"]
    assert main(arguments) == 0
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[0] == len(EPISODES) * 3 * FRAMES * (20 + 360 + 4)
    (tmp_path / "sheet.png").unlink()
    path = dataset / "train_pbr" / "000000" / "scene_camera.json"
    entry = json.loads(path.read_text())["0"]
    path.write_text(json.dumps({str(frame): entry for frame in range(MAX_VIEWS)}))
    line = mistake(*arguments)
    assert f"1000000000 views requested, and the data set has {MAX_VIEWS + 25}; a contact sheet has at most {MAX_VIEWS}" in line
    assert not (tmp_path / "sheet.png").exists()


def test_a_link_in_place_of_the_sheet_is_replaced_and_not_followed(dataset, tmp_path):
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "set-contact-sheet.png").symlink_to(tmp_path / "victim")
    assert main(["preview", str(dataset), "--views", "1"]) == 0
    assert (tmp_path / "victim").read_text() == "mine"
    assert not (tmp_path / "set-contact-sheet.png").is_symlink()
