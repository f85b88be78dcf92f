"""Presets of depth cameras on the market: intrinsics of the depth image, baseline, noise and depth range, each value with its source.

A preset sets `depth_sensor.*`. Its noise is noise of disparity, from which depth noise follows by focal length and baseline:
sigma_z = z² sigma_d / (f b). Two cameras of one model differ by some pixels: a calibration of the own camera is better.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from synpick_warp.configs.calibration.files import Calibration

PUBLISHED = "published"
"""Trust: stated by the manufacturer."""
MEASURED = "measured"
"""Trust: measured on single cameras by others, quoted from them, or computed from such or published values."""
ASSUMED = "assumed"
"""Trust: an assumption, where nothing is public or the source could not be read."""
DEFINED = "defined"
"""Trust: by definition of the ideal sensor."""
NO_OTHER_NOISE: dict[str, Any] = {"noise": 0.0, "noise_growth": 0.0, "noise_angle": 0.0}
"""Settings of all presets: the only noise is that of disparity and of the pixel's position."""


class Figure(NamedTuple):
    """Value of a preset, how it is known (PUBLISHED, MEASURED, ASSUMED or DEFINED), and its source in words."""

    value: Any
    trust: str
    source: str


_MIDDLE = "middle of the image"
_FRAMES = "ten frames of YCB-Video (tools/reports/sensor)"
_D400 = {
    "disparity_noise": Figure(0.08, ASSUMED, "a usual figure for well textured surfaces; the manufacturer states depth errors only"),
    "disparity_step": Figure(1 / 32, ASSUMED, "five fractional bits, as in librealsense's disparity format"),
    "max_disparity": Figure(126.0, PUBLISHED, "largest disparity searched, hence the least distance f b / 126 (librealsense, issue 3039)"),
    "distances": Figure((0.1, 10.0), ASSUMED, "the least distance follows from max_disparity; no other limit is known nearby"),
    "lateral_noise": Figure(0.5, ASSUMED, "as of other stereo sensors with block matching (Handa et al., 2014)"),
}
"""Values of all sensors of this series."""
_ABOVE = Figure(1.0, ASSUMED, "within the range in which noise is below 3 mm")

