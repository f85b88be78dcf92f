"""Building blocks of USD assets: meshes, materials with textures, collision shapes, rigid bodies, semantic labels.

Stages are in metres, z up, as everywhere in this package. Imports pxr, so only modules that write USD import it.
"""

# pxr's modules are filled when they are loaded, invisible to type checkers.
# pyright: reportAttributeAccessIssue=false

import errno
import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade, Vt

from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.episode import texture_file
from synpick_warp.exporters.writing.files import write_synced
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.types import MAP_CENTER, ConvexPiece, Material, TriangleMesh
from synpick_warp.system.linear_algebra import det, eigh

CLASS = "class"
"""Taxonomy of semantic class labels."""
USER = "userProperties:"
"""Namespace of custom attributes: the one that Blender imports, as custom properties."""
_PROPERTY_TYPES = {int: Sdf.ValueTypeNames.Int, float: Sdf.ValueTypeNames.Float, str: Sdf.ValueTypeNames.String}
_SYSTEM_REASON = re.compile(r"writing file: ([^']+)'")


def new_asset(name: str, label: str) -> Usd.Stage:
    """Create a stage in memory whose root /NAME is a component with a class label; empty: without one."""
    stage = Usd.Stage.CreateInMemory()
    set_units(stage)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    if label:
        add_label(root, CLASS, label)
    return stage


def set_units(stage: Usd.Stage) -> None:
    """Set the stage's units: metres, kilograms, z up."""
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)


def save_layer(layer: Sdf.Layer, path: Path) -> None:
    """Export a layer to a file; raises FileNotFoundError if the folder does not exist, which USD would create, and OutputError if the file
    cannot be written: USD reports the system's error as text."""
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
    """Add a semantic label in one taxonomy."""
    UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([label])


def add_property(prim: Usd.Prim, name: str, value: int | float | str) -> None:
    """Add a custom attribute in the namespace USER."""
    prim.CreateAttribute(f"{USER}{name}", _PROPERTY_TYPES[type(value)]).Set(value)


def add_mesh(stage: Usd.Stage, path: str, mesh: TriangleMesh, surface: UsdShade.Material) -> UsdGeom.Mesh:
    """Add a visible triangle mesh with vertex normals and texture coordinates; double-sided, as in the renderer."""
    prim = add_faces(stage, path, mesh.vertices, mesh.faces)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateNormalsAttr(_vectors(mesh.normals))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv, np.float32)))
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(surface)
    return prim


def add_faces(stage: Usd.Stage, path: str, vertices: np.ndarray, faces: np.ndarray) -> UsdGeom.Mesh:
    """Add a triangle mesh without shading: vertices (V, 3) [m], faces (F, 3)."""
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreatePointsAttr(_vectors(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1)))
    prim.CreateExtentAttr(_vectors(np.stack([vertices.min(axis=0), vertices.max(axis=0)])))
    return prim


def add_surface(
    stage: Usd.Stage,
    path: str,
    material: Material,
    texture: str | None,
    gain: float = 1.0,
    repeats: float = 1.0,
    maps: Collection[str] = (),
) -> UsdShade.Material:
    """Add a metallic-roughness material (UsdPreviewSurface). The texture, a file relative to the layer or None, repeats, and is multiplied
    by the base colour in linear light, and by `gain`; `repeats` is a factor on texture coordinates; `maps`: which of `Material.map_names`
    hold, whose files lie beside the texture."""
    surface = UsdShade.Material.Define(stage, path)
    shader = _add_shader(stage, f"{path}/Surface", "UsdPreviewSurface")
    surface.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(material.metallic)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(material.roughness)
    if material.transmission > 0.0:
        shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(1.0 - material.transmission)
        shader.CreateInput("ior", Sdf.ValueTypeNames.Float).Set(material.glass.ior)
    if material.finish.clearcoat > 0.0:
        shader.CreateInput("clearcoat", Sdf.ValueTypeNames.Float).Set(material.finish.clearcoat)
        shader.CreateInput("clearcoatRoughness", Sdf.ValueTypeNames.Float).Set(material.finish.clearcoat_roughness)
    if any(material.emission):
        shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*material.emission))
    color: UsdShade.Input = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    linear = (gain * srgb_to_linear(material.color)).tolist()
    if texture is None:
        color.Set(Gf.Vec3f(*linear))
        return surface
    reader = _add_shader(stage, f"{path}/Coordinates", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    if repeats != 1.0:
        scaled = _add_shader(stage, f"{path}/Scale", "UsdTransform2d")
        scaled.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(repeats))
        scaled.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
        reader = scaled
    place = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    image = _add_image(stage, f"{path}/Texture", texture, "sRGB", place, (*linear, 1.0))
    color.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    normal, values = (texture.replace(".png", ending) for ending in (NORMALS, VALUES))
    if "normal" in maps:
        image = _add_image(stage, f"{path}/Normals", normal, "raw", place, (2.0, 2.0, 2.0, 1.0), (-1.0, -1.0, -1.0, 0.0))
        found = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        shader.CreateInput("normal", Sdf.ValueTypeNames.Normal3f).ConnectToSource(found)
    if "opacity" in maps and material.transmission > 0.0:
        share = material.transmission
        image = _add_image(stage, f"{path}/Opacity", texture.replace(".png", OPACITY), "raw", place, (share,) * 4, (1.0 - share,) * 4)
        shader.GetInput("opacity").ConnectToSource(image.CreateOutput("r", Sdf.ValueTypeNames.Float))
    if "glow" in maps and any(material.emission):
        image = _add_image(stage, f"{path}/Glow", texture.replace(".png", GLOW), "sRGB", place, (*material.emission, 1.0))
        shader.GetInput("emissiveColor").ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    if {"roughness", "metallic"} & set(maps):
        image = _add_image(stage, f"{path}/Values", values, "raw", place, (1.0, 1.0, 1.0, 1.0))
        for channel, name in (("g", "roughness"), ("b", "metallic")):
            if name not in maps:
                continue
            shader.GetInput(name).ConnectToSource(image.CreateOutput(channel, Sdf.ValueTypeNames.Float))
    return surface


