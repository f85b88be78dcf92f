"""OBJ and GLB import: parts, node transforms and materials of a scene, as the reader (trimesh) returns them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import FileMaterial, as_color, linear_to_srgb, rgb8
from synpick_warp.scenes.assets.asset_files import describe_error
from synpick_warp.scenes.assets.gltf import prepare_glb
from synpick_warp.scenes.assets.mesh_parts import GREY, MeshPart
from synpick_warp.scenes.assets.obj import prepare_obj

# glTF 2.0, section 3.9.2: a material without factors is white, fully metallic and fully rough.
_GLTF_FACTOR = 1.0
# Factors may exceed 0..1 by rounding.
_FACTOR_TOLERANCE = 1e-3
_SUFFIX = 7
"""Length of the reader's random suffixes: "_" and six characters."""


def read_scene(path: Path) -> list[MeshPart]:
    """Read an OBJ or GLB file: one part for each instance of a mesh.

    Raises:
        CatalogError: The file or one that it refers to cannot be used, or there are no triangles.
    """
    kind = path.suffix.lower()[1:]
    data, table = prepare_obj(path) if kind == "obj" else prepare_glb(path)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=table, process=False)
        parts, textures = [], {}
        # Sorted, since the reader's order of nodes is not deterministic.
        for node in sorted(scene.graph.nodes_geometry, key=lambda node: _node_order(scene, node)):
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh):
                parts.append(_transform_part(_scene_part(mesh, textures, path), np.asarray(transform)))
    except CatalogError:
        raise
    except Exception as error:  # the readers raise nearly anything on damaged files
        raise CatalogError(f"{path}: not readable as {path.suffix[1:].upper()} ({describe_error(error)})") from error
    if not parts:
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return parts


def _node_order(scene: trimesh.Scene, node: str) -> tuple[str, str]:
    """Sort key of a node: its name; for the primitives of one glTF mesh, whose nodes get random suffixes, the mesh's node and the part."""
    parent = node[:-_SUFFIX]
    if scene.graph.transforms.parents.get(node) == parent:
        return parent, scene.graph[node][1]
    return node, ""


def _transform_part(part: MeshPart, transform: np.ndarray) -> MeshPart:
    """Transform a part by a 4 x 4 matrix; a reflection flips the triangles' orientation."""
    vertices = part.vertices @ transform[:3, :3].T + transform[:3, 3]
    normals = None if part.normals is None else part.normals @ np.linalg.inv(transform[:3, :3])
    faces = part.faces if np.linalg.det(transform[:3, :3]) > 0.0 else part.faces[:, ::-1]
    return replace(part, vertices=vertices, faces=faces, normals=normals)


def _scene_part(mesh: trimesh.Trimesh, textures: dict[int, np.ndarray], path: Path) -> MeshPart:
    """Convert one of the reader's meshes. `textures` caches converted images by identity, so that parts share them."""
    # The property vertex_normals would compute normals with visible seams; the cache has those of the file, if any.
    normals = mesh._cache.cache.get("vertex_normals")
    if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,) or (normals is not None and normals.shape != mesh.vertices.shape):
        raise CatalogError(f"{path}: vertices, normals or triangles with other than three numbers each; repair the mesh")
    visual, uv, colors, material = mesh.visual, None, None, FileMaterial(GREY, None, None, None)
    if isinstance(visual, TextureVisuals):
        material, image = _scene_material(visual.material, path)
        if image is not None:
            uv = visual.uv
            if uv is None or len(uv) != len(mesh.vertices):
                raise CatalogError(f"{path}: has a texture, but vertices without texture coordinates; unwrap it or remove the texture")
            material = replace(material, texture=textures.setdefault(id(image), rgb8(image)))
    elif isinstance(visual, ColorVisuals) and visual.kind is not None:
        # glTF 2.0 has linear vertex colours; OBJ does not specify, and files contain colours of sRGB images.
        colors = np.asarray(visual.vertex_colors)[:, :3]
        if len(colors) != len(mesh.vertices):
            raise CatalogError(f"{path}: {len(colors)} vertex colours for {len(mesh.vertices)} vertices; repair the mesh")
        if path.suffix.lower() == ".glb":
            colors = np.rint(linear_to_srgb(colors / 255.0) * 255.0).astype(np.uint8)
    return MeshPart(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64), normals, uv, colors, material)


def _scene_material(material: Any, path: Path) -> tuple[FileMaterial, Image.Image | None]:
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
    for name, value in (("metallicFactor", metallic), ("roughnessFactor", roughness)):
        if not -_FACTOR_TOLERANCE <= value <= 1.0 + _FACTOR_TOLERANCE:
            raise CatalogError(f"{path}: {name} is {value:g}; allowed: 0 to 1; correct the material")
    if material.metallicRoughnessTexture is not None:
        # glTF 2.0, section 3.9.2: green is roughness, blue is metalness. The renderer takes one value per object: the mean.
        mean = rgb8(material.metallicRoughnessTexture).reshape(-1, 3).mean(axis=0) / 255.0
        roughness, metallic = roughness * float(mean[1]), metallic * float(mean[2])
    return FileMaterial(as_color(linear_to_srgb(linear)), None, metallic, roughness), material.baseColorTexture
