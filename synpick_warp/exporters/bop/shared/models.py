"""Files of a BOP dataset that all scenes share: models with sizes and symmetries, camera.json, and notes for humans."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.errors import CatalogError
from synpick_warp.exporters.bop.shared.toolkit import describe_toolkit
from synpick_warp.exporters.bop.view import MILLIMETERS
from synpick_warp.exporters.writing.notes import describe_lenses, describe_sizes
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.assets.appearance import decode_texture, tint
from synpick_warp.scenes.assets.asset_files import MissingFileError
from synpick_warp.scenes.assets.models_info import corrected_entry, read_entries
from synpick_warp.scenes.assets.ply import read_ply_file, read_ply_texture
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry
from synpick_warp.system.inputs.files import make_folder, path_inside
from synpick_warp.system.inputs.image_files import TEXTURE_KINDS
from synpick_warp.views.layer_codec import layer_notes

MODEL_FOLDERS = ("models", "models_eval")
"""The toolkit renders the first and evaluates with the second; ours are equal."""


def write_models(folder: Path, catalog: Catalog, mechanics: bool = False) -> None:
    """Write every object's PLY file and texture, and models_info.json, with the keys of `make_mechanics` if `mechanics`, in place of a
    folder that there may be.

    Models loaded from BOP models are copied byte for byte, and their entries as they are, if these have the sizes of the meshes. Raises
    CatalogError if a model file or its texture is not what was read for the catalog.
    """
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir()
    infos = {}
    for entry in catalog.entries:
        path = folder / f"obj_{entry.obj_id:06d}.ply"
        if entry.source is None:
            path.write_bytes(encode_model(entry))
            if entry.material.texture is not None:
                path.with_suffix(".png").write_bytes(encode_png(tint(entry.material.texture, entry.material.color)))
        else:
            _copy_model(entry, entry.source, path)
        known = read_entries(entry.source.parent / "models_info.json") if entry.source else None
        info = corrected_entry((known or {}).get(str(entry.obj_id)), make_model_info(entry))
        infos[str(entry.obj_id)] = info | make_mechanics(entry) if mechanics else info
    (folder / "models_info.json").write_text(json.dumps(infos, indent=2) + "\n", encoding="ascii")


def encode_model(entry: CatalogEntry) -> bytes:
    """Encode an object as binary PLY in millimetres, with the property types that the BOP toolkit reads.

    Of a textured object with texture coordinates and the name of the texture, obj_ID.png; else with the material's colour at every vertex.
    """
    mesh, textured = entry.mesh, entry.material.texture is not None
    names = ["x", "y", "z", "nx", "ny", "nz", *(("texture_u", "texture_v") if textured else ())]
    fields: list[tuple[str, str]] = [(name, "<f4") for name in names]
    properties = [f"property float {name}" for name in names]
    if not textured:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), np.dtype(fields))
    columns = np.concatenate((MILLIMETERS * mesh.vertices.astype(np.float64), mesh.normals, mesh.uv), axis=1)
    for index, name in enumerate(names):
        vertices[name] = columns[:, index]
    if not textured:
        for name, value in zip(("red", "green", "blue"), entry.material.color, strict=True):
            vertices[name] = round(255 * value)
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("indices", "<i4", 3)]))
    faces["count"], faces["indices"] = 3, mesh.faces
    header = (
        "ply",
        "format binary_little_endian 1.0",
        f"comment {entry.name}, millimetres",
        *((f"comment TextureFile obj_{entry.obj_id:06d}.png",) if textured else ()),
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    )
    return "".join(line + "\n" for line in header).encode() + vertices.tobytes() + faces.tobytes()


def make_model_info(entry: CatalogEntry) -> dict[str, Any]:
    """Entry of an object in models_info.json [mm]."""
    low, high = (MILLIMETERS * extremum(entry.mesh.vertices.astype(np.float64), axis=0) for extremum in (np.min, np.max))
    info: dict[str, Any] = {"diameter": MILLIMETERS * entry.diameter}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    if entry.symmetries_discrete:
        info["symmetries_discrete"] = [
            # Row-major 4 x 4 matrices, of which the translation is a length.
            [MILLIMETERS * value if index in (3, 7, 11) else value for index, value in enumerate(matrix)]
            for matrix in entry.symmetries_discrete
        ]
    if entry.symmetries_continuous:
        info["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [MILLIMETERS * value for value in offset]} for axis, offset in entry.symmetries_continuous
        ]
    return info


def make_mechanics(entry: CatalogEntry) -> dict[str, Any]:
    """Keys of an object in models_info.json for manipulation: mass [kg], centre of mass [mm], inertia about it (row by row) [kg·mm²], and
    the area on which a suction cup seals [mm²], with its fraction of the surface, if measured."""
    center, inertia = MILLIMETERS * entry.center_of_mass, MILLIMETERS**2 * entry.inertia
    info: dict[str, Any] = {"mass": entry.mass, "center_of_mass": center.tolist(), "inertia": inertia.ravel().tolist()}
    if entry.suctionable is not None:
        area, fraction = entry.suctionable
        info |= {"suctionable_area": MILLIMETERS**2 * area, "suctionable_fraction": fraction}
    return info


def _copy_model(entry: CatalogEntry, source: Path, path: Path) -> None:
    """Copy a PLY file, and the texture that its header names, under the same name inside the set; without that texture, write the object.

    Raises CatalogError if the texture has changed or gone since it was read, or its name is not allowed or that of another file of the set.
    """
    data = read_ply_file(source)
    try:
        found = read_ply_texture(data, source)
    except MissingFileError:
        if entry.material.texture is not None:
            raise
        path.write_bytes(encode_model(entry))  # The copy would name a texture that is not there.
        return
    if found is not None:
        name, image = found
        if not np.array_equal(decode_texture(image, str(source.parent / name)), np.asarray(entry.material.texture)):
            raise CatalogError(f"{source}: its texture {name} changed since it was read; start again")
        target = path_inside(path.parent, name, source, CatalogError)
        if target.suffix[1:].lower() not in TEXTURE_KINDS or any(part.startswith(".") for part in Path(name).parts):
            kinds = ", .".join(TEXTURE_KINDS)
            raise CatalogError(f"{source} names the texture {name}; allowed: names without leading dots that end in .{kinds}; rename it")
        if target.exists() and target.read_bytes() != image:
            raise CatalogError(f"{source} names the texture {name}, but the set has another file of that name; rename it")
        make_folder(target.parent)
        target.write_bytes(image)
    path.write_bytes(data)


def describe_dataset(settings: ExportSettings, catalog: Catalog, cameras: tuple[Camera, ...]) -> str:
    """Text of dataset_info.md: conventions of the ground truth, and the objects."""
    layout, period = settings.layout, settings.physics.tick_time
    objects = "\n".join(f"| {entry.obj_id} | {entry.name} | {entry.mass:g} |" for entry in catalog.entries)
    pictures = describe_sizes(layout, cameras)
    folders = ", ".join(f"`{split.folder}/` (k from {split.first} on)" for split in layout.splits) or f"`{layout.split}/`"
    scenes = f"Camera c of episode k is scene {layout.cameras} · k + c"
    if layout.has_sensors:
        sensors = layout.sensors
        names = f"{sensors[0]} to {sensors[-1]}" if sensors[0] == "cam0" else ", ".join(sensors)
        scenes = f"Episode k is scene k, with files of the sensors {names},"
    return f"""# A SynPick data set
{describe_lenses(settings)}
Made by synpick-warp (mode {", ".join(settings.modes)}, seed {settings.bake.seed}, {layout.cameras} cameras), in the format of the
BOP challenge (scenewise). {scenes} of {folders}. Frames are {period:g} s apart.

