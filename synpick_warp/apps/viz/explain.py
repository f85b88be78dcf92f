"""Figure of a pick attempt, from a data set's files: image with contours and suction points, clutter graph, explanation in sentences, table
of objects, plot of the seal force over time. The layout follows the figure of the paper (Periyasamy et al., SynPick, 2021)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.apps.viz import drawing, explain_record
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.episodes.manipulation import Pick, Target
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.annotations import Pixel
from synpick_warp.dataset.bop.layout import object_names
from synpick_warp.dataset.scene_index import SceneIndex
from synpick_warp.dataset.view import View
from synpick_warp.errors import DatasetError
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Camera
from synpick_warp.system.codecs.charts import Spec, axis, limit, line, points, render_charts, theme

DEFAULT_ATTEMPTS = 3
"""Attempts that are drawn if none is named."""
MARGIN = 20
"""Margin of the sheet, and gap between columns [px]."""
HEAD = 64
"""Height of the headline and the captions below it [px]."""
IMAGE_WIDTH = 880
"""Width of the colour image on the sheet [px]."""
_MAX_IMAGE_HEIGHT = 880
"""Maximum height of the colour image [px]."""
_GRAPH_WIDTH = 500
"""Width of the clutter graph [px]."""
_MIN_ROW_HEIGHT = 640
"""Minimum height of a row without its headline [px]."""
_LABEL = 0.5
"""Font scale of an object's label on the image; the target's is larger."""
_HALO = 3
"""Width of the dark outline around bright lines on the image [px]."""
WORDS_WIDTH = 470
"""Width of the text and the table [px]."""
PLOT_HEIGHT = 190
_MAX_PLOT_HEIGHT = 260
"""Minimum and maximum height of the plot [px]."""
LINE = 22
"""Height of a line of text [px]."""
TEXT = 0.46
"""Font scale of text (OpenCV)."""
SMALL = 0.42
GREEN = (60, 130, 30)
SOFT = (110, 110, 110)
_BLUE, _RED, _SOFT = "#145aaa", "#c83c3c", "#6e6e6e"
"""Colours of the plot."""
_FONT = 13
"""Font size of the plot [px]."""
_DOT = 40.0
"""Area of a tick's disc [px²]."""
_MAX_DOTS = 200
"""Fewest ticks of a lift whose curve has no dots, which would hide it."""
_COLUMNS = ((0, "object"), (236, "above"), (296, "area"), (356, "pixels"), (416, "point"))
"""Position [px] and heading of the table's columns."""


def write_explanation(dataset: Path, out: Path, episode: int | None, attempt: int | None = None) -> Path:
    """Draw one attempt of an episode, all of them (None), or the first DEFAULT_ATTEMPTS worth seeing of any, below each other, and write a
    PNG or JPEG file, whose folder is created. Raises ConfigError if the data set's config.toml is damaged, DatasetError if there is no such
    attempt, or a file is missing or damaged, OutputError if the image cannot be written, and ChartError if the charts' library cannot run.
    """
    drawing.check_picture_name(out)
    if not dataset.is_dir():
        raise DatasetError(f"there is no folder {dataset}; name the folder of a BOP data set")
    attempts = (
        explain_record.choose_attempts(dataset, DEFAULT_ATTEMPTS)
        if episode is None
        else explain_record.read_attempts(dataset, episode, attempt)
    )
    path = dataset / "config.toml"
    if not path.exists():
        raise DatasetError(f"{dataset} has no config.toml; the settings of the bake are needed to explain what it did")
    config = load_config(str(path), {})
    seen = {one.object_id for each in attempts for one in each.seen}
    names = object_names(dataset, seen, config.object_rows, config.objects.diameter_tolerance)
    scenes = SceneIndex(dataset, DataLayout.of(config), config.rig.sizes)
    suction, tick_time = config.suction, config.physics.tick_time
    camera, rows = config.rig.index(config.perception.camera), []
    planned = planning_camera(config.rig, camera)
    for each in attempts:
        view = _open_view(dataset, scenes, each, camera, config.rig.every[camera])
        rows.append(_row(each, view, planned, draw_words(each, names, (config.target, config.pick), suction), config.perception.min_votes))
    charts = [load_chart(each, suction, tick_time, IMAGE_WIDTH, room) for each, (_, room) in zip(attempts, rows, strict=True)]
    for (sheet, _), data in zip(rows, render_charts(charts, scale=1.0), strict=True):
        plot = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
        drawing.paste(sheet, plot, MARGIN, len(sheet) - MARGIN - len(plot))
    return drawing.write_picture(out, np.concatenate([sheet for sheet, _ in rows]))