def _add_image(
    stage: Usd.Stage, path: str, file: str, space: str, place: UsdShade.Output, scale: Sequence[float], bias: Sequence[float] = ()
) -> UsdShade.Shader:
    """Add a texture node (UsdUVTexture) with repeat wrapping; its output is texel * `scale` + `bias`. `file`: relative to the layer."""
    image = _add_shader(stage, path, "UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{file}"))
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    image.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*scale))
    if bias:
        image.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*bias))
    for name in ("wrapS", "wrapT"):
        image.CreateInput(name, Sdf.ValueTypeNames.Token).Set("repeat")
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(place)
    return image


NORMALS, VALUES, OPACITY, GLOW = "_normal.png", "_values.png", "_opacity.png", "_emission.png"
"""Endings of the files of a material's maps: normals as in glTF, roughness (green) with metallic (blue), opacity, and emission."""


def write_texture(library: Path, name: str, material: Material) -> str | None:
    """Write a material's texture, and its maps, into the asset library; returns the texture's path in the library, None without texture."""
    if material.texture is None:
        return None
    file = texture_file(name)
    write_synced(library / file, encode_png(material.texture))
    if material.opacity is not None:
        write_synced(library / file.replace(".png", OPACITY), encode_png(np.repeat(material.opacity[..., None], 3, axis=2)))
    if material.glow is not None:
        write_synced(library / file.replace(".png", GLOW), encode_png(material.glow))
    if material.maps is not None:
        x, y = (material.maps[..., :2].transpose(2, 0, 1).astype(np.float64) - MAP_CENTER) / (MAP_CENTER - 1)
        normal = np.stack([x, y, np.sqrt(np.clip(1.0 - x * x - y * y, 0.0, 1.0))], axis=-1)
        images = np.rint(127.5 * normal + 127.5).astype(np.uint8), np.pad(material.maps[..., 2:], ((0, 0), (0, 0), (1, 0)))
        for ending, image in zip((NORMALS, VALUES), images, strict=True):
            write_synced(library / file.replace(".png", ending), encode_png(np.ascontiguousarray(image)))
    return file


def add_friction(stage: Usd.Stage, path: str, friction: float) -> UsdShade.Material:
    """Add the physics material of collision shapes: Coulomb friction, no restitution."""
    contact = UsdShade.Material.Define(stage, path)
    physics = UsdPhysics.MaterialAPI.Apply(contact.GetPrim())
    physics.CreateStaticFrictionAttr(friction)
    physics.CreateDynamicFrictionAttr(friction)
    physics.CreateRestitutionAttr(0.0)
    return contact


def add_collider(stage: Usd.Stage, path: str, piece: ConvexPiece, friction: UsdShade.Material, gap: float) -> None:
    """Add a convex collision shape, not rendered. `gap` [m] is half the distance at which Newton creates contacts."""
    mesh = add_faces(stage, path, piece.vertices, piece.faces)
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    # Newton reads this attribute; otherwise it reduces hulls of more than 64 vertices.
    mesh.GetPrim().CreateAttribute("newton:maxHullVertices", Sdf.ValueTypeNames.Int, custom=False).Set(len(piece.vertices))
    make_collider(mesh, friction, gap)


def make_collider(shape: UsdGeom.Gprim, friction: UsdShade.Material, gap: float) -> None:
    """Make a shape a collider with purpose `guide`, which renderers skip. `gap` [m] is Newton's contact gap."""
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    shape.GetPrim().CreateAttribute("newton:contactGap", Sdf.ValueTypeNames.Float, custom=False).Set(gap)
    shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(friction, UsdShade.Tokens.weakerThanDescendants, "physics")


def add_body(prim: Usd.Prim, mass: float, center: np.ndarray, inertia: np.ndarray, *, kinematic: bool) -> None:
    """Make a prim a rigid body: mass [kg], centre of mass in its frame (3) [m], inertia about that in its axes (3, 3) [kg·m²], and whether
    its motion is prescribed (kinematic)."""
    UsdPhysics.RigidBodyAPI.Apply(prim).CreateKinematicEnabledAttr(kinematic)
    moments, axes = eigh(inertia)
    # The eigenvectors (columns) rotate the principal axes to the prim's; eigh may return a reflection.
    axes[:, 0] *= np.sign(det(axes))
    rotation = Gf.Matrix3d(*axes.T.ravel().tolist()).ExtractRotation().GetQuat()
    body = UsdPhysics.MassAPI.Apply(prim)
    body.CreateMassAttr(mass)
    body.CreateCenterOfMassAttr(Gf.Vec3f(*np.asarray(center, float).tolist()))
    body.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    body.CreatePrincipalAxesAttr(Gf.Quatf(rotation))


def _add_shader(stage: Usd.Stage, path: str, shader_id: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(shader_id)
    return shader


def _vectors(rows: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))
