"""Commands `preview` and `explain`: contact sheets, symmetries and cells, and figures of pick attempts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from synpick_warp.cli.options import DataSetArgument, WholeNumber, beside, check_output_file, find_data_set
from synpick_warp.configs.episodes.objects import AUTO_UNIT, DECLARED, DETECT
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import ConfigError, escape
from synpick_warp.scenes.bin_meshes.loading import load_settings

if TYPE_CHECKING:
    from synpick_warp.scenes.types import RawObject
    from synpick_warp.system.progress import Progress


def preview(
    folder: DataSetArgument = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="PNG or JPEG file to write (default DIR-contact-sheet.png, beside the data set).")] = None,
    views: Annotated[WholeNumber, Parameter(help="Number of views, spread over the data set.")] = 8,
    symmetries: Annotated[
        bool,
        Parameter(
            negative=(),
            help="Draw the symmetries of the objects instead: of a data set those that it states; DIR may also be a folder of models, "
            "where they are detected unless they are declared.",
        ),
    ] = False,
    picks: Annotated[
        bool,
        Parameter(
            negative=(),
            help="Draw the picks that were tried from up to --views states instead: heat maps of success and of the analytic score.",
        ),
    ] = False,
    config: Annotated[
        str | None, Parameter(help="Settings of a folder of models (unit, object table, tolerance): a preset or .toml file.")
    ] = None,
    cell: Annotated[
        str | None,
        Parameter(
            name="--cell",
            help="Draw the cell of these settings instead, a preset or .toml file, before anything is simulated: from outside with the "
            "frusta of the cameras, bins and gripper, and from each camera (default of --out: the file's name with .png).",
        ),
    ] = None,
) -> int:
    """Draw a contact sheet: colour, depth, instance masks, bounding boxes and layers of sampled views."""
    if cell is not None:
        others = {"DIR": folder, "--symmetries": symmetries or None, "--config": config}
        if beside_it := [name for name, value in others.items() if value is not None]:
            raise ConfigError(f"{beside_it[0]} is given beside --cell, which draws settings; allowed: one of both")
        return _preview_cell(cell, out)
    if symmetries:
        return _preview_symmetries(folder, out, config)
    if config is not None:
        raise ConfigError("--config is given without --symmetries; a data set has its settings")
    if views < 1:
        raise ConfigError(f"--views is {views}; allowed: at least 1")
    folder = find_data_set(folder, "synpick-warp preview DIR")
    sheet = _picture_file(out, folder, "-picks.png" if picks else "-contact-sheet.png")
    if picks:
        from synpick_warp.apps.viz.picks import write_pick_maps
        from synpick_warp.dataset.reading import open_data_set

        write_pick_maps(open_data_set(folder), sheet, views)
    else:
        from synpick_warp.apps.viz.preview import write_contact_sheet

        write_contact_sheet(folder, sheet, views)
    print(f"contact sheet: {escape(str(sheet))}")
    return 0


def _picture_file(out: Path | None, folder: Path, ending: str) -> Path:
    """Picture to write: `--out`, which replaces no file of a data set, or else beside the folder, whose name it has with an ending."""
    from synpick_warp.apps.viz.drawing import check_picture_name

    picture = out or beside(folder, ending)
    check_picture_name(picture)
    check_output_file(picture, "--out", folder)
    return picture


def _preview_symmetries(folder: Path | None, out: Path | None, config: str | None) -> int:
    """Draw the symmetries of the objects of a data set, or of a folder of models."""
    from synpick_warp.dataset.commit.manifest import CONFIG_FILE, MANIFEST_FILE

    settings: dict[str, object] = {"objects.symmetries": DETECT}
    models, is_set = folder, False
    if folder is None or (folder / MANIFEST_FILE).is_file():
        folder = find_data_set(folder, "synpick-warp preview DIR --symmetries")
        if config is not None:
            raise ConfigError(f"--config is given, but {folder} is a data set, which has its settings; name the folder of models")
        # Its models are BOP's, with symmetries of their own; rows may be of meshes with other ids.
        models, is_set = folder / "models", True
        settings = {"objects.symmetries": DECLARED, "objects.unit": AUTO_UNIT}
        config = str(folder / CONFIG_FILE) if (folder / CONFIG_FILE).exists() else None
    sheet = _picture_file(out, folder, "-symmetries.png")
    from synpick_warp.apps.viz.symmetries import write_symmetry_sheet
    from synpick_warp.scenes.catalog import read_objects

    # A data set's settings have what its bins measured; their files may be gone.
    load = load_config if is_set else load_settings
    resolved = load(config, settings | {"bake.models": str(models)})

    def report(line: str) -> None:
        print(escape(line))

    rows = () if is_set else resolved.object_rows
    objects = read_objects(resolved.bake.models, resolved.objects, rows, resolved.cell.bins, report)
    write_symmetry_sheet(objects, resolved.objects.symmetry_tolerance, sheet, report)
    print(f"symmetries: {escape(str(sheet))}")
    return 0


def _preview_cell(cell: str, out: Path | None) -> int:
    sheet = out or Path(cell).with_suffix(".png")
    from synpick_warp.apps.viz.drawing import check_picture_name

    check_picture_name(sheet)
    check_output_file(sheet, "--out", inputs=[Path(cell)])
    from synpick_warp.cli.display import make_console, make_progress

    with make_progress(make_console()) as progress:
        draw_cell(cell, Path(cell).name, sheet, progress, lambda note: progress.note(escape(note)))
    print(f"cell: {escape(str(sheet))}")
    return 0


def draw_cell(
    preset_or_file: str | Path,
    name: str,
    out: Path,
    progress: Progress,
    say: Callable[[str], None],
    objects: Sequence[RawObject] | None = None,
) -> None:
    """Draw the cell of settings, as of `load_settings`; `name`: for its title; `objects`: those of the settings, None: they are read.
    Raises SynpickError if settings, device, bins, cameras or all objects cannot be used, or the file cannot be written."""
    config = load_settings(preset_or_file)
    from synpick_warp.apps.viz.cell import CellScene, write_cell_sheet
    from synpick_warp.configs.dataset import may_pick
    from synpick_warp.scenes.cameras import describe_cameras

    scene = CellScene(config, progress, say, objects)
    for line in describe_cameras(may_pick(config.bake, config.splits), config.rig, config.cell.bins, config.gripper, config.pick):
        say(line)
    progress.stage(f"rendering {len(config.rig)} cameras")
    write_cell_sheet(scene, config.rig, config.bins, name, out)


def explain(
    folder: Annotated[
        Path | None, Parameter(name="DIR", help="A data set with pick attempts (default: synpick-data in the current folder).")
    ] = None,
    /,
    *,
    episode: Annotated[
        WholeNumber | None, Parameter(help="Index of the episode (default: the first three attempts worth seeing, of any).")
    ] = None,
    attempt: Annotated[WholeNumber | None, Parameter(help="Index of the attempt in the episode (default: all).")] = None,
    state: Annotated[
        WholeNumber | None,
        Parameter(
            help="Explain picks that were tried from this state of the episode (default: the first with any) instead: heat maps of success "
            "and of the analytic score, and a trial."
        ),
    ] = None,
    candidate: Annotated[
        WholeNumber | None, Parameter(help="Candidate whose trial is explained (default: the failure with the highest analytic score).")
    ] = None,
    out: Annotated[
        Path | None,
        Parameter(help="PNG or JPEG file to write (default DIR-explain.png, with indices if they are given, beside the data set)."),
    ] = None,
) -> int:
    """Draw pick attempts: image with contours and suction points, clutter graph, choice of the target with its reason, seal force.

    Worth seeing is an attempt that chose among several objects, some of which lie on others, and engaged one.
    """
    if episode is None and attempt is not None:
        raise ConfigError(f"--attempt is {attempt}, but no episode is named; add --episode")
    if attempt is not None and state is not None:
        raise ConfigError("--attempt is given beside --state, which is of picks; allowed: one of both")
    if candidate is not None and state is None:
        raise ConfigError(f"--candidate is {candidate}, but no state is named; add --state")
    folder = find_data_set(folder, "synpick-warp explain DIR")
    if state is not None:
        return _explain_picks(folder, episode, state, candidate, out)
    ending = "" if episode is None else f"-{episode:06d}" if attempt is None else f"-{episode:06d}-{attempt:03d}"
    picture = _picture_file(out, folder, f"-explain{ending}.png")
    from synpick_warp.apps.viz.explain import write_explanation

    write_explanation(folder, picture, episode, attempt)
    print(f"explanation: {escape(str(picture))}")
    return 0


def _explain_picks(folder: Path, episode: int | None, state: int, candidate: int | None, out: Path | None) -> int:
    from synpick_warp.apps.viz.picks import write_pick_sheet
    from synpick_warp.dataset.reading import open_data_set

    picture = _picture_file(out, folder, f"-picks-{'' if episode is None else f'{episode:06d}-'}{state:03d}.png")
    write_pick_sheet(open_data_set(folder), picture, episode, state, candidate)
    print(f"explanation: {escape(str(picture))}")
    return 0