- Lengths are in millimetres. A depth image's count times `depth_scale` ({settings.bop.depth_scale:g}) is the planar depth, along the
  optical axis; 0: no surface.
- Pictures have {pictures}. The centre of pixel (row, column) is (column + 0.5, row + 0.5): for OpenCV and
  Open3D, whose pixel centres have whole coordinates, subtract 0.5 from cx and cy. Cameras have x right, y down, z forward.
- `cam_R_w2c` and `cam_t_w2c` lead from the {settings.bins[0].noun}'s frame (centre of its inner floor, z up) to the camera.
- `light` in scene_camera.json describes the episode's light: the map's name, its yaw [rad], the exposure relative to the automatic
  one [EV], and the direction to the sun or lamp that casts shadows, in the {settings.bins[0].noun}'s frame; null if none is dominant.
  `effects`, if present, has the parameters of the camera effects on colour; `config.toml` has the ranges from which they were sampled.
- `instance_id` in scene_gt.json is an object's number for the whole episode, the same for all cameras; a gt_id is only the position
  in an image's list.
- `mask_visib` is exact: what the ray through the pixel's centre meets first. The masks of an image do not overlap.
- `px_count_all` and `bbox_obj` count what lies outside of the picture too, up to one picture's size beyond each border.
{layer_notes(settings.render.layers)}- `models_eval/` equals `models/`.

| obj_id | name | mass [kg] |
|---|---|---|
{objects}
{describe_toolkit(layout)}"""
