"""Layouts of model folders: which mesh files of a folder are its objects, with obj_ids and names.

Three layouts: BOP's (obj_NNNNNN.ply), meshes side by side, and a folder per object, as Google Scanned Objects (Downs et al., ICRA 2022) and
YCB (Calli et al., 2015) have.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import check_file_name, list_names
from synpick_warp.scenes.assets.meshes import STEP_SUFFIXES, SUFFIXES
from synpick_warp.scenes.assets.models_info import bop_obj_id

MAX_DEPTH = 3
"""Depth to which an object's folder is searched for its mesh."""
MAX_ENTRIES = 4096
"""Maximum entries of an object's folder that are looked at."""
MAX_OBJECTS = 4096
"""Maximum objects of a model folder."""
# Of several meshes in an object's folder, textured ones are preferred, by what their names begin with; then GLB, whose material is richest.
_PREFERRED = ("textured", "model", "mesh", "visual")
_FORMATS = (".glb", ".gltf", ".obj", ".ply", ".stl", *STEP_SUFFIXES)
_READ = "PLY, OBJ, glTF, STL or STEP files"
_UNREAD = """
    3dm 3ds 3mf abc ac amf ase asm blend brep brp c4d catpart catproduct ctm dae drc dwg dxf e57 f3d fbx fcstd iam ifc iges
    igs inp ipt jt las laz lwo lxo ma max mb mesh msh nas off par pcd prt psm sab sat sdf skp sldasm sldprt spz stpz u3d
    urdf usd usda usdc usdz vrm vrml vtk vtp vtu wrl x x3d x3db x3dv x_b x_t xacro xyz zae ztl
"""
"""Endings of files of geometry that are not read."""

Say = Callable[[str], None]
Fault = Callable[[CatalogError], None]


@dataclass(frozen=True)
class ModelFile:
    """Mesh file of an object: obj_id, name, folder that its references must not leave, and whether it is a BOP model (in millimetres)."""

    obj_id: int
    path: Path
    name: str
    """By which rows of the object table are found: the file's name without suffix, or that of the object's folder."""
    root: Path
    """Folder that names in the file must not lead out of."""
    is_bop: bool
    """In millimetres, with an entry in models_info.json."""


def list_models(folder: Path, report: Say, fault: Fault) -> list[ModelFile]:
    """List the objects of a model folder. `report`: called with each line on what is ignored. `fault`: called with the error of each object
    that cannot be used; it may raise it. Raises CatalogError: the folder is missing, cannot be listed or contains no models."""
    if not folder.is_dir():
        raise CatalogError(f"models folder {folder}: no such folder; give one of BOP models, or of {_READ}; {PATH_RULE}")
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
        files = _without_sources([entry for entry in entries if entry.suffix.lower() in SUFFIXES], report)
        unread = [entry for entry in entries if _is_unread(entry.name)]
        found = [] if files else _in_subfolders(entries, unread, report)
    except OSError as error:
        raise CatalogError(f"models folder {folder}: cannot be listed ({error.strerror})") from error
    names = list_names(ascii(str(path.relative_to(folder)))[1:-1] for path in unread)
    said = f"of a format that is not read: {names}; save them as {_READ}"
    if not files and not found:
        raise CatalogError(f"models folder {folder}: {said if unread else f'it contains no models; add obj_NNNNNN.ply, or {_READ}'}")
    if unread:
        report(f"models folder {folder}: {said}")
    if max(len(files), len(found)) > MAX_OBJECTS:
        raise CatalogError(f"models folder {folder}: more than {MAX_OBJECTS} meshes; bake a part of them")
    models, faults = _list_bop(files, folder, report)
    if not models and not faults:
        models, faults = _list_own(files, found, folder)
    for error in faults:
        fault(error)
    return models


def _without_sources(files: list[Path], report: Say) -> list[Path]:
    """Files without the STEP files beside which their own tessellation lies."""
    meshes = {file.stem for file in files if file.suffix.lower() not in STEP_SUFFIXES}
    sources = {file for file in files if file.suffix.lower() in STEP_SUFFIXES and file.stem in meshes}
    if sources:
        report(f"{min(sources).parent}: {len(sources)} STEP files beside meshes of the same name are ignored")
    return [file for file in files if file not in sources]


