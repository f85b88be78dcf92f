"""Models folders as subjects of rules, and rules about them: PLY dialect, geometry against models_info.json, symmetries."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, KDTree, QhullError
from trimesh.transformations import rotation_matrix

from synpick_warp.apps.validation.registry import Findings, Level, rule
from synpick_warp.apps.validation.scene_files import convert
from synpick_warp.dataset.annotations import ModelInfo
from synpick_warp.dataset.bop.layout import MODEL_FILE, Listing
from synpick_warp.errors import CatalogError, DatasetError
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import MAX_INFO, ROTATION_TOLERANCE, is_rigid
from synpick_warp.scenes.assets.ply import MAX_HEADER, read_ply_vertices
from synpick_warp.scenes.types import TriangleMesh
from synpick_warp.system.inputs.files import decode_json
from synpick_warp.system.random_numbers import sample_triangles

_CHUNK = 512
"""Points whose distances to all others are computed at a time."""
_MILLIMETRE = 1e-3


@dataclass(frozen=True, eq=False)
class ModelsFolder:
    """Folder of models, such as models, models_eval or models_cad, with its models_info.json."""

    listing: Listing

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return self.listing.place

    @cached_property
    def files(self) -> dict[int, str]:
        """Names of the PLY files by obj_id."""
        return {int(match[1]): match[0] for name in sorted(self.listing.files) if (match := MODEL_FILE.fullmatch(name))}

    @cached_property
    def info(self) -> tuple[dict[str, Any], str]:
        """(entries of models_info.json, not checked; fault of the file, empty: none)."""
        if "models_info.json" not in self.listing.files:
            return {}, ""
        try:
            data = self.listing.read("models_info.json", MAX_INFO)
            return decode_json(data, dict[str, Any], self.listing.name("models_info.json"), DatasetError), ""
        except DatasetError as error:
            return {}, str(error)


@dataclass(frozen=True, eq=False)
class ModelSubject:
    """Subject of rules about a model: its mesh, and its entry in models_info.json."""

    folder: ModelsFolder
    obj_id: int

    @property
    def place(self) -> str:
        """Path of the PLY file relative to the data set."""
        return self.folder.listing.name(self.folder.files[self.obj_id])

    @property
    def info_file(self) -> str:
        """Path of models_info.json relative to the data set."""
        return self.folder.listing.name("models_info.json")

    @cached_property
    def entry(self) -> tuple[ModelInfo | None, str]:
        """(entry of models_info.json, fault): None and the reason if it is missing or damaged; None and no reason without that file."""
        found = self.folder.info[0].get(str(self.obj_id))
        if found is None:
            return None, "no entry" if self.folder.info[0] else ""
        try:
            return convert(found, ModelInfo), ""
        except ValueError as fault:
            return None, str(fault)

    @cached_property
    def header(self) -> list[str]:
        """Lines of the PLY file's header."""
        data = self.folder.listing.read(self.folder.files[self.obj_id], MAX_MESH_FILE)[:MAX_HEADER]
        head, _, _ = data.partition(b"end_header")
        return [line.strip() for line in head.decode("utf-8", "replace").splitlines()]

    @cached_property
    def mesh(self) -> tuple[TriangleMesh | None, str]:
        """(triangle mesh [m], fault): None and the reason if it cannot be read, else the mesh and an empty text."""
        try:
            return read_mesh(self.folder.listing.path(self.folder.files[self.obj_id]), _MILLIMETRE)[0], ""
        except CatalogError as error:
            return None, str(error)

    @cached_property
    def vertices(self) -> np.ndarray | None:
        """Vertices of the file (V, 3) float64 [mm]; None: they cannot be read."""
        try:
            return read_ply_vertices(self.folder.listing.path(self.folder.files[self.obj_id]))
        except CatalogError:
            return None


