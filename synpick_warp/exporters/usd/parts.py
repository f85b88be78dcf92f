"""Pieces of USD assets: meshes, surfaces with their textures, collision shapes, masses, names for semantic segmentation.

Stages are in metres, z up, like everything here. Imports pxr, so it is imported where USD is written and nowhere else.
"""

# pxr's modules fill themselves when they are loaded, where no type checker sees it.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade, Vt

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import write_synced
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.appearance import srgb_to_linear
from synpick_warp.scenes.types import ConvexPiece, Material, TriangleMesh

TEXTURES = "textures"
"""Folder in the asset library."""
CLASS = "class"
"""Taxonomy of the labels that say what kind of thing something is."""
_SYSTEM_REASON = re.compile(r"writing file: ([^']+)'")


def object_asset(obj_id: int) -> str:
    """Name of an object's asset: of its file without ending, and of its root."""
    return f"obj_{obj_id:06d}"


def new_asset(name: str, label: str) -> Usd.Stage:
    """A stage in memory with a component as its root: /NAME, labelled as a class."""
    stage = Usd.Stage.CreateInMemory()
    set_units(stage)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    add_label(root, CLASS, label)
    return stage


def set_units(stage: Usd.Stage) -> None:
    """Metres, kilograms, z up."""
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)


def save_layer(layer: Sdf.Layer, path: Path) -> None:
    """Write a layer as a file of its own.

    Raises:
        FileNotFoundError: There is no such folder; USD would make it.
        OutputError: It cannot be written; USD hands on the system's error as text.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    try:
        written = layer.Export(str(path))
    except Tf.ErrorException as error:
        text = " ".join(str(error).split())
        reason = _SYSTEM_REASON.search(text)
        raise OutputError(f"cannot write {path}: {reason[1] if reason else text}; free space or rights there") from error
    if not written:
        raise OutputError(f"cannot write {path}: USD does not say why")


def add_label(prim: Usd.Prim, taxonomy: str, label: str) -> None:
    """Say what something is, in one taxonomy."""
    UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([label])


def add_mesh(stage: Usd.Stage, path: str, mesh: TriangleMesh, surface: UsdShade.Material) -> UsdGeom.Mesh:
    """A visible triangle mesh with normals and texture coordinates at its vertices; both of its sides are seen, as by the cameras."""
    made = add_faces(stage, path, mesh.vertices, mesh.faces)
    made.CreateDoubleSidedAttr(True)
    made.CreateNormalsAttr(_vectors(mesh.normals))
    made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    place = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    place.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv, np.float32)))
    UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(surface)
    return made


def add_faces(stage: Usd.Stage, path: str, vertices: np.ndarray, faces: np.ndarray) -> UsdGeom.Mesh:
    """Triangles: vertices (V, 3) [m], faces (F, 3)."""
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    made.CreatePointsAttr(_vectors(vertices))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1)))
    made.CreateExtentAttr(_vectors(np.stack([vertices.min(axis=0), vertices.max(axis=0)])))
    return made


def add_surface(stage: Usd.Stage, path: str, material: Material, texture: str | None) -> UsdShade.Material:
    """A material of metallic and roughness. The texture repeats, and is multiplied by the base colour in linear light.

    Args:
        texture: File of the material's texture, relative to the asset.
    """
    made = UsdShade.Material.Define(stage, path)
    shader = _shader(stage, f"{path}/Surface", "UsdPreviewSurface")
    made.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(material.metallic)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(material.roughness)
    color = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    linear = srgb_to_linear(material.color).tolist()
    if texture is None:
        color.Set(Gf.Vec3f(*linear))
        return made
    reader = _shader(stage, f"{path}/Coordinates", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    image = _shader(stage, f"{path}/Texture", "UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{texture}"))
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    image.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*linear, 1.0))
    for name in ("wrapS", "wrapT"):
        image.CreateInput(name, Sdf.ValueTypeNames.Token).Set("repeat")
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
    color.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    return made


def write_texture(library: Path, name: str, material: Material) -> str | None:
    """Write a material's texture into the asset library; returns its file, relative to the library."""
    if material.texture is None:
        return None
    file = f"{TEXTURES}/{name}.png"
    write_synced(library / file, encode_png(material.texture))
    return file


def add_friction(stage: Usd.Stage, path: str, friction: float) -> UsdShade.Material:
    """What collision shapes are made of: Coulomb friction, no bounce."""
    made = UsdShade.Material.Define(stage, path)
    physics = UsdPhysics.MaterialAPI.Apply(made.GetPrim())
    physics.CreateStaticFrictionAttr(friction)
    physics.CreateDynamicFrictionAttr(friction)
    physics.CreateRestitutionAttr(0.0)
    return made


def add_collider(stage: Usd.Stage, path: str, piece: ConvexPiece, friction: UsdShade.Material, gap: float) -> None:
    """A convex collision shape, which renderers leave out; the gap [m] is half the distance at which Newton makes contacts."""
    mesh = add_faces(stage, path, piece.vertices, piece.faces)
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    # Newton reads this, and would otherwise take vertices from hulls of more than 64.
    mesh.GetPrim().CreateAttribute("newton:maxHullVertices", Sdf.ValueTypeNames.Int, custom=False).Set(len(piece.vertices))
    make_collider(mesh, friction, gap)


def make_collider(shape: UsdGeom.Gprim, friction: UsdShade.Material, gap: float) -> None:
    """Let a shape collide, and be a guide: it is shown when asked for alone. The gap [m] is Newton's."""
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    shape.GetPrim().CreateAttribute("newton:contactGap", Sdf.ValueTypeNames.Float, custom=False).Set(gap)
    shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(friction, UsdShade.Tokens.weakerThanDescendants, "physics")


def add_body(prim: Usd.Prim, mass: float, center: np.ndarray, inertia: np.ndarray, *, kinematic: bool) -> None:
    """Make a prim a rigid body.

    Args:
        mass: [kg]
        center: Centre of mass in the prim's frame (3) [m].
        inertia: About it, in the prim's axes (3, 3) [kg·m²].
        kinematic: Something else moves it.
    """
    UsdPhysics.RigidBodyAPI.Apply(prim).CreateKinematicEnabledAttr(kinematic)
    moments, axes = np.linalg.eigh(inertia)
    # The eigenvectors in the columns turn the principal axes to the prim's; they may come as a mirror.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    turn = Gf.Matrix3d(*axes.T.ravel().tolist()).ExtractRotation().GetQuat()
    body = UsdPhysics.MassAPI.Apply(prim)
    body.CreateMassAttr(mass)
    body.CreateCenterOfMassAttr(Gf.Vec3f(*np.asarray(center, float).tolist()))
    body.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    body.CreatePrincipalAxesAttr(Gf.Quatf(turn))


def _shader(stage: Usd.Stage, path: str, kind: str) -> UsdShade.Shader:
    made = UsdShade.Shader.Define(stage, path)
    made.CreateIdAttr(kind)
    return made


def _vectors(rows: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))
