"""Asset library shared by all USD episodes: one file per object, bin and prop, and gripper shaft ("finger"), cup and table; and
environment maps: EXR files, and the parameters of dome and distant lights."""

# pxr's modules are filled when they are loaded, invisible to type checkers.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from pxr import Gf, Usd, UsdGeom, UsdShade

from synpick_warp.codes import LookPart
from synpick_warp.configs.schema import Physics, Render
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.usd import parts
from synpick_warp.exporters.usd.episode import FLOOR, TEXTURES, StageLight, bin_asset, drawn_texture, object_asset, prop_asset
from synpick_warp.scenes import environment
from synpick_warp.scenes.bins import FLOOR_DROP, TABLE_ROUGHNESS, TABLE_SIZE, make_bins
from synpick_warp.scenes.grippers import finger_collider, finger_fixture, make_head, rod_inertia
from synpick_warp.scenes.modelling import project_from_box
from synpick_warp.scenes.types import CatalogEntry, ConvexPiece, EnvironmentMap, Fixture, Material, TriangleMesh
from synpick_warp.system.linear_algebra import dot


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
    parts.add_body(finger.GetDefaultPrim(), mass, np.array([0.0, 0.0, length / 2]), np.diag(rod_inertia(mass, length)), kinematic=True)
    _save(library, "finger", finger)
    head = make_head(gripper)
    cup = _make_fixture(library, physics, "cup", head.fixture, head.pieces)
    center = np.array([0.0, 0.0, -gripper.cup_length / 2])
    parts.add_body(cup.GetDefaultPrim(), gripper.cup_mass, center, np.diag(head.inertia), kinematic=True)
    _save(library, "cup", cup)
    textures = {} if looks is None else looks.textures
    if textures.get(LookPart.BACKGROUND):
        _write_floor(library, table - FLOOR_DROP)
    for part, images in textures.items():
        for index, texture in enumerate(images):
            parts.write_texture(library, drawn_texture(part, index), Material((1.0, 1.0, 1.0), texture, 0.0, 1.0))
    _write_table(library, physics, table, settings.render, bool(textures.get(LookPart.TABLE)))


def _save(library: Path, name: str, stage: Usd.Stage) -> None:
    parts.save_layer(stage.GetRootLayer(), library / f"{name}.usdc")


def _write_object(library: Path, physics: Physics, entry: CatalogEntry) -> None:
    """Write an object's asset: mesh, material, collision shapes and mass properties, as a dynamic rigid body."""
    name = object_asset(entry.obj_id)
    stage = parts.new_asset(name, entry.name if entry.obj_id >= 0 else "")
    root = stage.GetDefaultPrim()
    root.SetDisplayName(entry.name)
    if entry.obj_id >= 0:
        parts.add_property(root, "obj_id", entry.obj_id)
    _add_shapes(stage, physics, entry.mesh, entry.material, parts.write_texture(library, name, entry.material), entry.pieces)
    parts.add_body(root, entry.mass, entry.center_of_mass, entry.inertia, kinematic=False)
    _save(library, name, stage)


def _make_fixture(library: Path, physics: Physics, name: str, fixture: Fixture, pieces: tuple[ConvexPiece, ...]) -> Usd.Stage:
    """Stage of a fixture's asset: mesh, material and collision shapes; not saved."""
    stage = parts.new_asset(name, name)
    _add_shapes(stage, physics, fixture.mesh, fixture.material, parts.write_texture(library, name, fixture.material), pieces)
    return stage


def _add_shapes(
    stage: Usd.Stage, physics: Physics, mesh: TriangleMesh, material: Material, texture: str | None, pieces: tuple[ConvexPiece, ...]
) -> None:
    """Add an asset's visible mesh with its material, and its collision shapes."""
    root, friction = _add_contact_material(stage, physics)
    surface = parts.add_surface(stage, f"{root}/Materials/Surface", material, texture, maps=material.map_names)
    parts.add_mesh(stage, f"{root}/Visual", mesh, surface)
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    for index, piece in enumerate(pieces):
        parts.add_collider(stage, f"{root}/Collision/piece_{index:02d}", piece, friction, physics.gap)


def _write_table(library: Path, physics: Physics, height: float, render: Render, has_textures: bool) -> None:
    """Write the table under the bins: a collision box, and a visible top side at this height [m], whose texture coordinates are metres if
    it has textures; else they span the table."""
    stage = parts.new_asset("table", "table")
    root, friction = _add_contact_material(stage, physics)
    if render.table:
        sides = [0.5 * size or most for size, most in zip(render.table_size, TABLE_SIZE[:2], strict=True)]
        quad = _make_quad(sides, height, has_textures)
        material = Material(render.table_color, None, 0.0, TABLE_ROUGHNESS)
        parts.add_mesh(stage, f"{root}/Visual", quad, parts.add_surface(stage, f"{root}/Materials/Surface", material, None))
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    box = UsdGeom.Cube.Define(stage, f"{root}/Collision/box")
    box.CreateSizeAttr(2.0)
    box.CreateExtentAttr([Gf.Vec3f(-1.0), Gf.Vec3f(1.0)])
    box.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, height - TABLE_SIZE[2]))
    box.AddScaleOp().Set(Gf.Vec3f(*TABLE_SIZE))
    parts.make_collider(box, friction, physics.gap)
    _save(library, "table", stage)


def _write_floor(library: Path, height: float) -> None:
    """Write the floor at this height [m], which is seen beyond the edge of the table: a visible side without collision shape."""
    stage = parts.new_asset("floor", "floor")
    surface = parts.add_surface(stage, "/floor/Materials/Surface", FLOOR, None)
    parts.add_mesh(stage, "/floor/Visual", _make_quad(TABLE_SIZE[:2], height, True), surface)
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
    return root, parts.add_friction(stage, f"{root}/Materials/Contact", physics.friction)


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