SENSORS: dict[str, dict[str, Figure]] = {
    "d435": {
        "resolution": Figure((1280, 720), PUBLISHED, "full depth image"),
        "focal": Figure((645.0, 645.0), MEASURED, "white paper of Intel as quoted by others; lens 1.93 mm, pixel 3 µm"),
        "center": Figure((640.0, 360.0), ASSUMED, _MIDDLE),
        "height": _ABOVE,
        "baseline": Figure(0.050, ASSUMED, "of the D400 series' data sheet, as quoted by others"),
        **_D400,
    },
    "d415": {
        "resolution": Figure((1280, 720), PUBLISHED, "full depth image"),
        "focal": Figure((940.0, 940.0), MEASURED, "white paper of Intel as quoted by others; SAPIEN has 920"),
        "center": Figure((640.0, 360.0), ASSUMED, _MIDDLE),
        "height": _ABOVE,
        "baseline": Figure(0.055, ASSUMED, "of the D400 series' data sheet, as quoted by others"),
        **_D400,
    },
    "d455": {
        "resolution": Figure((1280, 800), PUBLISHED, "full colour image"),
        "focal": Figure((629.6, 629.6), MEASURED, "colour camera of one unit (Hand_Tools, ABC-iRobotics), taken for the depth image"),
        "center": Figure((629.6, 398.0), MEASURED, "source of the focal length; 0.5 added for pixel centres at + 0.5"),
        "height": _ABOVE,
        "baseline": Figure(0.095, ASSUMED, "as commonly stated; not found in a document of the manufacturer"),
        **_D400,
    },
    "xtion": {
        "resolution": Figure((640, 480), PUBLISHED, "depth image"),
        "focal": Figure((1066.8, 1067.5), MEASURED, "YCB-Video's camera, to whose colour image depth is registered (oprb/ycbvideo)"),
        "center": Figure((313.5, 241.8), MEASURED, "source of the focal length; 0.5 added for pixel centres at + 0.5"),
        "height": _ABOVE,
        "baseline": Figure(0.075, MEASURED, "of the Kinect, with the same sensor (Khoshelham and Elberink, 2012)"),
        "disparity_noise": Figure(0.13, MEASURED, f"{_FRAMES}: 1.77 mm at 1 m in one sequence, 1.55 mm in the other"),
        "disparity_step": Figure(
            0.03, MEASURED, f"{_FRAMES}: up to 1.9 m no millimetre is skipped, as registration interpolates between steps of 1/8 px"
        ),
        "distances": Figure((0.4, 5.0), MEASURED, f"{_FRAMES}: least depth; the greatest is an assumption, usual for the Kinect"),
        "lateral_noise": Figure(
            1.3, MEASURED, f"{_FRAMES}: 1.22 and 1.32 px; Nguyen et al. (2012): 0.8 px at a focal length of 580 px, so 1.5 px here"
        ),
        "noise_width": Figure(8, MEASURED, f"{_FRAMES}: errors of pixels 4 px apart correlate by 0.54, 8 px apart by 0.25"),
        "registration": Figure(0.5, MEASURED, f"{_FRAMES}: shadows on both sides of objects, about equally wide"),
        "edge_width": Figure(2, MEASURED, f"{_FRAMES}: about one pixel of the sensor before registration"),
        "edge_step": Figure(4.0, MEASURED, f"{_FRAMES}: below 3 px most edges have no holes"),
        "grazing_angle": Figure(
            76.0, MEASURED, f"{_FRAMES}: a tenth to a half of the pixels is lost at 70°, a quarter to three quarters at 75°"
        ),
    },
    "zivid2p_m130": {
        "resolution": Figure((2448, 2048), PUBLISHED, "page on sampling of support.zivid.com"),
        "focal": Figure((4062.5, 4062.5), MEASURED, "computed from 0.32 mm a pixel at 1.3 m (support.zivid.com)"),
        "center": Figure((1224.0, 1024.0), ASSUMED, _MIDDLE),
        "height": Figure(1.3, PUBLISHED, "the distance that the product is named after"),
        "baseline": Figure(0.110, ASSUMED, "not public; a guess from the housing's width"),
        "disparity_noise": Figure(0.03, ASSUMED, "not public; 0.11 mm of noise at 1.3 m"),
        "disparity_step": Figure(1 / 256, ASSUMED, "not public; phase is not quantized to pixels"),
        "distances": Figure((0.8, 2.0), ASSUMED, "about the distance of 1.3 m"),
        "lateral_noise": Figure(0.0, ASSUMED, "each pixel is measured by itself"),
    },
    "ideal": {
        "disparity_noise": Figure(0.0, DEFINED, "no noise"),
        "disparity_step": Figure(1e-5, DEFINED, "finer than depth images are"),
        "distances": Figure((0.001, 100.0), DEFINED, "all"),
        "lateral_noise": Figure(0.0, DEFINED, "no noise"),
        "grazing_angle": Figure(89.0, DEFINED, "the limit of the setting"),
        "edge_width": Figure(0, DEFINED, "no holes at edges"),
        "shadows": Figure(False, DEFINED, "no holes beside objects"),
    },
}
"""Values of each preset. `focal` is fx, fy, `center` cx, cy with pixel centres at + 0.5 [px]; `height`, the distance above the bin at
which it is mounted [m], serves documentation; all others are settings of `depth_sensor`. The depth image has no distortion."""
_CAMERA = ("resolution", "focal", "center", "height")
"""Values that are no settings of `depth_sensor`."""


def sensor_settings(name: str) -> dict[str, Any]:
    """Settings of the section `depth_sensor` that a preset stands for; none for an empty or unknown name."""
    figures = SENSORS.get(name, {})
    known = {key: figure.value for key, figure in figures.items() if key not in _CAMERA}
    return {**NO_OTHER_NOISE, "max_disparity": 0.0, **known} if figures else {}


def sensor_camera(name: str) -> Calibration | None:
    """Resolution and intrinsics of a known preset's depth image; None: it has no camera of its own, as `ideal`."""
    figures = SENSORS[name]
    if "focal" not in figures:
        return None
    return Calibration(*figures["resolution"].value, *figures["focal"].value, *figures["center"].value)
