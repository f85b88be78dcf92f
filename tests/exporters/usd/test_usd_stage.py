"""Layers of USD episodes: poses, visibility, cameras and lights, read with USD's own functions."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdRender, UsdSemantics

from synpick_warp.codes import Ending
from synpick_warp.exporters.usd.assets import make_stage_light, separate_sun, write_light_maps
from synpick_warp.exporters.usd.episode import TickSpool, UsdSettings, read_ticks, tick_rows
from synpick_warp.exporters.usd.stage import CLIPPING, FIXTURES, make_episode_layer
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.environment import MAX_SUN_TANGENT, map_directions, resize_map
from synpick_warp.scenes.types import Camera, EnvironmentMap, Sun
from synpick_warp.stages.render import light_tables
from synpick_warp.views.frames import EpisodeEnd
from tests.worlds import usd_sets

SETTINGS = usd_sets.settings()
LENSES = make_cameras(SETTINGS.rig)
TICKS = usd_sets.episode_ticks(0)
ROWS = 64


NAMES = {1: "one", 2: "two", 3: "three"}


def open_episode(rows: np.ndarray, cameras=LENSES, lights: tuple[EnvironmentMap, ...] = skies()[:2]) -> Usd.Stage:
    """Open the stage of an episode, without its assets."""
    stage_lights = tuple(make_stage_light(index, light, 1.0) for index, light in enumerate(lights))
    settings = UsdSettings(15.0, 9.81, ("tote",), cameras, stage_lights, NAMES, {})
    layer = make_episode_layer(rows, EpisodeEnd(0, 0, len(rows), int(Ending.EMPTIED)), settings)
    for prim in layer.rootPrims["Episode"].nameChildren.values():
        for each in (prim, *prim.nameChildren.values()):
            each.referenceList.ClearEdits()
    stage = Usd.Stage.Open(layer)
    stage.layer = layer  # type: ignore[attr-defined]
    return stage


@pytest.fixture(scope="module")
def rows(tmp_path_factory) -> np.ndarray:
    """The ticks as a writer process reads them."""
    spool = TickSpool(tmp_path_factory.mktemp("ticks") / "ticks", TICKS[0].object_id.shape[1])
    for batch in TICKS:
        spool.add(tick_rows(batch)[0])
    spool.flush()
    return read_ticks(spool.path, spool.instances)


@pytest.fixture(scope="module")
def stage(rows):
    return open_episode(rows)


def matrix(pose: np.ndarray) -> np.ndarray:
    """Convert a pose (7) to a matrix (4, 4) for column vectors."""
    x, y, z, w = pose[3:].astype(np.float64)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] += 2 * w * cross + 2 * cross @ cross
    result[:3, 3] = pose[:3]
    return result


def world_matrix(prim: Usd.Prim, time: float) -> np.ndarray:
    """Local-to-world matrix of a prim (4, 4), for column vectors."""
    return np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)).T


@pytest.mark.parametrize("instance", np.flatnonzero(usd_sets.OBJECT_IDS >= 0).tolist())
def test_object_poses_and_visibility_at_every_tick(stage, instance):
    prim = stage.GetPrimAtPath(f"/Episode/Objects/instance_{instance:02d}")
    for frame, batch in enumerate(TICKS):
        present = batch.object_id[0, instance] >= 0
        assert (UsdGeom.Imageable(prim).ComputeVisibility(frame) == UsdGeom.Tokens.inherited) == present
        if present:
            np.testing.assert_allclose(world_matrix(prim, frame), matrix(batch.pose[0, instance]), atol=5e-7)
    np.testing.assert_allclose(world_matrix(prim, Usd.TimeCode.Default()), matrix(TICKS[0].pose[0, instance]), atol=5e-7)


@pytest.mark.parametrize("index", range(3))
def test_fixture_poses_and_visibility_at_every_tick(stage, index):
    prim = stage.GetPrimAtPath(list(FIXTURES.values())[index])
    for frame, batch in enumerate(TICKS):
        visible = UsdGeom.Imageable(prim).ComputeVisibility(frame) == UsdGeom.Tokens.inherited
        assert visible == bool(batch.fixture_visible[0, index])
        if visible:
            np.testing.assert_allclose(world_matrix(prim, frame), matrix(batch.fixture_pose[0, index]), atol=5e-7)
    np.testing.assert_allclose(world_matrix(prim, Usd.TimeCode.Default()), matrix(TICKS[0].fixture_pose[0, index]), atol=5e-7)


def test_visibility_changes_at_the_tick_and_resting_prims_have_no_samples(stage):
    """Quaternions are continuous."""
    prim = UsdGeom.Imageable(stage.GetPrimAtPath(f"/Episode/Objects/instance_{usd_sets.PICKED:02d}"))
    assert prim.ComputeVisibility(usd_sets.PICKED_FRAME - 0.01) == UsdGeom.Tokens.inherited
    assert prim.ComputeVisibility(usd_sets.PICKED_FRAME) == UsdGeom.Tokens.invisible
    assert prim.GetVisibilityAttr().GetTimeSamples() == [0.0, usd_sets.PICKED_FRAME]
    assert not UsdGeom.Xformable(stage.GetPrimAtPath("/Episode/Objects/instance_03")).TransformMightBeTimeVarying()
    orient = stage.GetPrimAtPath("/Episode/Objects/instance_00").GetAttribute("xformOp:orient")
    assert orient.GetTimeSamples() == list(range(usd_sets.FRAMES))
    values = [np.array([q.GetReal(), *q.GetImaginary()]) for q in map(orient.Get, range(usd_sets.FRAMES))]
    assert all(first @ second > 0.9 for first, second in pairwise(values))


GONE = {
    f"/Episode/Objects/instance_{usd_sets.PICKED:02d}": (0, usd_sets.PICKED_FRAME),
    **dict.fromkeys((FIXTURES["finger"], FIXTURES["cup"]), usd_sets.GRIPPER),
}
"""Prims that are not always in the scene: their first frame, and the first one without them."""


@pytest.mark.parametrize(("path", "span"), GONE.items())
def test_what_is_not_in_the_scene_is_beyond_the_far_plane_for_readers_without_visibility(stage, path, span):
    """It leaves and returns within a moment before the frame: until then it stays where it was, so that nobody sees it fly past."""
    prim = stage.GetPrimAtPath(path)
    for frame in range(usd_sets.FRAMES):
        distance = np.linalg.norm(world_matrix(prim, frame)[:3, 3])
        assert distance > 2 * CLIPPING[1] if not span[0] <= frame < span[1] else distance < CLIPPING[1]
    for frame in filter(None, span):
        np.testing.assert_array_equal(world_matrix(prim, frame - 0.01)[:3, 3], world_matrix(prim, frame - 1)[:3, 3])


def test_instances_have_all_ids_and_labels(stage):
    prims = stage.GetPrimAtPath("/Episode/Objects").GetChildren()
    assert [prim.GetName() for prim in prims] == ["instance_00", "instance_02", "instance_03"]
    for prim, instance, obj_id in zip(prims, (0, 2, 3), (3, 1, 2), strict=True):
        assert prim.GetAttribute("userProperties:instance_id").Get() == instance
        assert list(UsdSemantics.LabelsAPI(prim, "instance").GetLabelsAttr().Get()) == [str(instance)]
        primvars = UsdGeom.PrimvarsAPI(prim)
        assert [primvars.GetPrimvar(name).Get() for name in ("instance_id", "obj_id")] == [instance, obj_id]
        assert prim.GetDisplayName() == NAMES[obj_id]


SKEW = Camera(640, 400, np.array([[900.0, 0, 301.5], [0, 850.0, 222.25], [0, 0, 1]]), LENSES[1].rotation, np.array([0.1, -0.2, 1.5]))


@pytest.fixture(scope="module")
def skewed(rows) -> Usd.Stage:
    return open_episode(rows, (*LENSES, SKEW))


@given(st.integers(0, 3), st.tuples(*[st.floats(-0.4, 0.4)] * 3))
def test_usd_cameras_project_like_ours(skewed, index, point):
    camera = (*LENSES, SKEW)[index]
    x, y, z = camera.matrix @ (camera.rotation @ point + camera.translation)
    np.testing.assert_allclose(project(skewed, index, camera, np.array(point)), (x / z, y / z), atol=1e-3)


def project(stage: Usd.Stage, index: int, camera: Camera, point: np.ndarray) -> tuple[float, float]:
    """Pixel coordinates of a point by USD's frustum."""
    frustum = UsdGeom.Camera.Get(stage, f"/Episode/Cameras/camera_{index}").GetCamera(0).frustum
    shown = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(Gf.Vec3d(*point.tolist()))
    assert -1.0 < shown[2] < 1.0  # in front of the camera
    return (shown[0] + 1.0) / 2.0 * camera.width, (1.0 - shown[1]) / 2.0 * camera.height


