"""Layer of a USD episode: poses of objects, gripper and cameras over time, and lights. Assets are referenced, not copied.

Every moving prim also has its first pose as default value: physics engines read the default, players read the time samples.
"""

# pxr's modules are filled when they are loaded, invisible to type checkers.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdRender

from synpick_warp.codes import SHAFT, Ending, LookPart
from synpick_warp.configs.cell.cameras import GRIPPER
from synpick_warp.exporters.usd import episode
from synpick_warp.exporters.usd.assets import add_label, add_property, add_surface, set_units
from synpick_warp.scenes.assets.appearance import as_color, linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.cameras import CAMERA_KEYS, carry
from synpick_warp.scenes.types import BLACK, Camera, Material
from synpick_warp.system.linear_algebra import DECIMALS, dot
from synpick_warp.views.frames import EpisodeEnd

WHITE = (1.0, 1.0, 1.0)
_PARTS = {"Tote": LookPart.BIN, "Bin": LookPart.BIN, "Table": LookPart.TABLE, "Floor": LookPart.BACKGROUND}
"""Part of a scene that a prim shows, by its name."""
APERTURE = 0.36
"""Horizontal aperture (film width) in tenths of a metre, USD's unit for lenses: 36 mm. Only its ratio to the focal length matters."""
CLIPPING = (0.01, 100.0)
"""Near and far clipping distance of viewers [m]."""
AWAY = Gf.Vec3d(0.0, 0.0, -1000.0)
"""Position of what is not in the scene [m]: beyond CLIPPING and below the table, for readers that ignore animated visibility (Blender)."""
HOLD = 1.0 / 1024.0
"""Time codes before a frame at which a prim leaves for AWAY or comes back, so that it is not seen on its way between two frames."""
INSTANCE = "instance"
"""Taxonomy of instance labels, and prefix of the objects' prim names."""
DISTRACTOR = "distractor"
"""Prefix of the distractors' prim names."""
ROOT = "/Episode"
FIXTURES = {"tote": f"{ROOT}/Tote", "finger": f"{ROOT}/Gripper/Finger", "cup": f"{ROOT}/Gripper/Cup"}
"""Asset and prim of each row of `TickBatch.fixture_pose`; a bin that is no tote has the prim BIN."""
BIN = f"{ROOT}/Bin"
PROPS = f"{ROOT}/Props"


def make_episode_layer(ticks: np.ndarray, end: EpisodeEnd, settings: episode.UsdSettings) -> Sdf.Layer:
    """Build the layer of an episode from its ticks, a row of `episode.tick_type` per frame, and its end, properties of the root prim."""
    layer = Sdf.Layer.CreateAnonymous()
    stage = Usd.Stage.Open(layer)
    looks = end.row.get("looks") or {}
    _add_root(stage, end, settings)
    assets = {f"{ROOT}/Table": "table"}
    if "background" in looks:
        assets[f"{ROOT}/Floor"] = "floor"
    for path in assets:
        UsdGeom.Xform.Define(stage, path)
    own = settings.bins[int(ticks["bin"][0])]
    for index, (asset, path) in enumerate(FIXTURES.items()):
        if index == 0 and own != asset:
            asset, path = own, BIN
        if asset is None:
            continue
        visible = ticks["fixture_visible"][:, index] != 0
        _add_moving(stage, path, ticks["fixture_pose"][:, index], visible, np.arange(len(ticks)))
        assets[path] = asset
    pair = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(FIXTURES["finger"]))
    pair.CreateFilteredPairsRel().SetTargets([FIXTURES["cup"]])
    for instance in np.flatnonzero((ticks["object_id"] != -1).any(axis=0)).tolist():
        path, obj_id = _add_object(stage, ticks, instance, settings)
        assets[path] = episode.object_asset(obj_id)
    for path, part, look in _drawn(assets, looks):
        if look:
            _add_look(stage, path, part, look, settings.surfaces[assets[path]])
    for name, pose, follows in settings.props:
        path = f"{FIXTURES['finger'] if follows else PROPS}/{name}"
        _add_moving(stage, path, np.array([pose]), np.ones(1, bool), np.zeros(1, int))
        assets[path] = episode.prop_asset(name)
    for index, camera in enumerate(settings.cameras):
        drawn = {key: np.array(value) for key, value in (end.row.get("cameras") or {}).get(camera.name, {}).items() if key in CAMERA_KEYS}
        _add_camera(stage, camera.name or f"camera_{index}", replace(camera, **drawn), ticks["fixture_pose"][:, SHAFT])
    first = ticks[0]
    _add_light(stage, settings.lights[first["light"]], float(first["light_yaw"]), float(first["light_exposure"]))
    # References are added last and without a stage, since they cannot be resolved from a file that is not in its place yet.
    del stage, pair
    for path, asset in assets.items():
        layer.GetPrimAtPath(path).referenceList.prependedItems = [Sdf.Reference(f"./assets/{asset}.usdc")]
    return layer


