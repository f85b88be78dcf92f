"""Mesh import: PLY, OBJ, glTF, STL and STEP files, each as one triangle mesh with one material.

Surfaces of STEP (ISO 10303-21) are tessellated by OpenCASCADE through cascadio, which is optional, and read as the GLB that it makes.
"""

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from synpick_warp.configs.episodes.objects import UNITS
from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import CatalogError, ConfigError, SynpickError
from synpick_warp.scenes.assets import appearance
from synpick_warp.scenes.assets.appearance import NO_MATERIAL
from synpick_warp.scenes.assets.asset_files import (
    MAX_MESH_FILE,
    MAX_ROWS,
    MAX_TEXT_MESH,
    Notes,
    decode_text,
    ignore,
    quiet_decoding,
    reading_as,
)
from synpick_warp.scenes.assets.gltf.parts import read_gltf
from synpick_warp.scenes.assets.mesh_parts import MeshPart, check_indices
from synpick_warp.scenes.assets.normals import DEFAULT_CREASE, crease_normals, smooth_normals
from synpick_warp.scenes.assets.ply import read_ply
from synpick_warp.scenes.assets.wavefront import read_obj
from synpick_warp.scenes.types import BLACK, OPAQUE, TriangleMesh
from synpick_warp.system.inputs.files import read_file
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

_HEADER = 84
"""Bytes before the triangles of a binary STL file."""
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path, notes: Notes) -> list[MeshPart]:
    """Read an STL file, of all its solids together. Equal corners become one vertex; the triangles' own normals are not used, since they
    are often wrong. Raises CatalogError: the file cannot be read, or is too large."""
    data = read_file(path, MAX_MESH_FILE, CatalogError)
    count, (held, rest) = int.from_bytes(data[80:_HEADER], "little"), divmod(len(data) - _HEADER, _TRIANGLE.itemsize)
    # Binary files may begin with "solid" as well, and text with any word.
    if (count, 0) != (held, rest) and "\0" not in decode_text(data[: _HEADER + _TRIANGLE.itemsize]):
        if len(data) > MAX_TEXT_MESH:
            raise CatalogError(f"{path}: too large for a text file; save it as binary STL")
        with reading_as("STL", path, data):
            corners = np.array(_VERTEX.findall(decode_text(data)), np.float64).reshape(-1, 3, 3)
    elif held < count:
        raise CatalogError(f"{path}: not readable as STL (its header announces {count} triangles, its body holds {max(held, 0)})")
    else:
        if held > count or rest:  # Programs that write triangles as they come leave the number in the header at 0.
            announced, count = count, count if count and rest else held
            notes.said.append(f"its header announces {announced} triangles, its body holds {held}: {count} are read")
        triangles = np.frombuffer(data, _TRIANGLE, count, _HEADER)
        notes.ignored += ["colours or other attributes of triangles"] if np.any(triangles["attribute"]) else []
        corners = triangles["corners"].astype(np.float64)
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return [MeshPart(vertices, index.reshape(-1, 3).astype(np.int64), None, None, None, NO_MATERIAL)]


STEP_SUFFIXES = (".step", ".stp")
"""Endings of STEP files; lengths are in the unit that each names itself, and come out in metres."""
# Largest distance of a chord from its curve [mm] and angle between two chords [rad]: below what a depth camera resolves, while a drilled
# plate stays at some thousand triangles.
_CHORD, _ANGLE = 0.05, 0.3


