"""Mesh import: PLY, OBJ and GLB files, each as one triangle mesh with one material."""

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
from synpick_warp.scenes.appearance import FileMaterial, as_color, bake_vertex_colors, join_textures, linear_to_srgb, read_texture, rgb8
from synpick_warp.scenes.types import TriangleMesh

SUFFIXES = (".ply", ".obj", ".glb")

# Default base colour (sRGB): a light grey, since highlights do not show on pure white.
_GREY = (0.7, 0.7, 0.7)
# glTF 2.0, section 3.9.2: a material without factors is white, fully metallic and fully rough.
_GLTF_FACTOR = 1.0
# Maximum coordinate [m]: larger ones are mistakes, and lose precision in 32-bit floats.
_MAX_EXTENT = 1e4
# Maximum texture coordinate: larger ones are mistakes, with a resolution of a thousandth of the image in 32-bit floats.
_MAX_UV = 1e4
# PLY property names of texture coordinates: BOP's first, then those of Blender and MeshLab.
_UV_COLUMNS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of a mesh file: not yet validated, in the file's unit."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    colors: np.ndarray | None
    """sRGB (V, 3) uint8."""
    material: FileMaterial


def read_mesh(path: Path, unit: float) -> tuple[TriangleMesh, FileMaterial]:
    """Read a mesh file. Parts are merged into one mesh, several materials into a texture atlas; vertex colours are baked into a texture.

    Args:
        path: A .ply, .obj or .glb file.
        unit: Length of the file's unit [m].

    Raises:
        CatalogError: The file cannot be read, has no triangles or invalid ones, or refers to a texture that is missing.
    """
    parts = _read_ply(path) if path.suffix.lower() == ".ply" else _read_scene(path)
    part = _join([_bake_colors(_clean(part, path)) for part in parts], path)
    if np.abs(part.vertices).max() * unit > _MAX_EXTENT:
        raise CatalogError(f"{path}: a vertex lies {np.abs(part.vertices).max() * unit:.3g} m from the origin; check the file's unit")
    vertices = (part.vertices * unit).astype(np.float32)
    faces, normals = _orient_outward(vertices, part.faces, part.normals)
    smooth = smooth_normals(vertices, faces)
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        given = np.isfinite(length) & (length > 0.0)
        smooth = np.where(given, normals / np.where(given, length, 1.0), smooth).astype(np.float32)
    uv = np.zeros((len(vertices), 2), np.float32) if part.uv is None else part.uv.astype(np.float32)
    return TriangleMesh(vertices, faces.astype(np.int32), smooth, uv), part.material


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute smooth vertex normals: area-weighted means over all triangles at a position, so that texture seams do not show.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Returns:
        Unit normals (V, 3) float32. Where the triangles at a position cancel out, those of the vertex alone are used, or +z.
    """
    corners = vertices[faces].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(own, faces[:, corner], doubled)
    _, position = np.unique(vertices, axis=0, return_inverse=True)
    shared = np.zeros((position.max() + 1, 3))
    np.add.at(shared, position, own)
    normals = np.zeros((len(vertices), 3))
    # Sums within the rounding error of the areas have no direction.
    min_length = 1e-9 * np.abs(doubled).max()
    for candidate in (np.broadcast_to((0.0, 0.0, 1.0), own.shape), own, shared[position]):
        length = np.linalg.norm(candidate, axis=1, keepdims=True)
        normals = np.where(length > min_length, candidate / np.where(length > min_length, length, 1.0), normals)
    return normals.astype(np.float32)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume of a mesh, positive if its triangles face outward; about the centroid, so that small holes matter little."""
    corners = (vertices - vertices.mean(axis=0, dtype=np.float64))[faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def merge_positions(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices with equal positions, and drop triangles that degenerate."""
    positions, index = np.unique(vertices, axis=0, return_inverse=True)
    return positions, _drop_degenerate(index[faces])


def _drop_degenerate(faces: np.ndarray) -> np.ndarray:
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


def _clean(part: _Part, path: Path) -> _Part:
    """Validate a part, and drop degenerate triangles and unused vertices."""
    if not np.isfinite(part.vertices).all():
        raise CatalogError(f"{path}: {int((~np.isfinite(part.vertices)).any(axis=1).sum())} vertices are not finite; repair the mesh")
    if part.faces.size and not (part.faces.min() >= 0 and part.faces.max() < len(part.vertices)):
        raise CatalogError(f"{path}: a triangle refers to vertex {part.faces.max()}, but there are {len(part.vertices)}; repair the mesh")
    faces = _drop_degenerate(part.faces)
    if not len(faces):
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    used, index = np.unique(faces, return_inverse=True)
    if part.uv is not None and not (np.abs(part.uv[used]) <= _MAX_UV).all():
        raise CatalogError(f"{path}: texture coordinates that are not finite or beyond {_MAX_UV:g}; repair the mesh")
    if len(used) == len(part.vertices):
        return replace(part, faces=faces)
    rows = {name: None if (data := getattr(part, name)) is None else data[used] for name in ("normals", "uv", "colors")}
    return replace(part, vertices=part.vertices[used], faces=index.reshape(-1, 3), **rows)


def _bake_colors(part: _Part) -> _Part:
    """Convert vertex colours to a base colour factor, if uniform, or to a baked texture."""
    if part.colors is None:
        return part
    if (part.colors == part.colors[0]).all():
        return replace(part, colors=None, material=replace(part.material, color=as_color(part.colors[0] / 255.0)))
    uv, texture = bake_vertex_colors(part.faces, part.colors)
    order = part.faces.reshape(-1)
    return _Part(
        part.vertices[order],
        np.arange(len(order)).reshape(-1, 3),
        smooth_normals(part.vertices, part.faces)[order] if part.normals is None else part.normals[order],
        uv,
        None,
        replace(part.material, color=(1.0, 1.0, 1.0), texture=texture),
    )


def _join(parts: list[_Part], path: Path) -> _Part:
    """Merge all parts into one: one material, with metallic and roughness averaged by area."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0].material
    uvs = [np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]
    same = all(part.material.texture is first.texture and part.material.color == first.color for part in parts)
    if not same:
        moved, texture = join_textures([(part.uv, part.material) for part in parts], str(path))
        uvs = [np.broadcast_to(uv, (len(part.vertices), 2)) for uv, part in zip(moved, parts, strict=True)]
        first = replace(first, color=(1.0, 1.0, 1.0), texture=texture)
    mean = {}
    for name in ("metallic", "roughness"):
        known = [(value, _area(part)) for part in parts if (value := getattr(part.material, name)) is not None]
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
    """Read a PLY file in BOP's format; vertices keep their order, since texture coordinates refer to it."""
    try:
        data = path.read_bytes()
        # fix_texture would reorder vertices; textures are read below, where a missing one is an error.
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
    vertices, normals, colors = (_stack_columns(column, names) for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")))
    uv = next((rows for names in _UV_COLUMNS if (rows := _stack_columns(column, names)) is not None), None)
    if vertices is None:
        raise CatalogError(f"{path}: vertices without x, y and z")
    texture = _ply_texture(data, path)
    if corner_uv is not None:
        order = faces.reshape(-1)
        vertices, uv, faces = vertices[order], corner_uv, np.arange(len(order)).reshape(-1, 3)
        normals, colors = (None if rows is None else rows[order] for rows in (normals, colors))
    if texture is not None:
        if uv is None:
            raise CatalogError(
                f"{path}: refers to a texture, but its vertices have no texture_u and texture_v; unwrap it or remove the texture"
            )
        return [_Part(vertices, faces, normals, uv, None, FileMaterial((1.0, 1.0, 1.0), texture, None, None))]
    if colors is not None:
        scale = 1 if np.dtype(vertex["properties"]["red"]).kind in "iu" else 255
        colors = np.clip(np.rint(colors * scale), 0, 255).astype(np.uint8)
    return [_Part(vertices, faces, normals, None, colors, FileMaterial(_GREY, None, None, None))]


def _stack_columns(column: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    """Stack columns (V, len(names)); None unless all exist."""
    return np.stack([column[name] for name in names], axis=1) if all(name in column for name in names) else None


def _ply_corner_uv(face: dict, count: int) -> np.ndarray | None:
    """Texture coordinates of the triangles' corners (3 F, 2), if the file stores them per face; otherwise None."""
    if "texcoord" not in face.get("properties", {}):
        return None
    data = face["data"]["texcoord"]
    rows = data["f1"] if getattr(data, "dtype", None) is not None and data.dtype.names else data
    return np.asarray(rows, dtype=np.float64).reshape(3 * count, 2)


def _ply_texture(data: bytes, path: Path) -> np.ndarray | None:
    """Read the image named by the header line `comment TextureFile NAME`; None if there is none."""
    header = data[: data.find(b"end_header")].decode("utf-8", errors="replace")
    for line in header.splitlines():
        words = line.split(maxsplit=2)
        if len(words) == 3 and words[0] == "comment" and words[1].lower() == "texturefile":
            return read_texture(path.parent / words[2].strip(), str(path))
    return None


def _read_scene(path: Path) -> list[_Part]:
    """Read an OBJ or GLB file: one part for each instance of a mesh."""
    if path.suffix.lower() == ".obj":
        _check_obj_references(path)
    try:
        scene = trimesh.load_scene(path, process=False)
        parts, textures = [], {}
        # Sorted, since the reader's order of nodes is not deterministic.
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh):
                parts.append(_transform_part(_scene_part(mesh, textures, path), np.asarray(transform)))
    except CatalogError:
        raise
    except Exception as error:  # the readers raise nearly anything on damaged files
        raise CatalogError(f"{path}: not readable as {path.suffix[1:].upper()} ({error or type(error).__name__})") from error
    if not parts:
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return parts


def _transform_part(part: _Part, transform: np.ndarray) -> _Part:
    """Transform a part by a 4 x 4 matrix; a reflection flips the triangles' orientation."""
    vertices = part.vertices @ transform[:3, :3].T + transform[:3, 3]
    normals = None if part.normals is None else part.normals @ np.linalg.inv(transform[:3, :3])
    faces = part.faces if np.linalg.det(transform[:3, :3]) > 0.0 else part.faces[:, ::-1]
    return replace(part, vertices=vertices, faces=faces, normals=normals)


def _scene_part(mesh: trimesh.Trimesh, textures: dict[int, np.ndarray], path: Path) -> _Part:
    """Convert one of the reader's meshes. `textures` caches converted images by identity, so that parts share them."""
    # The property vertex_normals would compute normals with visible seams; the cache has those of the file, if any.
    normals = mesh._cache.cache.get("vertex_normals")
    visual, uv, colors, material = mesh.visual, None, None, FileMaterial(_GREY, None, None, None)
    if isinstance(visual, TextureVisuals):
        material, image = _scene_material(visual.material)
        if image is not None:
            uv = visual.uv
            if uv is None or len(uv) != len(mesh.vertices):
                raise CatalogError(f"{path}: has a texture, but vertices without texture coordinates; unwrap it or remove the texture")
            material = replace(material, texture=textures.setdefault(id(image), rgb8(image)))
    elif isinstance(visual, ColorVisuals) and visual.kind is not None:
        # glTF 2.0 has linear vertex colours; OBJ does not specify, and files contain colours of sRGB images.
        colors = np.asarray(visual.vertex_colors)[:, :3]
        if path.suffix.lower() == ".glb":
            colors = np.rint(linear_to_srgb(colors / 255.0) * 255.0).astype(np.uint8)
    return _Part(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64), normals, uv, colors, material)


def _scene_material(material: Any) -> tuple[FileMaterial, Image.Image | None]:
    """Convert the reader's material: its factors, and its base colour image if it has one."""
    if not isinstance(material, PBRMaterial):
        image = getattr(material, "image", None)
        # With an image Kd is ignored: exporters leave 0.64, or 0, there.
        color = np.ones(3) if image is not None else np.asarray(material.main_color)[:3] / 255.0
        return FileMaterial(as_color(color), None, None, None), image
    factor = material.baseColorFactor
    linear = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    metallic = _GLTF_FACTOR if material.metallicFactor is None else float(material.metallicFactor)
    roughness = _GLTF_FACTOR if material.roughnessFactor is None else float(material.roughnessFactor)
    if material.metallicRoughnessTexture is not None:
        # glTF 2.0, section 3.9.2: green is roughness, blue is metalness. The renderer takes one value per object: the mean.
        mean = rgb8(material.metallicRoughnessTexture).reshape(-1, 3).mean(axis=0) / 255.0
        roughness, metallic = roughness * float(mean[1]), metallic * float(mean[2])
    return FileMaterial(as_color(linear_to_srgb(linear)), None, metallic, roughness), material.baseColorTexture


def _check_obj_references(path: Path) -> None:
    """Raise if the OBJ's material library, or an image of it, is missing: the reader would silently go on without."""
    for line in path.read_text(errors="replace").splitlines():
        if not line.startswith("mtllib "):
            continue
        library = path.parent / line.removeprefix("mtllib ").strip()
        if not library.is_file():
            raise CatalogError(f"{path} refers to the material library {library.name!r}, but there is no file {library}; add it")
        for entry in library.read_text(errors="replace").splitlines():
            words = entry.split()
            if words[:1] == ["map_Kd"]:
                read_texture(library.parent / words[-1], str(library))