def _add_root(stage: Usd.Stage, end: EpisodeEnd, settings: episode.UsdSettings) -> None:
    """Define units, time codes, root prim with metadata, physics scene and groups."""
    set_units(stage)
    root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(end.frames - 1)
    stage.SetTimeCodesPerSecond(settings.tick_rate)
    stage.SetFramesPerSecond(settings.tick_rate)
    known = {"episode": end.episode, "arrangement": end.arrangement, "frames": end.frames, "ending": Ending(end.ending).name.lower()}
    drawn = {"split": end.row.get("split", ""), "bin": (end.row.get("bin") or {}).get("name", "")}
    for name, value in (known | {name: value for name, value in drawn.items() if value}).items():
        add_property(root, name, value)
    scene = UsdPhysics.Scene.Define(stage, f"{ROOT}/Physics")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0.0, 0.0, -1.0))
    scene.CreateGravityMagnitudeAttr(settings.gravity)
    for name in ("Gripper", "Objects", "Cameras", "Lights"):
        group = UsdGeom.Xform.Define(stage, f"{ROOT}/{name}").GetPrim()
        Usd.ModelAPI(group).SetKind(Kind.Tokens.group)


def _add_object(stage: Usd.Stage, ticks: np.ndarray, instance: int, settings: episode.UsdSettings) -> tuple[str, int]:
    """Add an instance with its labels and ids, or a distractor, which has none; returns its path and its obj_id."""
    visible = ticks["object_id"][:, instance] != -1
    obj_id = int(ticks["object_id"][visible.argmax(), instance])
    path = f"{ROOT}/Objects/{INSTANCE if obj_id >= 0 else DISTRACTOR}_{instance:02d}"
    shown = np.flatnonzero(visible)
    prim = _add_moving(stage, path, ticks["pose"][:, instance], visible, np.arange(shown[0], shown[-1] + 1))
    prim.SetDisplayName(settings.names[obj_id])
    if obj_id < 0:
        return path, obj_id
    add_property(prim, "instance_id", instance)
    add_label(prim, INSTANCE, str(instance))
    primvars = UsdGeom.PrimvarsAPI(prim)
    for name, value in (("instance_id", instance), ("obj_id", obj_id)):
        primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Int, UsdGeom.Tokens.constant).Set(value)
    return path, obj_id


def _add_moving(stage: Usd.Stage, path: str, poses: np.ndarray, visible: np.ndarray, frames: np.ndarray) -> Usd.Prim:
    """Add a prim with time-sampled pose and visibility; one that never moves gets default values only.

    While it is not in the scene it is invisible, and its samples are at AWAY. `poses` (frame, 7) and `visible` (frame) are of every frame
    of the episode, `frames` those at which its pose is known.
    """
    prim = UsdGeom.Xform.Define(stage, path)
    rotations = _make_continuous(poses[frames, 3:])
    leaves = not visible.all()
    moves = leaves or bool((poses[frames] != poses[frames[0]]).any())
    translate, orient = prim.AddTranslateOp(), prim.AddOrientOp()
    values = zip(frames.tolist(), rotations.tolist(), strict=True)
    for frame, (x, y, z, w) in values:
        rotation = Gf.Quatf(w, x, y, z)
        if frame == frames[0]:
            translate.Set(_position(poses[frame]))
            orient.Set(rotation)
        if not moves:
            break
        if visible[frame]:
            translate.Set(_position(poses[frame]), frame)
        orient.Set(rotation, frame)
    visibility = prim.CreateVisibilityAttr(_visibility(visible[0]))
    changes = np.flatnonzero(np.diff(visible.astype(int))) + 1
    for frame in [0, *changes.tolist()] if leaves else []:
        visibility.Set(_visibility(visible[frame]), frame)
        if frame:
            translate.Set(_position(poses[frame - 1]) if visible[frame - 1] else AWAY, frame - HOLD)
        if not visible[frame]:
            translate.Set(AWAY, frame)
    return prim.GetPrim()