def read_step(path: Path, notes: Notes) -> list[MeshPart]:
    """Read a STEP file, all of its bodies, in metres. Raises CatalogError: cascadio is not installed, or the file cannot be read."""
    data = read_file(path, MAX_TEXT_MESH, CatalogError)
    try:
        cascadio: Any = importlib.import_module("cascadio")
    except ImportError:
        advice = "pip install 'synpick-warp[step]', or save it as STL or GLB"
        raise CatalogError(f"{path}: STEP files need cascadio, which is not installed: {advice}") from None
    with reading_as("STEP", path):
        glb = cascadio.load(data, file_type="step", tol_linear=_CHORD, tol_angular=_ANGLE, use_parallel=False)
    if not glb:
        raise CatalogError(
            f"{path}: not readable as STEP (OpenCASCADE refuses it); export it again as AP203, AP214 or AP242, or save it as STL"
        )
    return read_gltf(path, notes, glb)


_READERS: dict[str, Callable[[Path, Notes], list[MeshPart]]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": read_stl,
    **dict.fromkeys(STEP_SUFFIXES, read_step),
}
SUFFIXES = tuple(_READERS)
"""Endings of mesh files."""

# Maximum coordinate [m]: larger ones are mistakes, and lose precision in 32-bit floats.
_MAX_EXTENT = 1e4
_MILLIMETRE = 1e-3
MAX_CELL_FACES = 200_000
"""Triangles of the mesh of a bin or a tool: more take minutes, and slow every picture."""
CELL_LIMITS = Limits(600.0, 2**33)
"""Limits of reading it."""
_FAINT = 0.5 / 255.0 / 12.92
"""Emission, as a fraction of the largest of an object, that 8-bit sRGB rounds to 0."""
# Maximum texture coordinate: larger ones are mistakes, with a resolution of a thousandth of the image in 32-bit floats.
_MAX_UV = 1e4


@dataclass(frozen=True)
class MeshOptions:
    """Options by which meshes are completed: crease angle [°] of missing normals, centring, replacement of missing images."""

    crease_angle: float = DEFAULT_CREASE
    """Largest angle between two triangles that are smooth at a common vertex, in meshes without normals [°]."""
    center: bool = False
    """Move the centre of the mesh's bounding box to the origin."""
    substitute: bool = False
    """Replace images that are not there by a colour, with a warning."""
    unit: str = ""
    """Name of the unit, which is reported with the mesh's size; empty: neither is reported."""


class MeshFile(NamedTuple):
    """Mesh [m] and material of a mesh file, and by what the mesh was moved to be centred (3) [m]."""

    mesh: TriangleMesh
    material: appearance.FileMaterial
    moved: np.ndarray


def read_mesh(path: Path, unit: float, options: MeshOptions = MeshOptions(), report: Callable[[str], None] = ignore) -> MeshFile:
    """Read a mesh file. Parts are merged into one mesh, several materials into a texture atlas; vertex colours are baked into a texture.
    `path`: a .ply, .obj, .glb, .gltf, .stl, .step or .stp file. `unit`: length of the file's unit [m]; STEP files name their own. `report`:
    called with one line if features of the file are ignored or replaced. Raises CatalogError: the file cannot be read, has no triangles or
    invalid ones, or refers to a texture that is missing and is not replaced."""
    notes = Notes(options.substitute)
    if path.suffix.lower() in STEP_SUFFIXES:
        unit, options = 1.0, replace(options, unit=options.unit and "of the file")
    with quiet_decoding():
        parts = [_clean(part, unit, path) for part in _READERS[path.suffix.lower()](path, notes) if len(part.faces)]
        parts = [part for part in parts if len(part.faces)]
        if not parts:
            raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
        found = _finish(_join([_bake_colors(part, notes) for part in parts], path, options, notes), unit, options, notes)
    line = notes.line(path)
    if line is not None:
        report(line)
    return found