CALIBRATED = {
    "calibrated": (320, 240, 275.0, 274.6, 163.8, 117.5),
    "oblong_pixels": (640, 400, 900.0, 850.0, 301.5, 222.25),
    "off_center": (1280, 720, 631.5, 631.2, 500.25, 366.5),
    "portrait": (200, 400, 373.2, 373.0, 97.5, 215.0),
}
"""Width, height, fx, fy, cx and cy of cameras [px]."""


@pytest.fixture(scope="module")
def calibrated(rows) -> Usd.Stage:
    matrices = {name: np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) for name, (_, _, fx, fy, cx, cy) in CALIBRATED.items()}
    lenses = [replace(LENSES[0], width=row[0], height=row[1], matrix=matrices[name], name=name) for name, row in CALIBRATED.items()]
    return open_episode(rows, tuple(lenses))


@pytest.mark.parametrize("name", CALIBRATED)
def test_intrinsics_are_read_back(calibrated, name):
    """By USD's definitions: aperture and focal length in one unit, offsets in that of the aperture, up and to the right."""
    width, height, fx, fy, cx, cy = CALIBRATED[name]
    lens = UsdGeom.Camera.Get(calibrated, f"/Episode/Cameras/{name}").GetCamera(0)
    across, down = lens.horizontalAperture, lens.verticalAperture
    assert lens.focalLength / across * width == pytest.approx(fx, rel=1e-6)
    assert lens.focalLength / down * height == pytest.approx(fy, rel=1e-6)
    assert 0.5 - lens.horizontalApertureOffset / across == pytest.approx(cx / width, abs=1e-6)
    assert 0.5 + lens.verticalApertureOffset / down == pytest.approx(cy / height, abs=1e-6)
    product = UsdRender.Product.Get(calibrated, f"/Episode/Render/{name}")
    # Otherwise renderers expand the aperture until the aspect ratios agree (aspectRatioConformPolicy).
    columns, image_rows = product.GetResolutionAttr().Get()
    assert columns / image_rows * product.GetPixelAspectRatioAttr().Get() == pytest.approx(across / down, rel=1e-6)


