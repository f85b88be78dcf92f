"""Asset library shared by all USD episodes: one file per object, bin and prop, and gripper shaft ("finger"), cup and table; and
environment maps: EXR files, and the parameters of dome and distant lights. Their building blocks: meshes, materials with textures,
collision shapes, rigid bodies, semantic labels.

Stages are in metres, z up, as everywhere in this package. Imports pxr, so only modules that write USD import it.
"""

# pxr's modules are filled when they are loaded, invisible to type checkers.
# pyright: reportAttributeAccessIssue=false

import errno
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade, Vt

from synpick_warp.codes import LookPart
from synpick_warp.configs.schema import Physics, Render
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.usd.episode import FLOOR, TEXTURES, StageLight, bin_asset, drawn_texture, object_asset, prop_asset, texture_file
from synpick_warp.exporters.writing.files import write_synced
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes import environment
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.bins import FLOOR_DROP, TABLE_ROUGHNESS, TABLE_SIZE, make_bins
from synpick_warp.scenes.grippers import finger_collider, finger_fixture, make_head, rod_inertia
from synpick_warp.scenes.modelling import project_from_box
from synpick_warp.scenes.types import MAP_CENTER, CatalogEntry, ConvexPiece, EnvironmentMap, Fixture, Material, TriangleMesh
from synpick_warp.system.linear_algebra import det, dot, eigh

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
    """Write the texture and maps of a material to the asset library. Returns the texture's path in the library, or None."""
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


def write_library(library: Path, context: ExportContext) -> None:
    """Write all assets into an existing folder, replacing existing ones; if looks are drawn, the textures that they are drawn from, too.

    Raises OSError, or OutputError as reported by USD, if a file cannot be written.
    """
    settings, looks = context.settings, context.looks
    bins, gripper, physics, table = make_bins(settings.bins), settings.gripper, settings.physics, settings.bins[0].ground
    for name in (TEXTURES, "lights"):
        (library / name).mkdir(exist_ok=True)
    write_light_maps(library, context.lights)
    for entry in context.catalog.bodies:
        _write_object(library, physics, entry)
    for one in bins:
        if one.sizes.is_visible:
            name = bin_asset(one.sizes)
            mesh = project_from_box(one.fixture.mesh) if looks and looks.bin_textures else one.fixture.mesh
            _save(library, name, _make_fixture(library, physics, name, replace(one.fixture, mesh=mesh), one.pieces))
    for prop in context.catalog.props:
        name = prop_asset(prop.name)
        _save(library, name, _make_fixture(library, physics, name, prop.fixture, prop.pieces))
    finger = _make_fixture(library, physics, "finger", finger_fixture(gripper), (finger_collider(gripper),))
    length, mass = gripper.finger_length, gripper.finger_mass
    add_body(finger.GetDefaultPrim(), mass, np.array([0.0, 0.0, length / 2]), np.diag(rod_inertia(mass, length)), kinematic=True)
    _save(library, "finger", finger)
    head = make_head(gripper)
    cup = _make_fixture(library, physics, "cup", head.fixture, head.pieces)
    center = np.array([0.0, 0.0, -gripper.cup_length / 2])
    add_body(cup.GetDefaultPrim(), gripper.cup_mass, center, np.diag(head.inertia), kinematic=True)
    _save(library, "cup", cup)
    textures = {} if looks is None else looks.textures
    if textures.get(LookPart.BACKGROUND):
        _write_floor(library, table - FLOOR_DROP)
    for part, images in textures.items():
        for index, texture in enumerate(images):
            write_texture(library, drawn_texture(part, index), Material((1.0, 1.0, 1.0), texture, 0.0, 1.0))
    _write_table(library, physics, table, settings.render, bool(textures.get(LookPart.TABLE)))


def _save(library: Path, name: str, stage: Usd.Stage) -> None:
    save_layer(stage.GetRootLayer(), library / f"{name}.usdc")