def _position(pose: np.ndarray) -> Gf.Vec3d:
    """Position of a pose, in double precision."""
    return Gf.Vec3d(*pose[:3].astype(np.float64).tolist())


def _visibility(visible: bool) -> str:
    return UsdGeom.Tokens.inherited if visible else UsdGeom.Tokens.invisible


def _make_continuous(quaternions: np.ndarray) -> np.ndarray:
    """Normalise quaternions (frame, 4), and choose each sign such that its dot product with the one before is positive."""
    unit = quaternions.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    flips = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    unit[1:] *= np.cumprod(flips)[:, None]
    return unit


def _add_camera(stage: Usd.Stage, name: str, camera: Camera, shaft: np.ndarray) -> None:
    """Add a pinhole camera and its render product. USD's cameras look along -z with y up; film lengths are tenths of a metre.

    One that is fixed to the gripper has time samples, by the poses of the shaft at every frame (frame, 7).
    """
    lens = UsdGeom.Camera.Define(stage, f"{ROOT}/Cameras/{name}")
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    focal = APERTURE * fx / camera.width
    height = focal * camera.height / fy
    lens.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    lens.CreateFocalLengthAttr(focal)
    lens.CreateHorizontalApertureAttr(APERTURE)
    lens.CreateVerticalApertureAttr(height)
    lens.CreateHorizontalApertureOffsetAttr((0.5 - cx / camera.width) * APERTURE)
    lens.CreateVerticalApertureOffsetAttr((cy / camera.height - 0.5) * height)
    lens.CreateClippingRangeAttr(Gf.Vec2f(*CLIPPING))
    rotation, translation = camera.rotation[None], camera.translation[None]
    if camera.fixed_to == GRIPPER:
        rotation, translation = carry(rotation, translation, shaft)
    place = lens.AddTransformOp()
    for frame, (turn, move) in enumerate(zip(rotation, translation, strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = turn.T * [1.0, -1.0, -1.0]
        pose[:3, 3] = -dot(turn.T, move)
        value = Gf.Matrix4d(*pose.T.ravel().tolist())  # USD multiplies row vectors.
        if frame == 0:
            place.Set(value)
        if len(rotation) > 1:
            place.Set(value, frame)
    UsdGeom.Scope.Define(stage, f"{ROOT}/Render")
    product = UsdRender.Product.Define(stage, f"{ROOT}/Render/{name}")
    product.CreateResolutionAttr(Gf.Vec2i(camera.width, camera.height))
    product.CreatePixelAspectRatioAttr(fy / fx)  # Width by height of a pixel on the film: f / fx by f / fy.
    product.CreateCameraRel().SetTargets([lens.GetPath()])


def _add_light(stage: Usd.Stage, light: episode.StageLight, yaw: float, exposure: float) -> None:
    """Add the episode's environment map as a dome light, and its sun, if it has one, as a distant light.

    The map is rotated by `yaw` about +z, counter-clockwise [rad]. The exposure compensation, relative to the automatic exposure [EV], is
    part of the intensities, since Blender ignores `inputs:exposure`; the dome keeps its value as a property.
    """
    intensity = light.intensity * 2.0**exposure
    dome = UsdLux.DomeLight.Define(stage, f"{ROOT}/Lights/Dome")
    dome.CreateTextureFileAttr(Sdf.AssetPath(f"./assets/{light.file}"))
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    dome.CreateIntensityAttr(intensity)
    add_property(dome.GetPrim(), "exposure", exposure)
    dome.GetPrim().SetDisplayName(light.name)
    # A dome light has its zenith along +y and longitude 0 along +z. Rotated by 90° about x, its zenith is up and longitude 0 is -y;
    # a rotation by 90° about z brings it to +x, our azimuth 0.
    dome.AddRotateZOp().Set(float(np.degrees(yaw)) + 90.0)
    dome.AddRotateXOp(UsdGeom.XformOp.PrecisionFloat, UsdLux.Tokens.orientToStageUpAxis).Set(90.0)
    if light.sun_irradiance is None:
        return
    sun = UsdLux.DistantLight.Define(stage, f"{ROOT}/Lights/Sun")
    peak = max(light.sun_irradiance)
    sun.CreateAngleAttr(light.sun_angle)
    # With `normalize`, the intensity is the irradiance of a surface that faces the sun, independent of its angular diameter.
    sun.CreateNormalizeAttr(True)
    sun.CreateIntensityAttr(intensity * peak)
    sun.CreateColorAttr(Gf.Vec3f(*(value / peak for value in light.sun_irradiance)))
    # A distant light shines along its -z.
    sun.AddRotateZOp().Set(float(np.degrees(yaw)) + light.sun_azimuth)
    sun.AddRotateYOp().Set(light.sun_polar)


def _drawn(assets: Mapping[str, str], looks: Mapping[str, Any]) -> Iterator[tuple[str, LookPart, Mapping[str, Any]]]:
    """Path, part and drawn look of the prims, by the asset that each references and the episode's record; a look may be empty."""
    rows = dict(enumerate(looks.get("objects", ()))) | {row["instance"]: row for row in looks.get("distractors", ())}
    names = ("color", "metallic", "roughness", "transmission", "hue", "brightness")
    for path in assets if looks else ():
        name = path.rpartition("/")[2]
        if name in _PARTS:
            yield path, _PARTS[name], looks[_PARTS[name].name.lower()]
        elif name.rpartition("_")[2].isdigit():
            row = rows.get(int(name.rpartition("_")[2]), {})
            yield path, LookPart.OBJECT, {key: row[key] for key in names if key in row}


def _add_look(stage: Usd.Stage, path: str, part: LookPart, look: Mapping[str, Any], surface: episode.AssetSurface) -> None:
    """Add the material of a prim. Shaders of USD cannot turn the hue of a texture: it is a property of the prim then."""
    given, texture = surface.material, surface.texture
    color, gain, repeats = look.get("color", given.color), look.get("brightness", 1.0), 1.0
    if "texture" in look:
        texture, repeats = episode.texture_file(episode.drawn_texture(part, look["texture"])), 1.0 / look["texture_width"]
        color = look.get("color", WHITE)
    if texture is None:
        color = as_color(linear_to_srgb(gain * dot(hue_rotation(look.get("hue", 0.0)), srgb_to_linear(color))))
        gain = 1.0
    elif "hue" in look:
        add_property(stage.GetPrimAtPath(path), "hue", float(look["hue"]))
    glass = replace(given.glass, transmission=look.get("transmission", given.glass.transmission))
    emission = BLACK if "texture" in look else given.emission
    drawn = {"metallic": look.get("metallic", given.metallic), "roughness": look.get("roughness", given.roughness)}
    material = Material(color, None, **drawn, glass=glass, emission=emission, finish=given.finish)
    maps = surface.maps - look.keys() if "texture" not in look else ()
    add_surface(stage, f"{path}/Materials/Surface", material, texture and f"assets/{texture}", gain, repeats, maps)


def hue_rotation(degrees: float) -> np.ndarray:
    """Rotation (3, 3) of linear colours about the grey axis, as the renderer's."""
    cosine, sine = np.round([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)) / np.sqrt(3.0)], DECIMALS)
    cross = np.array([[0.0, -sine, sine], [sine, 0.0, -sine], [-sine, sine, 0.0]])
    return cosine * np.eye(3) + (1.0 - cosine) / 3.0 + cross