def read_measured(function: Callable[[Any], Any], settings: Any, file: str, owner: str) -> Any:
    """What `function(settings)` reads of a mesh file, in an isolated process, or read before in this process unless the file has changed.
    Raises ConfigError: the mesh cannot be used by its `owner`."""
    path = Path(file)
    try:
        stat = path.stat()
    except OSError as error:
        raise ConfigError(f"{owner}: {path} cannot be read ({error.strerror}); {PATH_RULE}") from error
    return _read_measured(function, settings, file, owner, (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=64)
def _read_measured(function: Callable[[Any], Any], settings: Any, file: str, owner: str, stamp: tuple[int, int]) -> Any:
    """As `read_measured`; `stamp`: time of change and size of the file."""
    (found,) = run_isolated(function, [(settings,)], CELL_LIMITS)
    if isinstance(found, Failure):
        raise ConfigError(f"{owner}: the process that reads {file} {found.reason}; repair or simplify the mesh")
    if isinstance(found, SynpickError):
        raise ConfigError(f"{owner}: {found}")
    return found


def read_cell_mesh(
    file: str, unit: str, sides: tuple[float, float], likely: tuple[float, float], key: str, report: Callable[[str], None] = ignore
) -> MeshFile:
    """Read the mesh of a part of the cell: a bin, or a tool's body. `file`, `unit`, `report`: as of `read_mesh`; the unit by its name.
    `sides`, `likely`: least and largest longest side [m], and those by which another unit is proposed, as value of the setting `key`.
    Raises CatalogError: as `read_mesh`; or the file is no mesh, has too many triangles, or is too small or too large."""
    path = Path(file)
    if path.suffix.lower() not in SUFFIXES:
        raise CatalogError(f"{path} is no mesh; allowed: {', '.join(SUFFIXES)}")
    found = read_mesh(path, UNITS[unit], MeshOptions(substitute=True), report)
    if found.material.glass.transmission > 0.0:
        report(f"{path}: ignored: transparency, which objects alone have")
        texture = found.material.texture
        opaque = replace(found.material, glass=OPAQUE, texture=None if texture is None else texture[..., :3])
        found = found._replace(material=opaque)
    if len(found.mesh.faces) > MAX_CELL_FACES:
        raise CatalogError(f"{path} has {len(found.mesh.faces):,} triangles; allowed: {MAX_CELL_FACES:,}; decimate the mesh")
    lengths = np.ptp(found.mesh.vertices.astype(np.float64), axis=0)
    if sides[0] <= lengths.max() <= sides[1]:
        return found
    fitting = [f'"{name}"' for name, size in UNITS.items() if likely[0] <= lengths.max() / UNITS[unit] * size <= likely[1]]
    advice = f"; did you mean {key} = {' or '.join(fitting)}?" if fitting else ""
    shown = " x ".join(f"{side:.4g}" for side in lengths)
    raise CatalogError(f"{file} is {shown} m, unit {unit}; allowed: a longest side of {sides[0]:g} to {sides[1]:g} m{advice}")


def _finish(part: MeshPart, unit: float, options: MeshOptions, notes: Notes) -> MeshFile:
    """Convert a validated part to metres, centre it if asked to, orient it outward and complete its normals."""
    metres = part.vertices * unit
    if options.unit:
        sides = " x ".join(f"{side / _MILLIMETRE:.4g}" for side in np.ptp(metres, axis=0))
        notes.said.append(f"{sides} mm, unit {options.unit}")
    moved = np.zeros(3)
    if options.center:
        offset = -(metres.min(axis=0) + metres.max(axis=0)) / 2.0
        if np.abs(offset).max() > 1e-6 * np.ptp(metres, axis=0).max():
            notes.said.append(f"centred: moved by {', '.join(f'{value:.6g}' for value in offset.round(6) + 0.0)} m")
            metres, moved = metres + offset, offset
    vertices = metres.astype(np.float32)
    faces, given = _orient_outward(vertices, part.faces, part.normals)
    part = complete_normals(replace(part, vertices=vertices, faces=faces, normals=given), options.crease_angle)
    vertices, normals = part.vertices.astype(np.float32), np.asarray(part.normals, np.float32)
    uv = np.zeros((len(vertices), 2), np.float32) if part.uv is None else part.uv.astype(np.float32)
    material = replace(part.material, glass=replace(part.material.glass, thickness=part.material.glass.thickness * unit))
    return MeshFile(TriangleMesh(vertices, part.faces.astype(np.int32), normals, uv), material, moved)


def complete_normals(part: MeshPart, crease_angle: float) -> MeshPart:
    """Make the normals of a part unit vectors; if it has none, compute them with creases, where vertices are split."""
    length = np.zeros((1, 1)) if part.normals is None else np.linalg.norm(part.normals, axis=1, keepdims=True)
    given = np.isfinite(length) & (length > 0.0)
    if part.normals is None or not given.any():
        source, faces, normals = crease_normals(part.vertices, part.faces, crease_angle)
        return part.take(source, faces, normals=normals)
    smooth = part.normals / np.where(given, length, 1.0)
    if not given.all():
        smooth = np.where(given, smooth, smooth_normals(part.vertices, part.faces))
    return replace(part, normals=smooth)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume of a mesh, positive if its triangles face outward.

    About the mean of the triangles' corners, so that small holes matter little, and vertices that are split do not.
    """
    corners = vertices[faces].astype(np.float64)
    corners -= corners.mean(axis=(0, 1))
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def solid_volume(vertices: np.ndarray, faces: np.ndarray) -> float | None:
    """Volume of the solid that a mesh encloses; None: the mesh is open."""
    positions, faces = merge_positions(vertices, faces)
    return signed_volume(positions, faces) if len(faces) and is_watertight(faces) else None


def is_watertight(faces: np.ndarray) -> bool:
    """Whether a mesh is closed: triangles run along each edge equally often in either direction."""
    start, end = faces.reshape(-1), faces[:, (1, 2, 0)].reshape(-1)
    edges, index = np.unique(np.sort(np.stack([start, end], axis=1), axis=1), axis=0, return_inverse=True)
    return not np.bincount(index.reshape(-1), weights=np.where(start < end, 1, -1), minlength=len(edges)).any()


def connected_parts(faces: np.ndarray) -> np.ndarray:
    """Connected component of each vertex (V) int, up to the last one that a triangle has."""
    count = int(faces.max()) + 1
    links = coo_array((np.ones(2 * len(faces)), (faces[:, :2].reshape(-1), faces[:, 1:].reshape(-1))), shape=(count, count))
    return connected_components(links, directed=False)[1]


def merge_positions(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices with equal positions, and drop triangles that degenerate."""
    positions, index = np.unique(vertices, axis=0, return_inverse=True)
    return positions, _drop_degenerate(index[faces])


def _drop_degenerate(faces: np.ndarray) -> np.ndarray:
    """Faces (F, 3) without those that name a vertex twice."""
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _orient_outward(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Flip the triangles of an inside-out mesh, and its normals if they agree with these."""
    if signed_volume(vertices, faces) >= 0.0:
        return faces, normals
    if normals is not None:
        corners = vertices[faces]
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if np.einsum("fi,fci->", doubled, normals[faces]) > 0.0:
            normals = -normals
    return faces[:, ::-1], normals


def _clean(part: MeshPart, unit: float, path: Path) -> MeshPart:
    """Part without degenerate triangles and unused vertices, still in its own unit (`unit` metres); raises CatalogError if invalid."""
    if not np.isfinite(part.vertices).all():
        raise CatalogError(f"{path}: {int((~np.isfinite(part.vertices)).any(axis=1).sum())} vertices are not finite; repair the mesh")
    check_indices(part.faces, len(part.vertices), path)
    if max(len(part.vertices), len(part.faces)) > MAX_ROWS:
        raise CatalogError(f"{path}: more than {MAX_ROWS} vertices or triangles; decimate the mesh")
    if len(part.vertices) and np.abs(part.vertices).max() * unit > _MAX_EXTENT:
        raise CatalogError(f"{path}: a vertex lies {np.abs(part.vertices).max() * unit:.3g} m from the origin; check the file's unit")
    faces = _drop_degenerate(part.faces)
    if not len(faces):
        return replace(part, faces=faces)
    used, index = np.unique(faces, return_inverse=True)
    if part.uv is not None and not (np.abs(part.uv[used]) <= _MAX_UV).all():
        raise CatalogError(f"{path}: texture coordinates that are not finite or beyond {_MAX_UV:g}; repair the mesh")
    return replace(part, faces=faces) if len(used) == len(part.vertices) else part.take(used, index.reshape(-1, 3))


def _bake_colors(part: MeshPart, notes: Notes) -> MeshPart:
    """Multiply vertex colours into the base colour factor, if they are uniform, or into a baked texture."""
    if part.colors is None:
        return part
    factor = appearance.srgb_to_linear(part.material.color)
    if (part.colors == part.colors[0]).all():
        color = appearance.as_color(appearance.linear_to_srgb(factor * appearance.srgb_to_linear(part.colors[0])))
        return replace(part, colors=None, material=replace(part.material, color=color))
    notes.ignored += ["maps beneath vertex colours"] if part.material.has_maps else []
    notes.ignored += ["anisotropy beneath vertex colours"] if part.material.finish.anisotropy else []
    skin = None if part.material.texture is None or part.uv is None else (part.uv, part.material.texture[..., :3])
    uv, texture = appearance.bake_vertex_colors(part.faces, part.colors, factor, skin)
    finish = replace(part.material.finish, anisotropy=0.0, rotation=0.0)
    material = replace(part.material, color=appearance.WHITE, texture=texture, finish=finish)
    return part.take(part.faces.reshape(-1), np.arange(part.faces.size).reshape(-1, 3), uv=uv, colors=None, material=material)


def _join(parts: list[MeshPart], path: Path, options: MeshOptions, notes: Notes) -> MeshPart:
    """Merge all parts into one, with one material: a texture with maps where metallic or roughness differ, or a part has maps. Where not
    all parts state both, they are averaged by area. Clearcoat and anisotropy are those of the largest part."""
    if len(parts) == 1:
        return parts[0]
    parts = _share_opacity(_share_maps(_share_emission(parts, notes), notes))
    first = parts[0].material
    if not all(part.material.texture is first.texture and part.material.color == first.color for part in parts):
        parts = [_unroll(part, notes) for part in parts]
        moved, texture = appearance.join_textures([(part.uv, part.material) for part in parts], str(path), notes.said)
        parts = [replace(part, uv=np.broadcast_to(uv, (len(part.vertices), 2))) for uv, part in zip(moved, parts, strict=True)]
        first = replace(first, color=appearance.WHITE, texture=texture)
    mean = {}
    for name in ("metallic", "roughness"):
        known = [(value, _area(part)) for part in parts if (value := getattr(part.material, name)) is not None]
        total = sum(area for _, area in known)
        mean[name] = sum(value * area for value, area in known) / total if total > 0.0 else None
    finish = max(parts, key=_area).material.finish
    if any(part.material.finish != finish for part in parts):
        notes.ignored.append("clearcoat and anisotropy but for those of the largest part")
    if any(part.normals is not None for part in parts):
        parts = [complete_normals(part, options.crease_angle) for part in parts]
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    return MeshPart(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, start, strict=False)]),
        np.concatenate(normals) if normals else None,
        np.concatenate([np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]),
        None,
        replace(first, **mean, finish=finish),
    )


def _share_emission(parts: list[MeshPart], notes: Notes) -> list[MeshPart]:
    """Give all parts textures with emission, if they emit different light; beside a part without metallic or roughness, none emits."""
    given = [part.material for part in parts]
    if all(each.light == given[0].light for each in given) and all(each.glow is None for each in given):
        return parts
    if any(each.metallic is None or each.roughness is None for each in given):
        notes.ignored.append("emission beside a part without metallic or roughness")
        return [replace(part, material=replace(part.material, emission=BLACK)) for part in parts]
    made: dict[Any, appearance.FileMaterial] = {}
    most, lit = max(max(each.light) for each in given), []
    if any(0.0 < value < _FAINT * most for each in given for value in each.light):
        notes.ignored.append("emission of less than 1/6,500 of an object's brightest part")
    for part, each in zip(parts, given, strict=True):
        key = id(each.texture), each.metallic, each.roughness, each.light
        new = made[key] = made.get(key) or each.add_glow(most)
        lit.append(replace(part, material=replace(part.material, texture=new.texture, emission=new.emission, has_glow=True)))
    return lit


def _share_maps(parts: list[MeshPart], notes: Notes) -> list[MeshPart]:
    """Give all parts maps if one has them, or metallic or roughness differ; parts of one texture and equal values still share it. Where a
    part does not state them, the settings do, and maps are dropped with a note."""
    values = {(part.material.metallic, part.material.roughness) for part in parts}
    has_maps, complete = any(part.material.has_maps for part in parts), not any(None in each for each in values)
    if not complete and has_maps:
        notes.ignored.append("maps beside a part without metallic or roughness")
        return [
            replace(part, material=replace(part.material, texture=part.material.texture[..., :3]))
            if part.material.has_maps and part.material.texture is not None
            else part
            for part in parts
        ]
    if not complete or (len(values) == 1 and not has_maps):
        return parts
    made: dict[Any, np.ndarray | None] = {}
    shared = []
    for part in parts:
        given = part.material
        if not given.has_maps:
            key = id(given.texture), given.metallic, given.roughness
            if key not in made:
                made[key] = given.add_maps().texture
            given = replace(given, texture=made[key])
        shared.append(replace(part, material=given))
    return shared


def _share_opacity(parts: list[MeshPart]) -> list[MeshPart]:
    """Give all parts the glass of the clearest one, and textures with its opacity, if they transmit different parts of the light."""
    clearest = max((part.material.glass for part in parts), key=lambda glass: glass.transmission)
    if all(part.material.glass.transmission == clearest.transmission for part in parts):
        return parts
    made: dict[Any, appearance.FileMaterial] = {}
    for part in parts:
        key = id(part.material.texture), part.material.glass
        if key not in made:
            made[key] = part.material.add_opacity(clearest.transmission)
    new = ((part, made[id(part.material.texture), part.material.glass].texture) for part in parts)
    return [replace(part, material=replace(part.material, texture=texture, glass=clearest)) for part, texture in new]


def _unroll(part: MeshPart, notes: Notes) -> MeshPart:
    """Replace a texture that repeats by an image of its tiles, with each triangle moved by whole repetitions."""
    texture = part.material.texture
    if texture is None or part.uv is None or (part.uv.min() >= -appearance.UV_TOLERANCE and part.uv.max() <= 1.0 + appearance.UV_TOLERANCE):
        return part
    corners = part.uv[part.faces]
    # A shift of a whole triangle: its coordinates begin in the first tile.
    shift = np.repeat(np.floor(corners.min(axis=1) + appearance.UV_TOLERANCE), 3, axis=0)
    rows, index = np.unique(np.column_stack([part.faces.reshape(-1), shift]), axis=0, return_inverse=True)
    source = rows[:, 0].astype(np.int64)
    uv = part.uv[source] - rows[:, 1:]
    tiles = np.maximum(np.ceil(uv.max(axis=0) - appearance.UV_TOLERANCE), 1.0).astype(int)
    image = appearance.tile_texture(texture, (int(tiles[0]), int(tiles[1])), notes.said)
    return part.take(source, index.reshape(-1, 3), uv=uv / tiles, material=replace(part.material, texture=image))


def _area(part: MeshPart) -> float:
    """Surface area of a part, in the square of its unit."""
    corners = part.vertices[part.faces]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2.0)