def _write_object(library: Path, physics: Physics, entry: CatalogEntry) -> None:
    """Write an object's asset: mesh, material, collision shapes and mass properties, as a dynamic rigid body."""
    name = object_asset(entry.obj_id)
    stage = new_asset(name, entry.name if entry.obj_id >= 0 else "")
    root = stage.GetDefaultPrim()
    root.SetDisplayName(entry.name)
    if entry.obj_id >= 0:
        add_property(root, "obj_id", entry.obj_id)
    _add_shapes(stage, physics, entry.mesh, entry.material, write_texture(library, name, entry.material), entry.pieces)
    add_body(root, entry.mass, entry.center_of_mass, entry.inertia, kinematic=False)
    _save(library, name, stage)


def _make_fixture(library: Path, physics: Physics, name: str, fixture: Fixture, pieces: tuple[ConvexPiece, ...]) -> Usd.Stage:
    """Stage of a fixture's asset: mesh, material and collision shapes; not saved."""
    stage = new_asset(name, name)
    _add_shapes(stage, physics, fixture.mesh, fixture.material, write_texture(library, name, fixture.material), pieces)
    return stage


def _add_shapes(
    stage: Usd.Stage, physics: Physics, mesh: TriangleMesh, material: Material, texture: str | None, pieces: tuple[ConvexPiece, ...]
) -> None:
    """Add an asset's visible mesh with its material, and its collision shapes."""
    root, friction = _add_contact_material(stage, physics)
    surface = add_surface(stage, f"{root}/Materials/Surface", material, texture, maps=material.map_names)
    add_mesh(stage, f"{root}/Visual", mesh, surface)
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    for index, piece in enumerate(pieces):
        add_collider(stage, f"{root}/Collision/piece_{index:02d}", piece, friction, physics.gap)


def _write_table(library: Path, physics: Physics, height: float, render: Render, has_textures: bool) -> None:
    """Write the table under the bins: a collision box, and a visible top side at this height [m], whose texture coordinates are metres if
    it has textures; else they span the table."""
    stage = new_asset("table", "table")
    root, friction = _add_contact_material(stage, physics)
    if render.table:
        sides = [0.5 * size or most for size, most in zip(render.table_size, TABLE_SIZE[:2], strict=True)]
        quad = _make_quad(sides, height, has_textures)
        material = Material(render.table_color, None, 0.0, TABLE_ROUGHNESS)
        add_mesh(stage, f"{root}/Visual", quad, add_surface(stage, f"{root}/Materials/Surface", material, None))
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    box = UsdGeom.Cube.Define(stage, f"{root}/Collision/box")
    box.CreateSizeAttr(2.0)
    box.CreateExtentAttr([Gf.Vec3f(-1.0), Gf.Vec3f(1.0)])
    box.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, height - TABLE_SIZE[2]))
    box.AddScaleOp().Set(Gf.Vec3f(*TABLE_SIZE))
    make_collider(box, friction, physics.gap)
    _save(library, "table", stage)


def _write_floor(library: Path, height: float) -> None:
    """Write the floor at this height [m], which is seen beyond the edge of the table: a visible side without collision shape."""
    stage = new_asset("floor", "floor")
    surface = add_surface(stage, "/floor/Materials/Surface", FLOOR, None)
    add_mesh(stage, "/floor/Visual", _make_quad(TABLE_SIZE[:2], height, True), surface)
    _save(library, "floor", stage)


