"""The layer of an episode: objects, gripper and cameras over time, and light. Assets are referenced, not copied.

Every moving thing has its pose of the first frame as its default value as well: physics engines read that, players read the samples.
"""

# pxr's modules fill themselves when they are loaded, where no type checker sees it.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdRender

from synpick_warp.exporters.usd.episode import EpisodeFacts, EpisodeSettings
from synpick_warp.exporters.usd.lights import StageLight
from synpick_warp.exporters.usd.parts import add_label, object_asset, set_units
from synpick_warp.scenes.types import Camera

APERTURE = 0.36
"""Width of the cameras' film in tenths of a metre, USD's unit for lenses: 36 mm. Only its ratio to the focal length shows."""
CLIPPING = (0.01, 100.0)
"""Nearest and farthest distance that viewers draw [m]."""
INSTANCE = "instance"
"""Taxonomy of the labels that tell the objects of an episode apart, and beginning of their prims' names."""
ROOT = "/Episode"
FIXTURES = {"tote": f"{ROOT}/Tote", "finger": f"{ROOT}/Gripper/Finger", "cup": f"{ROOT}/Gripper/Cup"}
"""Asset and prim of each row of `TickBatch.fixture_pose`."""


def episode_layer(ticks: np.ndarray, facts: EpisodeFacts, settings: EpisodeSettings) -> Sdf.Layer:
    """Everything about an episode.

    Args:
        ticks: One row a frame, of `usd_spool.tick_type`.
        facts: What the file says of the episode.
        settings: What all episodes share.
    """
    layer = Sdf.Layer.CreateAnonymous()
    stage = Usd.Stage.Open(layer)
    _begin(stage, facts, settings)
    assets = {f"{ROOT}/Table": "table"}
    UsdGeom.Xform.Define(stage, f"{ROOT}/Table")
    for index, (asset, path) in enumerate(FIXTURES.items()):
        visible = ticks["fixture_visible"][:, index] != 0
        _add_moving(stage, path, ticks["fixture_pose"][:, index], visible, np.arange(len(ticks)))
        assets[path] = asset
    pair = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(FIXTURES["finger"]))
    pair.CreateFilteredPairsRel().SetTargets([FIXTURES["cup"]])
    for instance in np.flatnonzero((ticks["object_id"] >= 0).any(axis=0)).tolist():
        path, obj_id = _add_object(stage, ticks, instance, settings)
        assets[path] = object_asset(obj_id)
    for index, camera in enumerate(settings.cameras):
        _add_camera(stage, index, camera)
    first = ticks[0]
    _add_light(stage, settings.lights[first["light"]], float(first["light_yaw"]), float(first["light_exposure"]))
    # References come last and without a stage: nothing need be resolved from a file that is not in its place yet.
    del stage, pair
    for path, asset in assets.items():
        layer.GetPrimAtPath(path).referenceList.prependedItems = [Sdf.Reference(f"./assets/{asset}.usdc")]
    return layer


def _begin(stage: Usd.Stage, facts: EpisodeFacts, settings: EpisodeSettings) -> None:
    set_units(stage)
    root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(facts.frames - 1)
    stage.SetTimeCodesPerSecond(settings.tick_rate)
    stage.SetFramesPerSecond(settings.tick_rate)
    for name in ("episode", "redraw", "frames", "ending"):
        root.SetCustomDataByKey(name, getattr(facts, name))
    scene = UsdPhysics.Scene.Define(stage, f"{ROOT}/Physics")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0.0, 0.0, -1.0))
    scene.CreateGravityMagnitudeAttr(settings.gravity)
    for name in ("Gripper", "Objects", "Cameras", "Lights"):
        group = UsdGeom.Xform.Define(stage, f"{ROOT}/{name}").GetPrim()
        Usd.ModelAPI(group).SetKind(Kind.Tokens.group)


def _add_object(stage: Usd.Stage, ticks: np.ndarray, instance: int, settings: EpisodeSettings) -> tuple[str, int]:
    """An instance with its names; returns its path and its obj_id."""
    visible = ticks["object_id"][:, instance] >= 0
    obj_id = int(ticks["object_id"][visible.argmax(), instance])
    path = f"{ROOT}/Objects/{INSTANCE}_{instance:02d}"
    shown = np.flatnonzero(visible)
    prim = _add_moving(stage, path, ticks["pose"][:, instance], visible, np.arange(shown[0], shown[-1] + 1))
    prim.SetDisplayName(settings.names[obj_id])
    prim.SetCustomDataByKey("instance_id", instance)
    add_label(prim, INSTANCE, str(instance))
    primvars = UsdGeom.PrimvarsAPI(prim)
    for name, value in (("instance_id", instance), ("obj_id", obj_id)):
        primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Int, UsdGeom.Tokens.constant).Set(value)
    return path, obj_id