def _open_view(dataset: Path, scenes: SceneIndex, attempt: explain_record.SeenAttempt, camera: int, every: int) -> View:
    """View of the camera of perception in which an attempt's choice was made, or the last before: it renders each `every`-th frame."""
    files, frame = scenes.files(attempt.episode, camera), attempt.frame - attempt.frame % every
    if frame not in files.frames():
        raise DatasetError(f"{files.place} has no image {frame}, as {dataset}/attempts.jsonl names frame {attempt.frame}")
    return View(files, attempt.episode, camera, frame)


def to_color_image(pixel: Pixel, resolution: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """Map a pixel (column, row) of the perception image to the colour image, by width and height of both [px]; integers are pixel centres.

    Both images have the same camera and horizontal field of view, and the same point in the middle; their aspect ratios may differ.
    """
    scale = size[0] / resolution[0]
    column, row = ((value + 0.5 - old / 2) * scale + new / 2 - 0.5 for value, old, new in zip(pixel, resolution, size, strict=True))
    return column, row


def planning_camera(rig: Rig, camera: int) -> Camera | None:
    """The camera by which perception sees, where views differ from it: behind a lens, or drawn anew by each episode; None: they do not."""
    planned = make_cameras(rig)[camera]
    return planned if planned.lens is not None or rig.is_placed(camera) else None


def to_view(view: View, planned: Camera, places: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Places (column, row) in the pinhole image of the camera by which perception sees, in a view of the drawn camera or through its lens.

    Both differ little, so that the depth of the point is that of the same pixel in the view.
    """
    matrix, (columns, rows) = planned.matrix, np.round(places).astype(int).T
    height, width = view.rgb.shape[:2]
    near = view.depth[rows.clip(0, height - 1), columns.clip(0, width - 1)] if view.has("depth") else np.zeros(len(places))
    rays = np.column_stack(((np.array(places) + 0.5 - matrix[:2, 2]) / matrix[[0, 1], [0, 1]], np.ones(len(places))))
    points = (rays * np.where(near > 0.0, near, 1.0)[:, None] - planned.translation) @ planned.rotation
    return [(x, y) for x, y in (view.project(points, view.world_to_camera) - 0.5).tolist()]


def _row(
    attempt: explain_record.SeenAttempt, view: View, planned: Camera | None, words: drawing.Image, min_votes: float
) -> tuple[drawing.Image, int]:
    """Draw one attempt: image, clutter graph, and text and table (`words`), with room at the lower left for the force's plot, whose height
    [px] is returned, too."""
    image = draw_observation(attempt, view, planned)
    left = image.shape[0] + 2 * LINE + MARGIN + PLOT_HEIGHT
    height = max(left, words.shape[0], _MIN_ROW_HEIGHT)
    sheet = drawing.blank(IMAGE_WIDTH + _GRAPH_WIDTH + WORDS_WIDTH + 4 * MARGIN, HEAD + height + 2 * MARGIN)
    columns = MARGIN, 2 * MARGIN + IMAGE_WIDTH, 3 * MARGIN + IMAGE_WIDTH + _GRAPH_WIDTH
    top = MARGIN + HEAD
    drawing.paste(sheet, image, columns[0], top)
    _draw_key(sheet, columns[0], top + image.shape[0] + 24)
    states = {edge.state for edge in explain_record.clutter_edges(attempt, min_votes)}
    foot = _graph_foot(states) if attempt.seen else []
    drawing.paste(sheet, explain_record.draw_graph(attempt, min_votes, (_GRAPH_WIDTH, height - LINE * len(foot))), columns[1], top)
    for number, (text, color) in enumerate(foot):
        drawing.put_text(sheet, text, (columns[1], top + height - LINE * (len(foot) - 1 - number) - 6), SMALL, color)
    drawing.paste(sheet, words, columns[2], top)
    head = f"Episode {attempt.episode}, attempt {attempt.attempt} ({explain_record.MODE_WORDS[attempt.mode]}): {attempt.sentence}"
    drawing.put_text(sheet, head, (MARGIN, MARGIN + 20), 0.68, GREEN if attempt.picked else explain_record.RED, 2)
    scene = Path(view.place)
    captions = [f"camera {view.camera}: {scene.parent.name}/{scene.name}, image {view.frame}", "clutter graph", "choice and outcome"]
    if not view.has("mask_visib"):
        captions[0] += "; no contours: this data set has no masks"
    for text, column in zip(captions, columns, strict=True):
        drawing.put_text(sheet, text, (column, top - 9), TEXT, SOFT)
    sheet[-1] = explain_record.GREY
    return sheet, height - image.shape[0] - 2 * LINE - MARGIN


def draw_observation(attempt: explain_record.SeenAttempt, view: View, planned: Camera | None) -> drawing.Image:
    """Draw contours, if the data set has masks, and suction points on the colour image, which is darkened except for the target.

    `view` is the camera of perception at the observation, `planned` as of `planning_camera`. Raises DatasetError if a file is missing or
    damaged.
    """
    color, seen = view.rgb[..., ::-1], attempt.objects
    ids = view.instance_ids.tolist() if view.has("mask_visib") else []
    masks = {instance: view.masks[row] for row, instance in enumerate(ids) if instance in seen}
    height, width = color.shape[:2]
    scale = min(IMAGE_WIDTH / width, _MAX_IMAGE_HEIGHT / height)
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    color = cv2.resize(color, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    drawn = (0.62 * color).astype(np.uint8)
    order = sorted(masks, key=lambda instance: instance == attempt.target)
    for instance in order:
        mask = cv2.resize(255 * masks[instance].astype(np.uint8), size, interpolation=cv2.INTER_LINEAR) > 127
        _draw_contours(drawn, color, mask, instance, instance == attempt.target)
    short = explain_record.labels(attempt)
    for one in attempt.seen:
        places = [to_color_image(point, attempt.observation.resolution, (width, height)) for point in (*one.candidates, one.grasp_pixel)]
        if planned is not None:
            places = to_view(view, planned, places)
        points = [(scale * (x + 0.5) - 0.5, scale * (y + 0.5) - 0.5) for x, y in places]
        target = one.instance == attempt.target
        for kind, point in enumerate(points[:-1]):
            draw_mark(drawn, kind, point)
        draw_chosen(drawn, points[-1], drawing.instance_color(one.instance), target)
        _put_label(drawn, short[one.instance], points[-1], drawing.instance_color(one.instance), 1.3 * _LABEL if target else _LABEL)
    return drawn


def _draw_contours(drawn: drawing.Image, color: drawing.Image, mask: np.ndarray, instance: int, target: bool) -> None:
    """Draw contours of a mask's components and holes, in place; the target keeps its brightness, with tint and white outline."""
    lines = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    shade = drawing.instance_color(instance)
    if target:
        drawn[mask] = (0.72 * color[mask] + 0.28 * np.array(shade)).astype(np.uint8)
        cv2.drawContours(drawn, lines, -1, drawing.WHITE, 3 * _HALO, cv2.LINE_AA)
        cv2.drawContours(drawn, lines, -1, shade, _HALO + 1, cv2.LINE_AA)
    else:
        cv2.drawContours(drawn, lines, -1, drawing.INK, _HALO + 1, cv2.LINE_AA)
        cv2.drawContours(drawn, lines, -1, shade, 2, cv2.LINE_AA)


def draw_mark(picture: drawing.Image, kind: int, place: tuple[float, float]) -> None:
    """Draw a suction point candidate, white with a dark outline: pole of inaccessibility, ring; centroid, cross; half-way, diamond."""
    x, y = place
    reach = 5.0
    shapes = {
        1: [[(x - reach, y), (x + reach, y)], [(x, y - reach), (x, y + reach)]],
        2: [[(x - reach, y), (x, y - reach), (x + reach, y), (x, y + reach), (x - reach, y)]],
    }
    for color, thickness in ((drawing.INK, 4), (drawing.WHITE, 2)):
        if kind == 0:
            explain_record.disc(picture, place, reach, color, thickness)
        else:
            for line in shapes[kind]:
                cv2.polylines(picture, [explain_record.fixed(np.array(line))], False, color, thickness, cv2.LINE_AA, 4)


def draw_chosen(picture: drawing.Image, place: tuple[float, float], color: tuple[int, int, int], target: bool) -> None:
    """Draw a suction point: a disc in the object's colour; the target's has a ring."""
    if target:
        explain_record.disc(picture, place, 14, drawing.INK, 5)
        explain_record.disc(picture, place, 14, drawing.WHITE, 3)
    explain_record.disc(picture, place, 5.5, drawing.INK)
    explain_record.disc(picture, place, 4.0, color)


def _put_label(picture: drawing.Image, text: str, point: tuple[float, float], color: tuple[int, int, int], size: float) -> None:
    (width, height), _ = cv2.getTextSize(text, drawing.FONT, size, 1)
    place = (point[0] + (22 if size > _LABEL else 13) + width / 2, point[1] - 8 - height / 2)
    explain_record.put_boxed(picture, text, place, size, drawing.readable_on(color), color)


def _draw_key(sheet: drawing.Image, x: int, y: int) -> None:
    for kind, text in enumerate(("pole of inaccessibility", "centroid", "half-way", "suction point", "that of the target")):
        place = (x + (17.0 if kind == 4 else 8.0), y - 4.5)
        if kind < 3:
            draw_mark(sheet, kind, place)
        else:
            draw_chosen(sheet, place, (200, 200, 200), kind == 4)
        drawing.put_text(sheet, text, (round(place[0]) + (26 if kind == 4 else 14), y), SMALL, SOFT)
        x += 44 + cv2.getTextSize(text, drawing.FONT, SMALL, 1)[0][0]


def _graph_foot(states: set[str]) -> Sequence[tuple[str, tuple[int, int, int]]]:
    lines = [("arrow: from the object on top to the one below, with its votes", SOFT), ("badge: number of objects above", SOFT)]
    lines += [(f"dashed: {explain_record.OUTVOTED}", explain_record.GREY)] if explain_record.OUTVOTED in states else []
    return lines + ([(f"dashed: {explain_record.CYCLIC}", explain_record.RED)] if explain_record.CYCLIC in states else [])


# ---- panels ----


def draw_words(
    attempt: explain_record.SeenAttempt, names: Mapping[int, str], rules: tuple[Target, Pick], suction: Suction
) -> drawing.Image:
    """Draw the explanation in sentences, and below it the table of objects, ranked by the choice rule."""
    lines = [
        (line, drawing.INK) for text in explain_record.choice_words(attempt, names, *rules) for line in wrapped(text, TEXT, WORDS_WIDTH)
    ]
    lines += [
        (line, drawing.INK) for text in explain_record.seal_words(attempt, names, suction) for line in wrapped(text, TEXT, WORDS_WIDTH)
    ]
    outcome = attempt.sentence[:1].upper() + attempt.sentence[1:]
    lines += [(line, GREEN if attempt.picked else explain_record.RED) for line in wrapped(outcome, TEXT, WORDS_WIDTH)]
    canvas = drawing.blank(WORDS_WIDTH, LINE * (len(lines) + len(attempt.seen) + 3))
    for number, (text, color) in enumerate(lines):
        drawing.put_text(canvas, text, (0, LINE * number + 16), TEXT, color)
    if attempt.seen:
        _draw_table(canvas, attempt, names, LINE * (len(lines) + 1))
    return canvas


def _draw_table(canvas: drawing.Image, attempt: explain_record.SeenAttempt, names: Mapping[int, str], top: int) -> None:
    short = explain_record.labels(attempt)
    for x, text in _COLUMNS:
        drawing.put_text(canvas, text, (x, top + 16), TEXT, SOFT)
    cv2.line(canvas, (0, top + LINE + 1), (WORDS_WIDTH, top + LINE + 1), explain_record.GREY, 1)
    for number, one in enumerate(attempt.ranked()):
        y = top + LINE * (number + 1) + 18
        target = one.instance == attempt.target
        if target:
            canvas[y - 15 : y + 7] = (225, 240, 225) if attempt.picked else (228, 228, 245)
        explain_record.disc(canvas, (8, y - 5), 7, drawing.INK)
        explain_record.disc(canvas, (8, y - 5), 6, drawing.instance_color(one.instance))
        name = drawing.shorten(f"{short[one.instance]} {names.get(one.object_id, '')}", _COLUMNS[1][0] - 30, TEXT)
        kind = ("pole", "centr.", "half", "drawn")[explain_record.suction_kind(one)]
        cells = ((22, name), (244, f"{len(one.ancestors)}"), (296, f"{one.visible_fraction:.2f}"), (356, f"{one.visible}"), (416, kind))
        for x, text in cells:
            drawing.put_text(canvas, text, (x, y), TEXT, drawing.INK, 2 if target and x == 22 else 1)


def wrapped(text: str, size: float, width: int) -> list[str]:
    """Wrap text to lines of at most that width [px]; all but the first are indented."""
    lines: list[str] = []
    current = ""
    for word in text.split():
        longer = f"{current} {word}" if current.strip() else current + word
        if current.strip() and cv2.getTextSize(longer, drawing.FONT, size, 1)[0][0] > width:
            lines.append(current)
            current = f"    {word}"
        else:
            current = longer
    return [*lines, current]


def load_chart(attempt: explain_record.SeenAttempt, suction: Suction, tick_time: float, width: int, height: int) -> Spec:
    """Chart of the seal force over time, with the break force; size in pixels, whose height is kept in its limits.

    `tick_time`: time between two frames [s].
    """
    height = max(PLOT_HEIGHT, min(height, _MAX_PLOT_HEIGHT))
    size = {"width": width, "height": height, "autosize": {"type": "fit", "contains": "padding"}, "padding": 2, "background": "white"}
    text = {"color": _SOFT, "fontSize": _FONT}
    title = {**text, "text": "seal force [N] (the largest, if several)", "anchor": "start", "fontWeight": "normal"}
    breaks = explain_record.break_force(attempt, suction)
    if not attempt.peak_force or not attempt.hits:
        said = {"type": "text", "text": "no force: nothing was engaged", **text}
        return {**size, "title": title, "data": {"values": [{}]}, "mark": said, "config": theme(_FONT)}
    span = tick_time * max(1, len(attempt.peak_force) - 1)
    peak = 1.25 * max(breaks, *attempt.peak_force)
    y = axis("y", None, 0.0, peak, tickCount=4)
    times = np.linspace(0.0, span, max(2, len(attempt.peak_force)))[: len(attempt.peak_force)]
    label = {"align": "left", "baseline": "bottom", "x": 8, "dy": -3, "color": _RED, "fontSize": _FONT}
    rule = limit({"y": {**y, "field": "limit"}, "x": None}, breaks, f"breaks at {breaks:.3g} N", {"color": _RED, "strokeWidth": 2}, label)
    curve = line(2.5, {"value": _BLUE}, dots=_DOT if len(times) < _MAX_DOTS else 0.0)
    x = axis("x", "time since the suction was switched on [s]", -0.01 * span, 1.01 * span, tickCount=8)
    return {
        **size,
        "title": title,
        "config": theme(_FONT),
        "encoding": {"x": x, "y": y},
        "layer": [rule, points(curve, 0.0, peak, attempt.peak_force, x=times)],
    }