def _make_quad(sides: Sequence[float], height: float, in_metres: bool) -> TriangleMesh:
    """Horizontal rectangle of these half sides [m]; its texture coordinates are metres, or span it."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * np.array([*sides, 0.0]) + [0.0, 0.0, height]
    uv = corners[:, :2] if in_metres else np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0.0, 1.0], (4, 1)), uv)


def _add_contact_material(stage: Usd.Stage, physics: Physics) -> tuple[str, UsdShade.Material]:
    """Add the physics material of the asset's collision shapes; returns the path of the asset's root and the material."""
    root = str(stage.GetDefaultPrim().GetPath())
    UsdGeom.Scope.Define(stage, f"{root}/Materials")
    return root, add_friction(stage, f"{root}/Materials/Contact", physics.friction)


def light_file(index: int) -> str:
    """Path of an environment map in the asset library."""
    return f"lights/light_{index:03d}.exr"


def make_stage_light(index: int, light: EnvironmentMap, exposure: float) -> StageLight:
    """Describe an environment map, by its index in the bake, as lights of a stage; the intensity reproduces the renderer's automatic
    exposure times `exposure`."""
    radiance, irradiance, radius_tangent = separate_sun(light)
    directions, solid = environment.map_directions(len(radiance))
    upward = np.maximum(directions[..., 2], 0.0) * solid
    white = np.einsum("ij,ijc->c", upward, radiance)
    azimuth = polar = 0.0
    sun: tuple[float, float, float] | None = None
    if light.sun is not None and irradiance.any():
        x, y, z = light.sun.direction
        azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
        white = white + max(z, 0.0) * irradiance
        sun = (float(irradiance[0]), float(irradiance[1]), float(irradiance[2]))
    factor = exposure * environment.WHITE_VALUE * np.pi / max(float(dot(white, environment.LUMINANCE)), 1e-9)
    angle = float(2.0 * np.degrees(np.arctan(radius_tangent)))
    return StageLight(light.name, light_file(index), float(factor), float(azimuth), float(polar), sun, angle)


def write_light_maps(library: Path, lights: tuple[EnvironmentMap, ...]) -> None:
    """Write all maps as EXR files into the asset library; `lights/` must exist.

    By OpenEXR's convention, longitude grows to the left in the image and is 0 at its centre; it equals our azimuth. USD's core supports
    EXR, PNG and JPEG textures; Radiance maps (.hdr) are supported by some renderers only. Raises OutputError.
    """
    for index, light in enumerate(lights):
        image, path = np.ascontiguousarray(separate_sun(light)[0][:, ::-1], dtype=np.float32), library / light_file(index)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_LATLONG}
        try:
            OpenEXR.File(header, {"RGB": image}).write(str(path))
        except RuntimeError as error:
            raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}; free space or rights there") from error


def separate_sun(light: EnvironmentMap) -> tuple[np.ndarray, np.ndarray, float]:
    """Split an environment map into sky and sun, so that the sun is not counted twice, as the renderer does.

    The sun has the colour given with the map. Its luminance is the given one or that of the bright region it replaces, whichever is larger.
    Returns the map (H, 2H, 3) without that region, or with a disc in its place if the sun is wide; the sun's irradiance (3), zero if it has
    none or is that disc; tangent of its angular radius.
    """
    sun = light.sun
    if sun is None:
        return light.radiance, np.zeros(3), 0.0
    radiance = light.radiance.astype(np.float64)
    coarse = environment.resize_map(radiance, environment.BACKGROUND_ROWS)
    _, direction, irradiance, radius_tangent = environment.replace_sun(coarse, sun)
    # The fraction of a coarse texel applies to all fine texels within it, so that the same light is removed.
    fraction = environment.sun_fraction(coarse, direction).astype(np.float32)
    rows = len(radiance)
    method = cv2.INTER_AREA if rows <= environment.BACKGROUND_ROWS else cv2.INTER_NEAREST
    fine = cv2.resize(fraction, (2 * rows, rows), interpolation=method).astype(np.float64)
    rest = radiance * (1.0 - fine)[..., None]
    if radius_tangent > environment.MAX_SUN_TANGENT:
        return rest + environment.draw_sun_disc(fine > 0.0, direction, irradiance, radius_tangent), np.zeros(3), radius_tangent
    return rest, irradiance, radius_tangent
