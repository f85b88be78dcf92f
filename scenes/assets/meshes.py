"""Mesh import: PLY, OBJ and GLB files, each as one triangle mesh with one material."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import FileMaterial, as_color, bake_vertex_colors, join_textures
from synpick_warp.scenes.assets.asset_files import MAX_ROWS, quiet_decoding
from synpick_warp.scenes.assets.mesh_parts import MeshPart
from synpick_warp.scenes.assets.ply import read_ply
from synpick_warp.scenes.assets.scene_files import read_scene
from synpick_warp.scenes.types import TriangleMesh

SUFFIXES = (".ply", ".obj", ".glb")

# Maximum coordinate [m]: larger ones are mistakes, and lose precision in 32-bit floats.
_MAX_EXTENT = 1e4
# Maximum texture coordinate: larger ones are mistakes, with a resolution of a thousandth of the image in 32-bit floats.
_MAX_UV = 1e4


def read_mesh(path: Path, unit: float) -> tuple[TriangleMesh, FileMaterial]:
    """Read a mesh file. Parts are merged into one mesh, several materials into a texture atlas; vertex colours are baked into a texture.

    Args:
        path: A .ply, .obj or .glb file.
        unit: Length of the file's unit [m].

    Raises:
        CatalogError: The file cannot be read, has no triangles or invalid ones, or refers to a texture that is missing.
    """
    with quiet_decoding():
        parts = read_ply(path) if path.suffix.lower() == ".ply" else read_scene(path)
        return _finish(_join([_bake_colors(_clean(part, unit, path)) for part in parts], path), unit)


def _finish(part: MeshPart, unit: float) -> tuple[TriangleMesh, FileMaterial]:
    """Convert a validated part to metres, orient it outward and complete its normals."""
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


def _clean(part: MeshPart, unit: float, path: Path) -> MeshPart:
    """Validate a part, and drop degenerate triangles and unused vertices."""
    if not np.isfinite(part.vertices).all():
        raise CatalogError(f"{path}: {int((~np.isfinite(part.vertices)).any(axis=1).sum())} vertices are not finite; repair the mesh")
    wrong = part.faces[(part.faces < 0) | (part.faces >= len(part.vertices))]
    if len(wrong):
        raise CatalogError(f"{path}: a triangle refers to vertex {wrong[0]}, but there are {len(part.vertices)}; repair the mesh")
    if max(len(part.vertices), len(part.faces)) > MAX_ROWS:
        raise CatalogError(f"{path}: more than {MAX_ROWS} vertices or triangles; decimate the mesh")
    if len(part.vertices) and np.abs(part.vertices).max() * unit > _MAX_EXTENT:
        raise CatalogError(f"{path}: a vertex lies {np.abs(part.vertices).max() * unit:.3g} m from the origin; check the file's unit")
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


def _bake_colors(part: MeshPart) -> MeshPart:
    """Convert vertex colours to a base colour factor, if uniform, or to a baked texture."""
    if part.colors is None:
        return part
    if (part.colors == part.colors[0]).all():
        return replace(part, colors=None, material=replace(part.material, color=as_color(part.colors[0] / 255.0)))
    uv, texture = bake_vertex_colors(part.faces, part.colors)
    order = part.faces.reshape(-1)
    return MeshPart(
        part.vertices[order],
        np.arange(len(order)).reshape(-1, 3),
        smooth_normals(part.vertices, part.faces)[order] if part.normals is None else part.normals[order],
        uv,
        None,
        replace(part.material, color=(1.0, 1.0, 1.0), texture=texture),
    )


def _join(parts: list[MeshPart], path: Path) -> MeshPart:
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
    return MeshPart(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, start, strict=False)]),
        np.concatenate(normals) if any(part.normals is not None for part in parts) else None,
        np.concatenate(uvs),
        None,
        replace(first, **mean),
    )


def _area(part: MeshPart) -> float:
    corners = part.vertices[part.faces]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2.0)
