"""Read PLY, OBJ and GLB files into one mesh with one material."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.ply import load_ply
from trimesh.geometry import triangulate_quads
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.appearance import Finish, as_color, bake_vertex_colors, join_textures, linear_to_srgb, read_texture, rgb8
from synpick_warp.scenes.types import TriangleMesh

SUFFIXES = (".ply", ".obj", ".glb")

# Base colour (sRGB) of meshes whose file names none: a light grey, since pure white leaves no room for highlights.
_GREY = (0.7, 0.7, 0.7)
# glTF 2.0, section 3.9.2: a material without factors is white, fully metallic and fully rough.
_GLTF_FACTOR = 1.0
# Meshes that reach farther cannot be meant, and lose their shape in 32-bit numbers [m].
_FARTHEST = 1e4
# Texture coordinates that reach farther cannot be meant: 32-bit numbers have a thousandth of the image left between them.
_FARTHEST_UV = 1e4
# BOP's names first, then those of Blender and MeshLab.
_UV_COLUMNS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))


@dataclass(frozen=True, eq=False)
class _Part:
    """A mesh as a file has it: not yet checked, in the file's unit."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    colors: np.ndarray | None
    """sRGB (V, 3) uint8."""
    finish: Finish


def read_mesh(path: Path, unit: float) -> tuple[TriangleMesh, Finish]:
    """Read a mesh file. Several parts become one mesh, several materials one texture, vertex colours a texture.

    Args:
        path: A .ply, .obj or .glb file.
        unit: Length of the file's unit [m].

    Raises:
        CatalogError: The file cannot be read, has no triangles or broken ones, or names a texture that is missing.
    """
    parts = _read_ply(path) if path.suffix.lower() == ".ply" else _read_scene(path)
    part = _join([_with_colors(_checked(part, path)) for part in parts], path)
    if np.abs(part.vertices).max() * unit > _FARTHEST:
        raise CatalogError(f"{path}: a vertex lies {np.abs(part.vertices).max() * unit:.3g} m from the origin; check the file's unit")
    vertices = (part.vertices * unit).astype(np.float32)
    faces, normals = _outward(vertices, part.faces, part.normals)
    smooth = smooth_normals(vertices, faces)
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        given = np.isfinite(length) & (length > 0.0)
        smooth = np.where(given, normals / np.where(given, length, 1.0), smooth).astype(np.float32)
    uv = np.zeros((len(vertices), 2), np.float32) if part.uv is None else part.uv.astype(np.float32)
    return TriangleMesh(vertices, faces.astype(np.int32), smooth, uv), part.finish


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted mean of the normals of all triangles that meet at a position, so that seams of the texture do not show.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Returns:
        Unit normals (V, 3) float32. Where the triangles at a position cancel, those of the vertex alone count, or +z.
    """
    corners = vertices[faces].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(own, faces[:, corner], doubled)
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    shared = np.zeros((place.max() + 1, 3))
    np.add.at(shared, place, own)
    normals = np.zeros((len(vertices), 3))
    # Sums shorter than rounding error of the areas have no direction.
    least = 1e-9 * np.abs(doubled).max()
    for candidate in (np.broadcast_to((0.0, 0.0, 1.0), own.shape), own, shared[place]):
        length = np.linalg.norm(candidate, axis=1, keepdims=True)
        normals = np.where(length > least, candidate / np.where(length > least, length, 1.0), normals)
    return normals.astype(np.float32)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume that the triangles enclose, positive if they face outward; about the centroid, so that small gaps weigh little."""
    corners = (vertices - vertices.mean(axis=0, dtype=np.float64))[faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def merge_positions(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with one vertex a position, without the triangles that collapse thereby."""
    places, index = np.unique(vertices, axis=0, return_inverse=True)
    return places, _without_collapsed(index[faces])


def _without_collapsed(faces: np.ndarray) -> np.ndarray:
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _outward(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Turn an inside-out mesh, and its normals if they agree with its triangles."""
    if signed_volume(vertices, faces) >= 0.0:
        return faces, normals
    if normals is not None:
        corners = vertices[faces]
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if np.einsum("fi,fci->", doubled, normals[faces]) > 0.0:
            normals = -normals
    return faces[:, ::-1], normals


def _checked(part: _Part, path: Path) -> _Part:
    """The part without collapsed triangles and without vertices that no triangle uses."""
    if not np.isfinite(part.vertices).all():
        raise CatalogError(f"{path}: {int((~np.isfinite(part.vertices)).any(axis=1).sum())} vertices are not finite; repair the mesh")
    if part.faces.size and not (part.faces.min() >= 0 and part.faces.max() < len(part.vertices)):
        raise CatalogError(f"{path}: a triangle names vertex {part.faces.max()}, but there are {len(part.vertices)}; repair the mesh")
    faces = _without_collapsed(part.faces)
    if not len(faces):
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    used, index = np.unique(faces, return_inverse=True)
    if part.uv is not None and not (np.abs(part.uv[used]) <= _FARTHEST_UV).all():
        raise CatalogError(f"{path}: texture coordinates that are not finite or beyond {_FARTHEST_UV:g}; repair the mesh")
    if len(used) == len(part.vertices):
        return replace(part, faces=faces)
    rows = {name: None if (data := getattr(part, name)) is None else data[used] for name in ("normals", "uv", "colors")}
    return replace(part, vertices=part.vertices[used], faces=index.reshape(-1, 3), **rows)


def _with_colors(part: _Part) -> _Part:
    """The part with its vertex colours as base colour or texture."""
    if part.colors is None:
        return part
    if (part.colors == part.colors[0]).all():
        return replace(part, colors=None, finish=replace(part.finish, color=as_color(part.colors[0] / 255.0)))
    uv, texture = bake_vertex_colors(part.faces, part.colors)
    order = part.faces.reshape(-1)
    return _Part(
        part.vertices[order],
        np.arange(len(order)).reshape(-1, 3),
        smooth_normals(part.vertices, part.faces)[order] if part.normals is None else part.normals[order],
        uv,
        None,
        replace(part.finish, color=(1.0, 1.0, 1.0), texture=texture),
    )


def _join(parts: list[_Part], path: Path) -> _Part:
    """All parts as one."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0].finish
    uvs = [np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]
    same = all(part.finish.texture is first.texture and part.finish.color == first.color for part in parts)
    if not same:
        moved, texture = join_textures([(part.uv, part.finish) for part in parts], str(path))
        uvs = [np.broadcast_to(uv, (len(part.vertices), 2)) for uv, part in zip(moved, parts, strict=True)]
        first = replace(first, color=(1.0, 1.0, 1.0), texture=texture)
    mean = {}
    for name in ("metallic", "roughness"):
        known = [(value, _area(part)) for part in parts if (value := getattr(part.finish, name)) is not None]
        total = sum(area for _, area in known)
        mean[name] = sum(value * area for value, area in known) / total if total > 0.0 else None
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [smooth_normals(part.vertices, part.faces) if part.normals is None else part.normals for part in parts]
    return _Part(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, start, strict=False)]),
        np.concatenate(normals) if any(part.normals is not None for part in parts) else None,
        np.concatenate(uvs),
        None,
        replace(first, **mean),
    )


def _area(part: _Part) -> float:
    corners = part.vertices[part.faces]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2.0)


def _read_ply(path: Path) -> list[_Part]:
    """Read a PLY file as BOP writes it; vertices keep their order, because texture coordinates belong to them."""
    try:
        data = path.read_bytes()
        # Without fix_texture vertices stay as they are; textures are read here, where a missing one is an error.
        kwargs = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
        elements = kwargs["metadata"]["_ply_raw"]
        vertex, face = elements.get("vertex", {}), elements.get("face", {})
        faces = np.asarray(kwargs.get("faces", np.zeros((0, 3))), dtype=np.int64)
        faces = triangulate_quads(faces, dtype=np.int64) if faces.size else faces
        column = {name: np.asarray(vertex["data"][name], dtype=np.float64).reshape(-1) for name in vertex.get("properties", {})}
        corner_uv = _ply_corner_uv(face, len(faces))
    except Exception as error:  # the reader raises nearly anything on damaged files
        raise CatalogError(f"{path}: not readable as PLY ({error or type(error).__name__})") from error
    if not faces.size:
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    vertices, normals, colors = (_stacked(column, names) for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")))
    uv = next((rows for names in _UV_COLUMNS if (rows := _stacked(column, names)) is not None), None)
    if vertices is None:
        raise CatalogError(f"{path}: vertices without x, y and z")
    texture = _ply_texture(data, path)
    if corner_uv is not None:
        order = faces.reshape(-1)
        vertices, uv, faces = vertices[order], corner_uv, np.arange(len(order)).reshape(-1, 3)
        normals, colors = (None if rows is None else rows[order] for rows in (normals, colors))
    if texture is not None:
        if uv is None:
            raise CatalogError(f"{path}: names a texture, but its vertices have no texture_u and texture_v")
        return [_Part(vertices, faces, normals, uv, None, Finish((1.0, 1.0, 1.0), texture, None, None))]
    if colors is not None:
        scale = 1 if np.dtype(vertex["properties"]["red"]).kind in "iu" else 255
        colors = np.clip(np.rint(colors * scale), 0, 255).astype(np.uint8)
    return [_Part(vertices, faces, normals, None, colors, Finish(_GREY, None, None, None))]


def _stacked(column: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    """The columns side by side (V, len(names)); None unless all are there."""
    return np.stack([column[name] for name in names], axis=1) if all(name in column for name in names) else None


def _ply_corner_uv(face: dict, count: int) -> np.ndarray | None:
    """Texture coordinates of the triangles' corners (3 F, 2), where the file keeps them with its faces."""
    if "texcoord" not in face.get("properties", {}):
        return None
    data = face["data"]["texcoord"]
    rows = data["f1"] if getattr(data, "dtype", None) is not None and data.dtype.names else data
    return np.asarray(rows, dtype=np.float64).reshape(3 * count, 2)


def _ply_texture(data: bytes, path: Path) -> np.ndarray | None:
    """The picture that the header line `comment TextureFile NAME` names."""
    header = data[: data.find(b"end_header")].decode("utf-8", errors="replace")
    for line in header.splitlines():
        words = line.split(maxsplit=2)
        if len(words) == 3 and words[0] == "comment" and words[1].lower() == "texturefile":
            return read_texture(path.parent / words[2].strip(), str(path))
    return None


def _read_scene(path: Path) -> list[_Part]:
    """Read an OBJ or GLB file: one part for each mesh and place it stands in."""
    if path.suffix.lower() == ".obj":
        _check_obj_references(path)
    try:
        scene = trimesh.load_scene(path, process=False)
        parts, textures = [], {}
        # Sorted, since the reader's order of parts is not always that of the file.
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh):
                parts.append(_placed(_scene_part(mesh, textures, path), np.asarray(transform)))
    except CatalogError:
        raise
    except Exception as error:  # the readers raise nearly anything on damaged files
        raise CatalogError(f"{path}: not readable as {path.suffix[1:].upper()} ({error or type(error).__name__})") from error
    if not parts:
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return parts


def _placed(part: _Part, transform: np.ndarray) -> _Part:
    """The part moved by a 4 x 4 matrix; a mirroring one turns the triangles, too."""
    vertices = part.vertices @ transform[:3, :3].T + transform[:3, 3]
    normals = None if part.normals is None else part.normals @ np.linalg.inv(transform[:3, :3])
    faces = part.faces if np.linalg.det(transform[:3, :3]) > 0.0 else part.faces[:, ::-1]
    return replace(part, vertices=vertices, faces=faces, normals=normals)


def _scene_part(mesh: trimesh.Trimesh, textures: dict[int, np.ndarray], path: Path) -> _Part:
    """One of the reader's meshes. `textures` holds the pictures converted so far, by identity, so that parts share them."""
    # Asking for vertex_normals would compute them with visible seams; the cache has them if they came from the file.
    normals = mesh._cache.cache.get("vertex_normals")
    visual, uv, colors, finish = mesh.visual, None, None, Finish(_GREY, None, None, None)
    if isinstance(visual, TextureVisuals):
        finish, picture = _scene_finish(visual.material)
        if picture is not None:
            uv = visual.uv
            if uv is None or len(uv) != len(mesh.vertices):
                raise CatalogError(f"{path}: has a texture, but vertices without texture coordinates; unwrap it or remove the texture")
            finish = replace(finish, texture=textures.setdefault(id(picture), rgb8(picture)))
    elif isinstance(visual, ColorVisuals) and visual.kind is not None:
        # glTF 2.0 keeps vertex colours in linear light; OBJ has no rule, and files are written from sRGB pictures.
        colors = np.asarray(visual.vertex_colors)[:, :3]
        if path.suffix.lower() == ".glb":
            colors = np.rint(linear_to_srgb(colors / 255.0) * 255.0).astype(np.uint8)
    return _Part(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64), normals, uv, colors, finish)