def _list_bop(files: list[Path], folder: Path, report: Say) -> tuple[list[ModelFile], list[CatalogError]]:
    """The BOP models among files, by obj_id, and the errors of those that cannot be used; nothing if there are none."""
    models: dict[int, ModelFile] = {}
    faults: list[CatalogError] = []
    others = 0
    for file in files:
        try:
            obj_id = bop_obj_id(file)
            if obj_id is None:
                others += 1
                continue
            check_file_name(file, CatalogError)
            if obj_id in models:
                raise CatalogError(f"{models[obj_id].path} and {file.name} are both object {obj_id}; the first is used, keep one of them")
            models[obj_id] = ModelFile(obj_id, file, file.stem, folder, True)
        except CatalogError as error:
            faults.append(error)
    if others and (models or faults):
        report(f"models folder {folder}: {others} meshes that are not named obj_NNNNNN.ply are ignored")
    return [models[obj_id] for obj_id in sorted(models)], faults


def _list_own(files: list[Path], found: list[tuple[Path, Path]], folder: Path) -> tuple[list[ModelFile], list[CatalogError]]:
    """Meshes that are not BOP models, and the errors of those that cannot be used. Their obj_ids are positions, also of unusable ones.
    `files`: meshes side by side. `found`: folder of an object, and its mesh."""
    models: list[ModelFile] = []
    faults: list[CatalogError] = []
    names: dict[str, Path] = {}
    for obj_id, (place, path) in enumerate([*((folder, file) for file in files), *found], 1):
        name = path.stem if place == folder else place.name
        try:
            check_file_name(place if place != folder else path, CatalogError)
            check_file_name(path, CatalogError)
            if name in names:
                said = f"{names[name].name} and {path.name} have the same name; the first is used, keep one of them"
                raise CatalogError(f"models folder {folder}: {said}")
            names[name] = path
            models.append(ModelFile(obj_id, path, name, place, False))
        except CatalogError as error:
            faults.append(error)
    return models, faults


def _is_unread(name: str) -> bool:
    """Whether a file's name is that of geometry in a format that is not read."""
    return Path(name.lower()).suffix[1:] in _UNREAD.split()


def _in_subfolders(entries: list[Path], unread: list[Path], report: Say) -> list[tuple[Path, Path]]:
    """Folder and mesh of each object that has a folder of its own; files of formats that are not read are added to `unread`."""
    found = []
    for place in entries:
        if place.is_dir() and (meshes := _meshes_below(place, unread)):
            bop = next((mesh for mesh in meshes if bop_obj_id(mesh) is not None), None)
            if bop is not None:
                raise CatalogError(f"models folder {place.parent}: its folder {bop.parent.name} has BOP models; give {bop.parent}")
            found.append((place, meshes[0]))
            if len(meshes) > 1:
                report(f"{place}: {len(meshes)} meshes, of which {meshes[0].relative_to(place)} is read")
    return found


def _meshes_below(place: Path, unread: list[Path]) -> list[Path]:
    """The meshes in an object's folder and its subfolders, the preferred one first. Links to folders are not followed.

    Without any, files of formats that are not read are added to `unread`.
    """
    others: list[Path] = []
    meshes: list[Path] = []
    seen = 0
    for root, folders, files in os.walk(place):
        depth = len(Path(root).relative_to(place).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".")) if depth < MAX_DEPTH else []
        seen += len(files) + len(folders)
        meshes += [Path(root, name) for name in sorted(files) if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")]
        others += [Path(root, name) for name in sorted(files) if _is_unread(name)]
        if seen > MAX_ENTRIES:
            break
    unread += [] if meshes else others
    return sorted(meshes, key=lambda path: _preference(path, place))


def _preference(path: Path, place: Path) -> tuple[int, int, int, str]:
    """Sort key of a mesh in an object's folder: preferred names, then formats, then fewer folders between."""
    stem = path.stem.lower()
    rank = next((rank for rank, start in enumerate(_PREFERRED) if stem.startswith(start)), len(_PREFERRED))
    if stem == place.name.lower():
        rank = 1
    return rank, _FORMATS.index(path.suffix.lower()), len(path.parts), str(path)
