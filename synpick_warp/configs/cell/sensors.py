"""Settings of sensor models: camera effects on colour images, and a depth camera. None of it is in the paper."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.calibration.sensor_presets import SENSORS
from synpick_warp.configs.fields import setting


@dataclass(frozen=True)
class Effects:
    """Camera effects on colour images, all off by default. Depth, ids and masks are not affected.

    Each view draws its own parameters uniformly from these ranges (minimum, maximum; 0, 0: off), and they are recorded. Not in the paper.
    """

    exposure_jitter: float = setting(
        0.0,
        "EV",
        "Half width of the uniform random exposure offset of each view, as by a camera's automatic exposure.",
        low=0.0,
        high=5.0,
    )
    white_balance_jitter: float = setting(
        0.0,
        "EV",
        "Half width of the uniform random gains of red and of blue; 500 K more at 5,500 K are 0.12 EV more blue and 0.06 EV less red.",
        low=0.0,
        high=2.0,
    )
    vignette: tuple[float, float] = setting(
        (0.0, 0.0), "", "Fraction of light lost in the image corners, with cos⁴ falloff towards the centre.", low=0.0, high=1.0
    )
    chromatic_aberration: tuple[float, float] = setting(
        (0.0, 0.0),
        "px",
        "Lateral chromatic aberration in the image corners: red is displaced outward and blue inward by this; negative: the reverse.",
        low=-16.0,
        high=16.0,
    )
    blur: tuple[float, float] = setting((0.0, 0.0), "px", "Standard deviation of a Gaussian blur, as by defocus.", low=0.0, high=16.0)
    shot_noise: tuple[float, float] = setting(
        (0.0, 0.0),
        "",
        "Standard deviation of shot noise at full scale, relative to it; a full well of N electrons has 1/√N: 0.01 for 10,000.",
        low=0.0,
        high=1.0,
    )
    read_noise: tuple[float, float] = setting(
        (0.0, 0.0), "", "Standard deviation of signal-independent read noise, relative to full scale.", low=0.0, high=1.0
    )
    jpeg_quality: tuple[int, int] = setting((0, 0), "", "JPEG quality; 0, 0: bop.jpeg_quality.", low=0, high=100)
    contrast: tuple[float, float] = setting(
        (0.0, 0.0),
        "",
        "Relative change of the contrast of sRGB values about their middle, as by a camera's processing.",
        low=-0.9,
        high=4.0,
    )
    saturation: tuple[float, float] = setting(
        (0.0, 0.0), "", "Relative change of the difference of sRGB values to their luma; -1: grey.", low=-1.0, high=4.0
    )


def effect_ranges(effects: Effects) -> dict[str, tuple[float, float]]:
    """Minimum and maximum of each parameter of the camera effects, in the order of `Effect`; 0, 0: off."""
    exposure, balance = effects.exposure_jitter, effects.white_balance_jitter
    return {
        "exposure": (-exposure, exposure),
        "red": (-balance, balance),
        "blue": (-balance, balance),
        "vignette": effects.vignette,
        "chromatic_aberration": effects.chromatic_aberration,
        "blur": effects.blur,
        "shot_noise": effects.shot_noise,
        "read_noise": effects.read_noise,
        "jpeg_quality": effects.jpeg_quality,
        "contrast": effects.contrast,
        "saturation": effects.saturation,
    }


@dataclass(frozen=True)
class DepthSensor:
    """Depth camera model: for the layer depth_sensor structured light, with disparity quantization, noise, lateral noise and holes; for the
    layers ir_left, ir_right and depth_stereo an active stereo camera, whose depth is matched from its images. Of the settings above
    projector the latter has baseline, disparity_step, max_disparity and distances.

    Axial noise is sigma_z = noise + noise_growth (z - noise_distance)² + noise_angle / √z · (θ / (π/2 - θ))², as Nguyen, Izadi and
    Lovell (3DIMPVT 2012) measured for a Kinect, with z in m and θ the angle of incidence: a law of depth alone, whatever the lens. Noise
    of disparity adds z² disparity_noise / (f · baseline), which is that of stereo and of projected patterns. Not in the paper.
    """

    preset: str = setting(
        "",
        "",
        "Sensor that sets baseline, noise, quantization and range, [as listed](#sensor-presets), unless they are set beside it.",
        choices=("", *SENSORS),
    )
    baseline: float = setting(
        0.075,
        "m",
        "Distance from the camera to the projector at its right (Khoshelham and Elberink, 2012), or to the right one of two cameras.",
        above=0.0,
        high=1.0,
    )
    disparity_step: float = setting(
        0.125,
        "px",
        "Disparity quantization, which makes depth steps of z² / (f · baseline) times this (Khoshelham and Elberink, 2012).",
        above=0.0,
        high=16.0,
    )
    disparity_noise: float = setting(
        0.0, "px", "Standard deviation of disparity, which makes depth noise z² / (f · baseline) times this.", low=0.0, high=16.0
    )
    max_disparity: float = setting(
        0.0, "px", "Largest disparity that is searched, so the least depth is f · baseline / max_disparity; 0: no limit.", low=0.0, high=1e4
    )
    distances: tuple[float, float] = setting((0.4, 5.0), "m", "Minimum and maximum depth that is measured.", above=0.0, high=100.0)
    noise: float = setting(0.0012, "m", "Axial noise at noise_distance, as standard deviation (Nguyen et al., 2012).", low=0.0, high=1.0)
    noise_growth: float = setting(0.0019, "1/m", "Quadratic growth of axial noise with depth (Nguyen et al., 2012).", low=0.0, high=1.0)
    noise_distance: float = setting(0.4, "m", "Depth of minimum axial noise (Nguyen et al., 2012).", low=0.0, high=100.0)
    noise_angle: float = setting(
        1e-4, "m^1.5", "Growth of axial noise with the angle of incidence (Nguyen et al., 2012).", low=0.0, high=1.0
    )
    lateral_noise: float = setting(
        0.5,
        "px",
        "Standard deviation of the pixel offset at which depth is sampled, which makes edges ragged (Handa et al., 2014).",
        low=0.0,
        high=16.0,
    )
    noise_width: int = setting(
        1,
        "px",
        "Distance of lattice points between which noise, axial and lateral, is interpolated, so that neighbours' noise is correlated; 1: "
        "each pixel has noise of its own.",
        low=1,
        high=64,
    )
    grazing_angle: float = setting(80.0, "°", "Angle of incidence above which there is no depth.", low=10.0, high=89.0)
    edge_width: int = setting(
        1,
        "px",
        "Distance to a disparity edge below which there is no depth, since the matching window covers two surfaces.",
        low=0,
        high=16,
    )
    edge_step: float = setting(1.0, "px", "Disparity difference that makes an edge.", above=0.0, high=1e3)
    shadows: bool = setting(True, "", "No depth where the projector is occluded, or the infrared camera that registration names.")
    registration: float = setting(
        0.0,
        "",
        "Place on the baseline of the camera to whose image depth is registered: 0 that of the infrared camera itself, 1 that of the "
        "projector. In between there are shadows at both sides of objects.",
        low=0.0,
        high=1.0,
    )
    projector: float = setting(
        0.5, "", "Place of a stereo camera's dot projector on its baseline: 0 at the left camera, 1 at the right one.", low=0.0, high=1.0
    )
    dot_spacing: float = setting(
        4.0,
        "px",
        "Width of a cell of the projected pattern, which has one dot at a random place; in pixels of the camera.",
        low=2.0,
        high=64.0,
    )
    dot_brightness: float = setting(
        2.0,
        "",
        "Brightness of projected dots on a white surface at 1 m, relative to full scale; it falls with the square of depth; 0: no pattern.",
        low=0.0,
        high=1e3,
    )
    ambient: float = setting(
        0.25, "", "Brightness of infrared images by ambient light, relative to that of colour images, without shadows.", low=0.0, high=10.0
    )
    infrared_noise: float = setting(0.005, "", "Standard deviation of noise in infrared images, relative to full scale.", low=0.0, high=1.0)