def _add_moving(stage: Usd.Stage, path: str, poses: np.ndarray, visible: np.ndarray, frames: np.ndarray) -> Usd.Prim:
    """Something that moves.

    Args:
        poses: At every frame of the episode (frame, 7).
        visible: At which frames it is seen (frame).
        frames: From which to which frame its pose is known. What does not move has no samples.
    """
    made = UsdGeom.Xform.Define(stage, path)
    places, turns = poses[frames, :3].astype(np.float64), _continuous(poses[frames, 3:])
    moves = len(frames) > 1 and bool((poses[frames] != poses[frames[0]]).any())
    translate, orient = made.AddTranslateOp(), made.AddOrientOp()
    values = zip(frames.tolist(), places.tolist(), turns.tolist(), strict=True)
    for frame, place, (x, y, z, w) in values:
        where, turn = Gf.Vec3d(*place), Gf.Quatf(w, x, y, z)
        if frame == frames[0]:
            translate.Set(where)
            orient.Set(turn)
        if not moves:
            break
        translate.Set(where, frame)
        orient.Set(turn, frame)
    visibility = made.CreateVisibilityAttr(_visibility(visible[0]))
    changes = np.flatnonzero(np.diff(visible.astype(int))) + 1
    for frame in [0, *changes.tolist()] if len(changes) else []:
        visibility.Set(_visibility(visible[frame]), frame)
    return made.GetPrim()


def _visibility(visible: bool) -> str:
    return UsdGeom.Tokens.inherited if visible else UsdGeom.Tokens.invisible


def _continuous(turns: np.ndarray) -> np.ndarray:
    """Quaternions (frame, 4) of unit length, each with the sign that is nearer to the one before."""
    unit = turns.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    flips = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    unit[1:] *= np.cumprod(flips)[:, None]
    return unit


def _add_camera(stage: Usd.Stage, index: int, camera: Camera) -> None:
    """A pinhole. USD's cameras look along -z with y up; lengths on the film are tenths of a metre."""
    made = UsdGeom.Camera.Define(stage, f"{ROOT}/Cameras/camera_{index}")
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    focal = APERTURE * fx / camera.width
    height = focal * camera.height / fy
    made.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    made.CreateFocalLengthAttr(focal)
    made.CreateHorizontalApertureAttr(APERTURE)
    made.CreateVerticalApertureAttr(height)
    made.CreateHorizontalApertureOffsetAttr((0.5 - cx / camera.width) * APERTURE)
    made.CreateVerticalApertureOffsetAttr((cy / camera.height - 0.5) * height)
    made.CreateClippingRangeAttr(Gf.Vec2f(*CLIPPING))
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation.T * [1.0, -1.0, -1.0]
    pose[:3, 3] = -camera.rotation.T @ camera.translation
    made.AddTransformOp().Set(Gf.Matrix4d(*pose.T.ravel().tolist()))  # vectors are rows there
    UsdGeom.Scope.Define(stage, f"{ROOT}/Render")
    product = UsdRender.Product.Define(stage, f"{ROOT}/Render/camera_{index}")
    product.CreateResolutionAttr(Gf.Vec2i(camera.width, camera.height))
    product.CreatePixelAspectRatioAttr(fx / fy)
    product.CreateCameraRel().SetTargets([made.GetPath()])


def _add_light(stage: Usd.Stage, light: StageLight, turn: float, stops: float) -> None:
    """The episode's light map about everything, turned counter-clockwise [rad], and the map's sun if it has one.

    Args:
        turn: Of the map about +z [rad].
        stops: On top of the exposure that the map has by itself.
    """
    dome = UsdLux.DomeLight.Define(stage, f"{ROOT}/Lights/Dome")
    dome.CreateTextureFileAttr(Sdf.AssetPath(f"./assets/{light.file}"))
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    dome.CreateIntensityAttr(light.intensity)
    dome.CreateExposureAttr(stops)
    dome.GetPrim().SetDisplayName(light.name)
    # A dome has its zenith along its +y and longitude 0 along its +z. Raised by 90° about x, the zenith is up and longitude 0 is -y:
    # a quarter turn brings it to +x, where azimuths begin.
    dome.AddRotateZOp().Set(float(np.degrees(turn)) + 90.0)
    dome.AddRotateXOp(UsdGeom.XformOp.PrecisionFloat, UsdLux.Tokens.orientToStageUpAxis).Set(90.0)
    if light.sun_irradiance is None:
        return
    sun = UsdLux.DistantLight.Define(stage, f"{ROOT}/Lights/Sun")
    most = max(light.sun_irradiance)
    sun.CreateAngleAttr(light.sun_angle)
    # Normalised, the intensity is the irradiance of what faces the sun, whatever its angle.
    sun.CreateNormalizeAttr(True)
    sun.CreateIntensityAttr(light.intensity * most)
    sun.CreateColorAttr(Gf.Vec3f(*(value / most for value in light.sun_irradiance)))
    sun.CreateExposureAttr(stops)
    # Distant lights shine along their -z.
    sun.AddRotateZOp().Set(float(np.degrees(turn)) + light.sun_azimuth)
    sun.AddRotateYOp().Set(light.sun_polar)