def blender_matrix(lens: Gf.Camera, width: int, height: int, aspect: float, fit: str = "AUTO") -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a render in Blender after its import of a USD camera [px]; `aspect`: pixel_aspect_y / pixel_aspect_x.

    By the formulas of its importer, shift_x and shift_y are the offsets divided by the horizontal aperture. By those of its renderer, focal
    length, sensor width and shifts refer to the width of the image, or with the sensor fit AUTO to the longer side.
    """
    side = width if fit == "HORIZONTAL" or width >= aspect * height else aspect * height
    focal = lens.focalLength / lens.horizontalAperture * side
    shift_x, shift_y = (offset / lens.horizontalAperture for offset in (lens.horizontalApertureOffset, lens.verticalApertureOffset))
    return focal, focal / aspect, width / 2 - shift_x * side, height / 2 + shift_y * side / aspect


@pytest.mark.parametrize(
    ("name", "aspect", "fit", "off"),
    [
        ("calibrated", 1.0, "AUTO", 0.05),
        ("off_center", 1.0, "AUTO", 0.05),
        ("calibrated", 275.0 / 274.6, "AUTO", 1e-4),
        ("oblong_pixels", 900.0 / 850.0, "AUTO", 1e-4),
        ("portrait", 373.2 / 373.0, "HORIZONTAL", 1e-4),
    ],
)
def test_blender_shifts_its_lens_as_the_principal_point(calibrated, name, aspect, fit, off):
    """Blender's import leaves the pixels' aspect ratio at 1, and so fy at fx; portrait images need the sensor fit."""
    width, height, fx, fy, cx, cy = CALIBRATED[name]
    lens = UsdGeom.Camera.Get(calibrated, f"/Episode/Cameras/{name}").GetCamera(0)
    found = blender_matrix(lens, width, height, aspect, fit)
    assert found[2:] == pytest.approx((cx, cy), abs=off)
    assert found[0] == pytest.approx(fx, rel=1e-6)
    assert found[1] == pytest.approx(fx if aspect == 1.0 else fy, rel=1e-6)


def test_aperture_is_36_mm_and_render_products_have_the_resolution(stage):
    for index, camera in enumerate(LENSES):
        lens = UsdGeom.Camera.Get(stage, f"/Episode/Cameras/camera_{index}")
        # Tenths of a unit of one metre.
        assert 100.0 * lens.GetHorizontalApertureAttr().Get() == pytest.approx(36.0)
        fov = lens.GetCamera(0).GetFieldOfView(Gf.Camera.FOVHorizontal)
        assert fov == pytest.approx(SETTINGS.cameras.fov, abs=1e-4)
        product = UsdRender.Product.Get(stage, f"/Episode/Render/camera_{index}")
        assert tuple(product.GetResolutionAttr().Get()) == (camera.width, camera.height)
        assert product.GetCameraRel().GetTargets() == [lens.GetPath()]


def toward(azimuth: float, polar: float, yaw: float = 0.0) -> np.ndarray:
    """Direction by its angles [degrees], turned about z [rad]."""
    a, p = np.radians(azimuth) + yaw, np.radians(polar)
    return np.array([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)])


def sunny(azimuth: float, polar: float, irradiance: float = 3.0, sharpness: float = 3000.0, rows: int = ROWS) -> EnvironmentMap:
    """A dim map with a bright region, and the sun that replaces it. A sharpness of 100 is too wide for a distant light."""
    place = toward(azimuth, polar)
    radiance = 0.2 + 30.0 * np.exp(sharpness * (map_directions(rows)[0] @ place - 1.0))[..., None] * np.array([1.0, 0.9, 0.7])
    return EnvironmentMap("sunny", radiance.astype(np.float32), Sun(place, irradiance * np.array([1.0, 0.8, 0.5])))


@pytest.mark.parametrize(("azimuth", "polar"), [(0.0, 60.0), (90.0, 45.0), (-130.0, 20.0), (170.0, 75.0)])
def test_the_dome_light_has_the_orientation_of_the_renderer(tmp_path, rows, azimuth, polar):
    light = replace(sunny(azimuth, polar), sun=None)
    (tmp_path / "lights").mkdir()
    write_light_maps(tmp_path, (light, light))
    file = OpenEXR.File(str(tmp_path / "lights/light_001.exr"))
    assert (file.header()["compression"], file.header()["envmap"]) == (OpenEXR.ZIP_COMPRESSION, OpenEXR.ENVMAP_LATLONG)
    picture = file.channels()["RGB"].pixels
    np.testing.assert_array_equal(picture, light.radiance[:, ::-1])
    stage = open_episode(rows, lights=(light, light))
    # OpenEXR, "Latitude-longitude map": the first column is longitude π, the first row latitude π/2; latitude π/2 is +y,
    # longitude 0 is +z and π/2 is +x. UsdLux follows it.
    row, column = np.unravel_index(picture.sum(axis=2).argmax(), picture.shape[:2])
    longitude = np.pi - (column + 0.5) / picture.shape[1] * 2 * np.pi
    latitude = np.pi / 2 - (row + 0.5) / picture.shape[0] * np.pi
    local = np.array([np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)])
    direction = world_matrix(stage.GetPrimAtPath("/Episode/Lights/Dome"), 0)[:3, :3] @ local
    assert np.degrees(np.arccos(direction @ toward(azimuth, polar, usd_sets.YAW))) < 180.0 / ROWS


def test_the_dome_light_is_oriented_by_usds_own_operation(rows):
    """OrientToStageUpAxis changes nothing, and adds the same operation to a dome light without one."""
    stage = open_episode(rows)
    dome = UsdLux.DomeLight.Get(stage, "/Episode/Lights/Dome")
    names = [op.GetOpName() for op in UsdGeom.Xformable(dome).GetOrderedXformOps()]
    dome.OrientToStageUpAxis()
    assert [op.GetOpName() for op in UsdGeom.Xformable(dome).GetOrderedXformOps()] == names
    bare = UsdLux.DomeLight.Define(stage, "/Bare")
    bare.OrientToStageUpAxis()
    (op,) = UsdGeom.Xformable(bare).GetOrderedXformOps()
    assert (op.GetOpName(), op.Get()) == (names[-1], dome.GetPrim().GetAttribute(names[-1]).Get())


@pytest.mark.parametrize(("azimuth", "polar"), [(0.0, 60.0), (90.0, 45.0), (-130.0, 20.0)])
def test_distant_lights_have_direction_angle_and_irradiance_of_the_sun(rows, azimuth, polar):
    light = sunny(azimuth, polar)
    stage = open_episode(rows, lights=(light, light))
    sun = UsdLux.DistantLight.Get(stage, "/Episode/Lights/Sun")
    direction = world_matrix(sun.GetPrim(), 0)[:3, :3] @ [0.0, 0.0, -1.0]
    np.testing.assert_allclose(direction, -toward(azimuth, polar, usd_sets.YAW), atol=1e-6)
    assert sun.GetNormalizeAttr().Get()
    assert np.radians(sun.GetAngleAttr().Get() / 2) == pytest.approx(np.arctan(separate_sun(light)[2]), rel=1e-5)
    irradiance = np.array(sun.GetColorAttr().Get()) * sun.GetIntensityAttr().Get()
    described = make_stage_light(0, light, 1.0)
    factor = described.intensity * 2.0**usd_sets.EXPOSURE
    np.testing.assert_allclose(irradiance, factor * np.array(described.sun_irradiance), rtol=1e-5)


def test_exposure_is_folded_into_the_intensity(stage):
    """Blender ignores inputs:exposure."""
    dome = UsdLux.DomeLight.Get(stage, "/Episode/Lights/Dome")
    light = make_stage_light(usd_sets.LIGHT, skies()[usd_sets.LIGHT], 1.0)
    assert dome.GetIntensityAttr().Get() == pytest.approx(light.intensity * 2.0**usd_sets.EXPOSURE)
    assert dome.GetExposureAttr().Get() == 0.0
    assert dome.GetPrim().GetAttribute("userProperties:exposure").Get() == usd_sets.EXPOSURE


@pytest.mark.parametrize("irradiance", [0.01, 3.0, 100.0])
@pytest.mark.parametrize("rows", [256, 512])
@pytest.mark.parametrize("sharpness", [100.0, 3000.0])
def test_map_and_sun_are_separated_like_in_the_renderer(irradiance, rows, sharpness):
    """Both for suns that become distant lights and for wide ones that stay discs in the map."""
    light = sunny(30.0, 50.0, irradiance, sharpness, rows)
    rest, beam, spread = separate_sun(light)
    table = light_tables.precompute_environment(light, None)
    lamps = table.lamps if sharpness == 3000.0 else []
    assert [lamp.radius_tangent for lamp in lamps] == pytest.approx([spread] * len(lamps), rel=1e-4)
    assert (spread > MAX_SUN_TANGENT) == (not beam.any()) == (sharpness == 100.0)
    np.testing.assert_allclose(beam, lamps[0].irradiance if lamps else np.zeros(3), rtol=1e-5)
    near = map_directions(256)[0] @ light.sun.direction > np.cos(np.radians(15.0))
    expected = table.lampless if lamps else table.radiance
    separated = resize_map(rest, 256)
    np.testing.assert_allclose(separated[~near], expected[~near], rtol=1e-4)
    solid = map_directions(256)[1]
    parts = [(image * solid[..., None])[near].sum(axis=0) for image in (separated, expected)]
    np.testing.assert_allclose(*parts, rtol=5e-3)
    if beam.any():
        np.testing.assert_allclose(separated, expected, rtol=1e-4)


def test_maps_without_a_sun_have_none_and_wide_suns_stay_in_the_map(stage, rows):
    light = sunny(30.0, 50.0, sharpness=100.0)
    for each in (stage, open_episode(rows, lights=(light, light))):
        assert not each.GetPrimAtPath("/Episode/Lights/Sun")


@pytest.mark.parametrize(
    "light", [*skies(), sunny(30.0, 50.0), replace(sunny(30.0, 50.0, sharpness=100.0), name="wide")], ids=lambda light: light.name
)
def test_intensity_matches_the_renderers_exposure(light):
    expected = light_tables.precompute_environment(light, None).exposure
    assert make_stage_light(0, light, 1.5).intensity == pytest.approx(1.5 * expected, rel=0.03)
