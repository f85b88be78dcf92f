"""Contact sheet of a BOP data set, from its files: colour, depth colour map, instance masks, bounding boxes and layers of sampled views."""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.viz import drawing
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.bop.foreign import ForeignScenes
from synpick_warp.dataset.bop.layout import NoLayoutError, object_names
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, episode_entry, read_entry
from synpick_warp.dataset.view_files import SceneFiles
from synpick_warp.errors import DatasetError, OutputError, SynpickError

_PANEL_WIDTH = 480
"""Width of one image on the sheet [px]."""
_MAX_PANEL_HEIGHT = 1920
"""Maximum height of one image on the sheet [px]: tall images become narrower."""
MAX_VIEWS = 200
"""Maximum number of views on a sheet, some 76,000 pixels high."""
_CAPTION = 20
"""Height of the caption above an image [px]."""
_GAP = 4
"""Gap between images [px]."""
_WIDEST_ARROW = 4
"""Force at which the width of an arrow in the support graph saturates [N]."""
_MIN_LEGEND = 120
"""Minimum height of a row without its caption [px], for the legend of low images."""


@dataclass(frozen=True, order=True)
class SheetScene:
    """A scene as one camera sees it: a folder, with several sensors the files of one of them, or members of shards."""

    folder: Path
    """Of members: SPLIT/SCENE, which does not exist."""
    sensor: str = ""
    """Suffix of the sensor's folders and files, such as "_cam1"; empty: classic layout."""
    files: Callable[[], SceneFiles] = field(compare=False, repr=False, kw_only=True)
    """Opens it; what others leave out may be missing."""


@dataclass(frozen=True)
class _View:
    """View to draw."""

    scene: SheetScene
    frame: int
    camera: dict[str, Any]
    """Record of scene_camera."""
    truth: list[tuple[dict[str, Any], dict[str, Any]]]
    """Records of scene_gt and scene_gt_info, per instance."""
    files: SceneFiles


def write_contact_sheet(dataset: Path, out: Path, views: int) -> Path:
    """Draw up to `views` views of a data set, one per row, spread over all its splits, cameras, scenes and time, and write a PNG or JPEG
    file, whose folder is created. Raises DatasetError if the folder is not a data set, or a file is missing or damaged, and OutputError if
    the image cannot be written, or has more than MAX_VIEWS views."""
    drawing.check_picture_name(out)
    if views < 1:
        raise OutputError(f"{views} views requested; a contact sheet has at least 1")
    config = dataset / CONFIG_FILE
    cameras = len(load_config(str(config), {}).rig) if config.exists() else 0
    shown = list(_read_views(sample(find_scenes(dataset), views, cameras)))
    baked = read_baked(dataset, {record["obj_id"] for view in shown for record, _ in view.truth})
    scale = drawing.bin_scale(baked.config.cell.bins, [view.camera for view in shown]) if baked.config else None
    scale = scale or drawing.pooled_scale(depth for view in shown if (depth := _read_depth(view)) is not None)
    most = max(len(view.truth) for view in shown)
    rows = [_row(view, scale, baked, most) for view in shown]
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    return drawing.write_picture(out, sheet)


class Baked(NamedTuple):
    """Settings and object names of the bake behind a data set; None and empty for data sets of other programs."""

    dataset: Path
    config: Config | None
    names: dict[int, str]
    """obj_id -> name of an object."""

    def facts(self, scene: SheetScene, frame: int, camera: Mapping[str, Any]) -> list[str]:
        """Legend entries of a view: scene, episode, mode, time, light."""
        lines = [f"{scene.folder.parent.name}/{scene.folder.name}{scene.sensor.replace('_', ' ', 1)}, image {frame}"]
        if self.config is not None:
            episode, physics = DataLayout.of(self.config).scene_episode(int(scene.folder.name)), self.config.physics
            parts = [f"episode {episode}", f"{frame * physics.tick_time:.2f} s"]
            with contextlib.suppress(SynpickError):
                entry = read_entry(self.dataset, episode_entry(episode))
                parts += [f"mode {entry['row']['mode']}"] if entry is not None else []
            lines.append(", ".join(parts))
        light = camera.get("light")
        if isinstance(light, dict) and isinstance(light.get("map"), str):
            lines.append(f"light {light['map']}")
        return lines