def _scene_finish(material: Any) -> tuple[Finish, Image.Image | None]:
    """A material's numbers, and its base colour picture if it has one."""
    if not isinstance(material, PBRMaterial):
        picture = getattr(material, "image", None)
        # Beside a picture Kd is ignored: exporters leave 0.64, or 0, there.
        color = np.ones(3) if picture is not None else np.asarray(material.main_color)[:3] / 255.0
        return Finish(as_color(color), None, None, None), picture
    factor = material.baseColorFactor
    linear = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    metallic = _GLTF_FACTOR if material.metallicFactor is None else float(material.metallicFactor)
    roughness = _GLTF_FACTOR if material.roughnessFactor is None else float(material.roughnessFactor)
    if material.metallicRoughnessTexture is not None:
        # glTF 2.0, section 3.9.2: green is roughness, blue is metalness. One number an object is all the renderer takes.
        mean = rgb8(material.metallicRoughnessTexture).reshape(-1, 3).mean(axis=0) / 255.0
        roughness, metallic = roughness * float(mean[1]), metallic * float(mean[2])
    return Finish(as_color(linear_to_srgb(linear)), None, metallic, roughness), material.baseColorTexture


def _check_obj_references(path: Path) -> None:
    """Raise if the OBJ names a material file, or that a picture, which is not there: the reader would go on without."""
    for line in path.read_text(errors="replace").splitlines():
        if not line.startswith("mtllib "):
            continue
        library = path.parent / line.removeprefix("mtllib ").strip()
        if not library.is_file():
            raise CatalogError(f"{path} names the material file {library.name!r}, but there is no file {library}; put it there")
        for entry in library.read_text(errors="replace").splitlines():
            words = entry.split()
            if words[:1] == ["map_Kd"]:
                read_texture(library.parent / words[-1], str(library))