def diameter(points: np.ndarray) -> float:
    """Largest distance between two points (V, 3): between two corners of the convex hull."""
    points = np.unique(points, axis=0)
    if len(points) > _CHUNK:
        try:
            points = points[ConvexHull(points).vertices]
        except QhullError:  # Points in a plane.
            points = points[:: max(1, len(points) // (8 * _CHUNK))]
    squared = (points**2).sum(axis=1)
    parts = (points[start : start + _CHUNK] for start in range(0, len(points), _CHUNK))
    largest = max(float(((part**2).sum(axis=1)[:, None] + squared - 2.0 * part @ points.T).max()) for part in parts)
    return float(np.sqrt(max(largest, 0.0)))


def sample_area(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Sample points of a surface (N, 3), evenly by area; see `sample_triangles`."""
    corners = vertices[faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face, weights = sample_triangles(area, count)
    return np.einsum("sk,skc->sc", weights, corners[face])


LENGTH_TOLERANCE = 1e-3
"""Largest error of diameter, minimum and size, as a fraction of the diameter; published values have 0.1 % of a small object."""
SYMMETRY_DISTANCE, SYMMETRY_FRACTION = 15.0, 0.1
"""Largest distance of a surface from itself after a symmetry: BOP's max(15 mm, 0.1 diameters) (Hodaň et al., BOP Challenge 2020)."""
SAMPLES, PROBES = 20_000, 500
"""Points of the surface, and those that are moved."""
ANGLES = (0.7, 1.9, 3.3)
"""Angles by which continuous symmetries are tried [rad]."""
TINY = 3.0
"""Diameter of a model that looks like metres [mm]: BOP's smallest object has 24 mm, and 3 m is larger than any."""
_NUMBERS = {"float", "double", "int", "uint", "uchar"}
"""Types that the toolkit's reader knows in binary files."""
_VERTEX = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "texture_u", "texture_v"}


@rule(ModelsFolder, "model-files", "name models by obj_id with six digits; calc_model_info.py makes models_info.json")
def check_files(folder: ModelsFolder) -> Findings:
    """A models folder has models obj_NNNNNN.ply, and models_info.json has an entry for each of them and for no others."""
    for name in sorted(folder.listing.files):
        if name.lower().endswith(".ply") and not MODEL_FILE.fullmatch(name):
            yield folder.listing.name(name), "a model whose name is not obj_NNNNNN.ply"
    for name in (*folder.listing.outside, *folder.listing.special):
        yield folder.listing.name(name), "leads out of the data set, or is no regular file; it is not read"
    entries, fault = folder.info
    if fault:
        yield folder.listing.name("models_info.json"), fault
    for key in sorted(set(entries) - set(map(str, folder.files))):
        yield folder.listing.name("models_info.json"), f'entry "{key[:40]}" has no model'


@rule(
    ModelSubject,
    "model-dialect",
    "export with float, double, int, uint, uchar and vertex_indices; texture_u, texture_v for texture coordinates",
)
def check_dialect(model: ModelSubject) -> Findings:
    """PLY files are ascii or binary_little_endian, of triangles, with the property names and types that the toolkit's reader knows."""
    element = ""
    for line in model.header:
        words = line.split()
        if words[:1] == ["format"] and words[1:2] not in (["ascii"], ["binary_little_endian"]):
            yield model.place, f"format {' '.join(words[1:2])}; the toolkit reads bytes in the machine's own order"
        elif words[:1] == ["element"]:
            element = " ".join(words[1:2])
        elif words[:1] == ["property"]:
            kinds, name = (words[2:4] if words[1:2] == ["list"] else words[1:2]), words[-1]
            unknown = sorted(set(kinds) - _NUMBERS)
            if unknown and model.header[1:2] != ["format ascii 1.0"]:
                yield model.place, f"property {name} of type {unknown[0][:40]}; known: {', '.join(sorted(_NUMBERS))}"
            if element == "vertex" and name not in _VERTEX:
                yield model.place, f"vertex property {name[:40]!a}, which the toolkit does not know"
            if element == "face" and words[1:2] == ["list"] and name not in ("vertex_indices", "vertex_index", "texcoord"):
                yield model.place, f"face property {name[:40]!a}; expected: vertex_indices"


@rule(ModelSubject, "model-mesh", "repair or restore the mesh")
def check_mesh(model: ModelSubject) -> Findings:
    """A model can be read: triangles whose vertices exist, finite numbers, and its texture is there."""
    if model.mesh[0] is None:
        yield model.place, model.mesh[1]


@rule(ModelSubject, "model-units", "multiply the vertices by 1000 if they are in metres")
def check_units(model: ModelSubject) -> Findings:
    """Models are in millimetres."""
    if model.vertices is not None and (size := diameter(model.vertices)) < TINY:
        yield model.place, f"the diameter is {size:.3g} mm; it looks like metres"


@rule(ModelSubject, "model-entry", "make it again with calc_model_info.py, and add the symmetries by hand")
def check_entry(model: ModelSubject) -> Findings:
    """An entry of models_info.json has diameter, min_x to min_z, size_x to size_z, and symmetries as 16 numbers, or axis and offset."""
    if model.entry[1]:
        yield model.info_file, f"object {model.obj_id}: {model.entry[1]}"


@rule(ModelSubject, "model-diameter", "compute it from the model's vertices (calc_model_info.py)")
def check_diameter(model: ModelSubject) -> Findings:
    """diameter is the largest distance between two vertices [mm]."""
    entry = model.entry[0]
    if entry is not None and model.vertices is not None:
        expected = diameter(model.vertices)
        if abs(entry.diameter - expected) > LENGTH_TOLERANCE * expected:
            hint = "; it looks like metres" if abs(1e3 * entry.diameter - expected) < 0.01 * expected else ""
            yield model.info_file, f"object {model.obj_id}: diameter is {entry.diameter:g} mm, that of the mesh {expected:.6g}{hint}"


@rule(ModelSubject, "model-box", "compute them from the model's vertices (calc_model_info.py)")
def check_box(model: ModelSubject) -> Findings:
    """min_x, min_y, min_z and size_x, size_y, size_z are the bounding box of the vertices [mm]."""
    entry = model.entry[0]
    if entry is None or model.vertices is None:
        return
    lower, size = model.vertices.min(axis=0), np.ptp(model.vertices, axis=0)
    slack = LENGTH_TOLERANCE * max(float(np.linalg.norm(size)), 1e-9)
    for axis, name in enumerate("xyz"):
        for kind, expected in (("min", lower[axis]), ("size", size[axis])):
            stated = getattr(entry, f"{kind}_{name}")
            if abs(stated - expected) > slack:
                yield model.info_file, f"object {model.obj_id}: {kind}_{name} is {stated:g} mm, that of the mesh {expected:.6g}"


@rule(
    ModelSubject,
    "model-origin",
    "bake with objects.center = true, or move the mesh, and all poses with it; tools that crop by the origin and the diameter expect it",
    level=Level.WARNING,
)
def check_origin(model: ModelSubject) -> Findings:
    """The origin of a model is the centre of its bounding box."""
    if model.vertices is not None:
        center = (model.vertices.min(axis=0) + model.vertices.max(axis=0)) / 2.0
        off, size = float(np.linalg.norm(center)), float(np.linalg.norm(np.ptp(model.vertices, axis=0)))
        if off > 0.1 * size:
            yield model.place, f"the box's centre is {off:.4g} mm from the origin"


@rule(ModelSubject, "symmetry-identity", "remove the identity")
def check_identity(model: ModelSubject) -> Findings:
    """symmetries_discrete does not list the identity: the toolkit adds it."""
    for index, matrix in _discrete(model):
        if np.abs(matrix - np.eye(4)).max() <= ROTATION_TOLERANCE:
            yield model.info_file, f"object {model.obj_id}: symmetries_discrete[{index}] is the identity"


@rule(ModelSubject, "symmetry-rigid", "write a proper 4 x 4 matrix; mirror images are no symmetries")
def check_rigid(model: ModelSubject) -> Findings:
    """Symmetries are rigid: a rotation and a translation [mm], row by row; axes are not 0."""
    for index, matrix in _discrete(model):
        if not is_rigid(matrix):
            hint = "; it looks column by column" if np.abs(matrix[3, :3]).max() > 0.0 and not matrix[:3, 3].any() else ""
            yield model.info_file, f"object {model.obj_id}: symmetries_discrete[{index}] is not rigid{hint}"
    for index, (axis, _) in _continuous(model):
        if not np.linalg.norm(axis) > 0.0:
            yield model.info_file, f"object {model.obj_id}: symmetries_continuous[{index}].axis is 0"


@rule(ModelSubject, "symmetry-maps", "remove the symmetry, or correct its axis, offset or translation")
def check_symmetries(model: ModelSubject) -> Findings:
    """Symmetries map the model onto itself: no point moves away from the surface by more than 15 mm and a tenth of the diameter."""
    transforms = [(f"symmetries_discrete[{index}]", matrix) for index, matrix in _discrete(model) if is_rigid(matrix)]
    for index, (axis, offset) in _continuous(model):
        if np.linalg.norm(axis) > 0.0:
            transforms += [(f"symmetries_continuous[{index}]", np.asarray(rotation_matrix(angle, axis, offset))) for angle in ANGLES]
    mesh = model.mesh[0]
    if not transforms or mesh is None:
        return
    points = 1e3 * sample_area(mesh.vertices, mesh.faces, SAMPLES)
    tree, probes = KDTree(points), points[:PROBES]
    bound = max(SYMMETRY_DISTANCE, SYMMETRY_FRACTION * float(np.linalg.norm(np.ptp(points, axis=0))))
    farthest: dict[str, float] = {}
    for name, matrix in transforms:
        distance = float(tree.query(probes @ matrix[:3, :3].T + matrix[:3, 3])[0].max())
        farthest[name] = max(farthest.get(name, 0.0), distance)
    for name, distance in farthest.items():
        if distance > bound:
            yield model.info_file, f"object {model.obj_id}: {name} moves a point {distance:.3g} mm off the surface; allowed: {bound:.3g} mm"


def _discrete(model: ModelSubject) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (index, 4 x 4 matrix) of each discrete symmetry; nothing if the entry is damaged."""
    entry = model.entry[0]
    if entry is not None and isinstance(entry.symmetries_discrete, list):
        yield from ((index, np.reshape(np.array(values, np.float64), (4, 4))) for index, values in enumerate(entry.symmetries_discrete))


def _continuous(model: ModelSubject) -> Iterator[tuple[int, tuple[list[float], list[float]]]]:
    """Yield (index, (axis, offset)) of each continuous symmetry; nothing if the entry is damaged."""
    entry = model.entry[0]
    if entry is not None and isinstance(entry.symmetries_continuous, list):
        yield from ((index, (item.axis, item.offset)) for index, item in enumerate(entry.symmetries_continuous))