def read_baked(dataset: Path, object_ids: set[int]) -> Baked:
    """Read settings and names of a data set, as far as it has them; raises ConfigError if its settings are damaged, and DatasetError if its
    models_info.json is."""
    path = dataset / CONFIG_FILE
    config = load_config(str(path), {}) if path.exists() else None
    if not (dataset / "models" / "models_info.json").exists():
        return Baked(dataset, config, {})
    known = config or load_config()
    return Baked(dataset, config, object_names(dataset, object_ids, known.object_rows, known.objects.diameter_tolerance))


def find_scenes(dataset: Path) -> list[SheetScene]:
    """Find the scenes of a data set, of each sensor, sorted; not those in hidden folders, where a running bake has unfinished ones. Raises
    DatasetError if there is none."""
    try:
        found = ForeignScenes(dataset)
    except NoLayoutError:
        if not dataset.is_dir():
            raise
        example = "a BOP data set has folders such as train_pbr/000000 with a scene_camera.json"
        raise DatasetError(f"{dataset} has no complete scene; {example}") from None
    return sorted(
        SheetScene(dataset / ref.split / (ref.name or f"{ref.scene:06d}"), ref.sensor, files=partial(found.open, ref))
        for ref in found.refs()
    )


def sample(scenes: list[SheetScene], views: int, cameras: int = 0) -> list[tuple[SheetScene, int]]:
    """Sample views: (scene, frame), sorted and distinct; all views if no more are there than asked for.

    Cameras in turn; a camera's scenes evenly; within a scene at frames of a low-discrepancy sequence. `cameras`: number of cameras of our
    own data set; 0: scenes are told apart by the poses of their cameras. Raises DatasetError if a file is damaged, or no scene has a view,
    and OutputError if more views are there and asked for than a sheet shows.
    """
    by_camera: dict[tuple[Any, ...], list[tuple[SheetScene, list[int]]]] = {}
    for scene in scenes:
        files = scene.files()
        frames = files.frames()
        if frames:
            first = files.camera(frames[0])
            own = (*first.get("cam_R_w2c", ()), *first.get("cam_t_w2c", ()))
            if cameras:
                own = (scene.sensor or int(scene.folder.name) % cameras,)
            group = by_camera.setdefault(own, [])
            group.append((scene, list(frames)))
    groups = list(by_camera.values())
    if not groups:
        raise DatasetError(f"no scene in {scenes[0].folder.parent} has a view; bake the data set again")
    present = sum(len(frames) for group in groups for _, frames in group)
    if min(views, present) > MAX_VIEWS:
        raise OutputError(f"{views} views requested, and the data set has {present}; a contact sheet has at most {MAX_VIEWS}")
    if views >= present:
        return sorted((scene, frame) for group in groups for scene, frames in group for frame in frames)
    samples = set()
    for number in range(views):
        group = groups[number % len(groups)]
        in_group = -(-(views - number % len(groups)) // len(groups))
        scene, frames = group[number // len(groups) * len(group) // in_group]
        samples.add((scene, frames[int((0.5 + number * drawing.GOLDEN) % 1.0 * len(frames))]))
    return sorted(samples)


def _read_views(samples: list[tuple[SheetScene, int]]) -> Iterator[_View]:
    """Read the annotations of views, which are sorted by scene: those of each scene once."""
    for scene, group in itertools.groupby(samples, key=lambda one: one[0]):
        files = scene.files()
        for _, frame in group:
            camera, truth, infos = files.records(frame)
            yield _View(scene, frame, camera, list(zip(truth, infos, strict=True)), files)


def _read_depth(view: _View) -> np.ndarray | None:
    if not view.files.has("depth") or "depth_scale" not in view.camera:
        return None
    counts = view.files.typed_image("depth", view.frame, None, "")
    return counts * float(view.camera["depth_scale"])


def _row(view: _View, depth_scale: drawing.DepthScale | None, baked: Baked, most: int) -> drawing.Image:
    """Draw all panels of a view side by side; `most` is the largest number of instances of all views."""
    depth = _read_depth(view)
    colored = None if depth is None else drawing.color_depth(depth, depth_scale)
    color = view.files.image("rgb", view.frame) if view.files.has("rgb") or colored is None else colored
    size = color.shape[1::-1]
    colored = _placeholder(color, "no depth in this data set") if colored is None else colored
    scale = min(_PANEL_WIDTH / size[0], _MAX_PANEL_HEIGHT / size[1])
    place, *facts = baked.facts(view.scene, view.frame, view.camera)
    seen = sum(info["px_count_visib"] > 0 for _, info in view.truth)
    low = max(_MIN_LEGEND, round(size[1] * scale))
    panels = [
        (place, _fit(color, scale)),
        (f"{drawing.describe_depth(depth_scale)}; one scale", _fit(colored, scale, smooth=False)),
        (f"instances: {len(view.truth)}, of which {seen} seen", _fit(_color_instances(view, color), scale, smooth=False)),
        ("boxes: amodal thin, visible thick", _draw_boxes(view, _fit(color, scale), scale)),
        ("object: label, visible fraction, name", draw_legend((legend_width(low, most), low), facts, view.truth, baked.names)),
    ]
    count = float(view.camera.get("depth_scale", 1.0))
    counts = depth_scale and drawing.DepthScale(*(each / count for each in depth_scale))
    panels += [(caption, _fit(picture, scale, smooth=False)) for caption, picture in drawing.layer_pictures(view.files, view.frame, counts)]
    if graph := view.files.graph(view.frame):
        panels.append(("arrows: lies on; numbers: unstacking order", _draw_graph(view, graph, _fit(color, scale), scale)))
    height = max(image.shape[0] for _, image in panels)
    return np.concatenate([_captioned(image, caption, height) for caption, image in panels], axis=1)


def _fit(image: drawing.Image, scale: float, smooth: bool = True) -> drawing.Image:
    """Scale an image to the panel's width; nearest neighbour for ids, masks and colour maps."""
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    fitted = cv2.resize(image, size, interpolation=cv2.INTER_AREA if smooth and scale < 1 else cv2.INTER_NEAREST)
    return np.pad(fitted, ((0, 0), (0, _PANEL_WIDTH - size[0]), (0, 0)))


def _captioned(image: drawing.Image, caption: str, height: int) -> drawing.Image:
    """Add a caption above an image, gaps around it, and space below it up to a height [px]."""
    head = np.zeros((_CAPTION, image.shape[1], 3), np.uint8)
    drawing.put_text(head, caption, (4, 14), 0.42, PAPER)
    return np.pad(np.concatenate((head, image)), ((0, height - image.shape[0] + _GAP), (0, _GAP), (0, 0)))


def _color_instances(view: _View, color: drawing.Image) -> drawing.Image:
    """Visible masks in their instances' colours over the darkened grey image."""
    if not view.files.has("mask_visib"):
        return _placeholder(color, "no masks in this data set")
    drawn = _darkened_grey(color)
    for index, (record, _) in enumerate(view.truth):
        drawn[view.files.mask("mask_visib", view.frame, index)] = drawing.instance_color(record.get("instance_id", index))
    return drawn


def _darkened_grey(color: drawing.Image) -> drawing.Image:
    return np.repeat(cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)[..., None] // 3, 3, axis=2)


def _placeholder(color: drawing.Image, text: str) -> drawing.Image:
    """Placeholder for a panel without data: a text on the darkened grey image."""
    drawn = _darkened_grey(color)
    drawing.put_text(drawn, text, (8, 24), 0.5, (230, 230, 230))
    return drawn


def _draw_graph(view: _View, graph: Mapping[str, Any], image: drawing.Image, scale: float) -> drawing.Image:
    """Draw the support graph over the darkened image: an arrow from each object to each that carries it, wider for a larger force, and the
    object's place in the unstacking order."""
    image //= 2
    place = {index: step + 1 for step, group in enumerate(graph.get("order", ())) for index in group}
    points, colors = {}, {}
    for index, (record, info) in enumerate(view.truth):
        if info["px_count_visib"] > 0:
            x, y, width, height = info["bbox_visib"]
            points[index] = round(scale * (x + width / 2)), round(scale * (y + height / 2))
            colors[index] = drawing.instance_color(record.get("instance_id", index))
    for upper, lower, force in graph.get("support", ()):
        if upper in points and lower in points:
            thickness = 1 + min(_WIDEST_ARROW, round(force))
            cv2.arrowedLine(image, points[upper], points[lower], colors[upper], thickness, cv2.LINE_AA, tipLength=0.2)
    for index, (x, y) in points.items():
        cv2.circle(image, (x, y), 4, colors[index], -1, cv2.LINE_AA)
        drawing.put_text(image, str(place.get(index, "")), (x + 5, y - 4), 0.42, PAPER)
    return image


def _draw_boxes(view: _View, image: drawing.Image, scale: float) -> drawing.Image:
    """Draw amodal and visible bounding boxes with labels, in place."""
    texts, boxes, labels, colors = label_texts(view.truth), [], [], []
    for index, (record, info) in enumerate(view.truth):
        if info["px_count_visib"] == 0:
            continue
        color = drawing.instance_color(record.get("instance_id", index))
        for name, thickness in (("bbox_obj", 1), ("bbox_visib", 2)):
            x, y, width, height = info[name]
            if width < 0:
                continue
            # BOP's boxes end with their last pixel; OpenCV takes corner coordinates, hence + 1.
            first, second = ((round(scale * u), round(scale * v)) for u, v in ((x, y), (x + width + 1, y + height + 1)))
            cv2.rectangle(image, first, second, color, thickness)
        boxes.append(Box(*(scale * value for value in info["bbox_visib"])))
        labels.append(texts[index])
        colors.append(color)
    draw_labels(image, boxes, labels, colors)
    return image


LABEL = 0.42
"""Font scale of a box's label."""
_PAD = 2
"""Margin of a label's text [px]."""
_STEP = 6
"""Grid spacing of further label positions, tried if none in or around the box is free [px]."""
_TEXT = 0.42
"""Font scale of the legend."""
_SPACE = 8
"""Space between facts and objects [px]."""
LINE = 17
"""Height of a line of the legend [px]."""
_SWATCH = 30
"""Width of a coloured label in the legend [px]."""
COLUMN = 240
"""Width of a column of the legend [px]."""
_COLUMNS = 2
"""Most columns of a legend."""
_FACTS = 2
"""Lines above the objects: episode, mode, time; light."""
_SHADE = 0.85
"""Brightness of a label's background relative to the instance's colour, for contrast with the box."""
PAPER, SOFT = (230, 230, 230), (150, 150, 150)


class Box(NamedTuple):
    """Rectangle: left upper corner, width and height [px]."""

    x: float
    y: float
    width: float
    height: float

    def meets(self, other: "Box") -> bool:
        """Whether two rectangles overlap; common edges do not count."""
        return (
            self.x < other.x + other.width
            and other.x < self.x + self.width
            and self.y < other.y + other.height
            and other.y < self.y + self.height
        )


def place_labels(boxes: Sequence[Box], sizes: Sequence[tuple[int, int]], area: tuple[int, int]) -> list[Box | None]:
    """Place a label for each box so that none overlaps another: in the box, else at it, else as near as there is room; None: no room.

    Small boxes come first, as they have the fewest places. `sizes` and `area` are width and height of each label, and of the image [px].
    """
    placed: list[Box | None] = [None] * len(boxes)
    for index in sorted(range(len(boxes)), key=lambda index: boxes[index].width * boxes[index].height):
        taken = [label for label in placed if label is not None]
        tried = (Box(x, y, *sizes[index]) for x, y in _places(boxes[index], sizes[index], area))
        placed[index] = next((label for label in tried if not any(label.meets(other) for other in taken)), None)
    return placed


def _places(box: Box, size: tuple[int, int], area: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Corners of a label's places in the image, the best ones first."""
    room = area[0] - size[0], area[1] - size[1]
    if min(room) < 0:
        return
    inside = box.x + box.width - size[0], box.y + box.height - size[1]
    near = [(box.x, box.y), (inside[0], box.y), (box.x, inside[1]), inside]
    near += [(box.x, box.y - size[1]), (box.x, box.y + box.height), (box.x - size[0], box.y), (box.x + box.width, box.y)]
    for x, y in near:
        yield round(min(max(x, 0), room[0])), round(min(max(y, 0), room[1]))
    middle = box.x + (box.width - size[0]) / 2, box.y + (box.height - size[1]) / 2
    grid = [(x, y) for x in range(0, room[0] + 1, _STEP) for y in range(0, room[1] + 1, _STEP)]
    yield from sorted(grid, key=lambda place: (place[0] - middle[0]) ** 2 + (place[1] - middle[1]) ** 2)


def label_texts(truth: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> list[str]:
    """Short label of each instance of a view: obj_id, with a letter where several share it."""
    instances = [record.get("instance_id", index) for index, (record, _) in enumerate(truth)]
    labels = drawing.short_labels(zip(instances, (record["obj_id"] for record, _ in truth), strict=True))
    return [labels[instance] for instance in instances]


def draw_labels(image: drawing.Image, boxes: Sequence[Box], texts: Sequence[str], colors: Sequence[tuple[int, int, int]]) -> None:
    """Draw labels of boxes on their instances' colours, in place; a line leads from a label outside its box to it. Those without room are
    left out."""
    sizes = [(width + 2 * _PAD, height + 2 * _PAD) for width, height in (drawing.text_size(text, LABEL) for text in texts)]
    for box, place, text, color in zip(boxes, place_labels(boxes, sizes, image.shape[1::-1]), texts, colors, strict=True):
        if place is None:
            continue
        if not place.meets(Box(box.x - 1, box.y - 1, box.width + 2, box.height + 2)):
            start, end = ((round(each.x + each.width / 2), round(each.y + each.height / 2)) for each in (place, box))
            cv2.line(image, start, end, _ground(color), 1, cv2.LINE_AA)
        _put_label(image, text, place, color)


def _ground(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Darkened colour (BGR) for the background of a label."""
    blue, green, red = (round(_SHADE * value) for value in color)
    return blue, green, red


def _put_label(image: drawing.Image, text: str, place: Box, color: tuple[int, int, int]) -> None:
    """Draw text on a filled rectangle of the darkened colour, in place."""
    low = round(place.x), round(place.y)
    high = round(place.x + place.width) - 1, round(place.y + place.height) - 1
    cv2.rectangle(image, low, high, _ground(color), -1)
    drawing.put_text(image, text, (low[0] + _PAD, high[1] - _PAD), LABEL, drawing.readable_on(_ground(color)))


def legend_width(height: int, instances: int) -> int:
    """Width of legends of a height [px] with up to `instances` instances [px]: one column or several."""
    return COLUMN * (1 if instances <= _rows(height, _FACTS) else _COLUMNS)


def _rows(height: int, facts: int) -> int:
    """Number of instances that the legend's height has space for, below the facts."""
    return max(1, (height - LINE * facts - _SPACE) // LINE)


def draw_legend(
    size: tuple[int, int],
    facts: Sequence[str],
    truth: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    names: Mapping[int, str],
) -> drawing.Image:
    """Draw the legend of a view, a new image: facts, then label, name and visible fraction of each instance, the most visible first.

    `size` is width and height [px], and what does not fit is counted; `truth` has the records of scene_gt and scene_gt_info of each
    instance; `names` by obj_id may lack some.
    """
    panel = np.zeros((size[1], size[0], 3), np.uint8)
    drawing.put_lines(panel, (drawing.shorten(fact, size[0] - 12, _TEXT) for fact in facts), (6, LINE - 3), LINE, _TEXT, PAPER)
    texts = label_texts(truth)
    order = sorted(range(len(truth)), key=lambda index: (-np.nan_to_num(truth[index][1]["visib_fract"]), index))
    top, rows, columns = LINE * len(facts) + _SPACE, _rows(size[1], len(facts)), size[0] // COLUMN
    shown = order if len(order) <= rows * columns else order[: rows * columns - 1]
    for place, index in enumerate(shown):
        record, info = truth[index]
        x, y = 6 + COLUMN * (place // rows), top + LINE * (place % rows)
        color = drawing.instance_color(record.get("instance_id", index))
        _put_label(panel, texts[index], Box(x, y, max(_SWATCH, drawing.text_size(texts[index], LABEL)[0] + 2 * _PAD), LINE - 3), color)
        name = names.get(record["obj_id"], "") or f"object {record['obj_id']}"
        hidden = info["px_count_visib"] == 0
        unknown = math.isnan(info["visib_fract"])
        seen = "" if unknown else "hidden" if hidden else f"{info['visib_fract']:.2f}"
        drawing.put_text(panel, seen, (x + _SWATCH + 8, y + LINE - 6), _TEXT, SOFT)
        drawing.put_text(
            panel, drawing.shorten(name, COLUMN - _SWATCH - 58, _TEXT), (x + _SWATCH + 48, y + LINE - 6), _TEXT, SOFT if hidden else PAPER
        )
    if len(shown) < len(order):
        place = (6 + COLUMN * (columns - 1), top + LINE * rows - 6)
        drawing.put_text(panel, f"and {len(order) - len(shown)} more", place, _TEXT, SOFT)
    return panel
