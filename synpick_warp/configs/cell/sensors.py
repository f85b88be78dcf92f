"""Settings of sensor models: camera effects on colour images, and a depth camera. None of it is in the paper."""

from dataclasses import dataclass
from typing import Annotated

from synpick_warp.codes import Effect, names
from synpick_warp.configs.calibration.tables import SENSORS
from synpick_warp.configs.fields import Fraction, setting


@dataclass(frozen=True)
class Effects:
    """Camera effects on colour images, all off by default. Each view draws its parameters uniformly from these ranges (minimum, maximum; 0,
    0: off), and they are recorded. Not in the paper.
    """

    exposure_jitter: Annotated[float, "[0, 5] EV"] = setting(0.0, "Half width of each view's random exposure offset.")
    white_balance_jitter: Annotated[float, "[0, 2] EV"] = setting(
        0.0, "Half width of random gains of red and of blue; 500 K more at 5,500 K are 0.12 EV more blue, 0.06 EV less red."
    )
    vignette: Annotated[tuple[float, float], "[0, 1]"] = setting(
        (0.0, 0.0), "Fraction of light lost in the image corners, with cos⁴ falloff towards the centre."
    )
    chromatic_aberration: Annotated[tuple[float, float], "[-16, 16] px"] = setting(
        (0.0, 0.0), "Lateral chromatic aberration in the corners: red is displaced outward and blue inward; negative: the reverse."
    )
    blur: Annotated[tuple[float, float], "[0, 16] px"] = setting((0.0, 0.0), "Standard deviation of a Gaussian blur, as by defocus.")
    shot_noise: Annotated[tuple[float, float], "[0, 1]"] = setting(
        (0.0, 0.0), "Standard deviation of shot noise at full scale, relative to it: 1/√N of a full well of N electrons."
    )
    read_noise: Annotated[tuple[float, float], "[0, 1]"] = setting((0.0, 0.0), "Standard deviation of read noise, relative to full scale.")
    jpeg_quality: Annotated[tuple[int, int], "[0, 100]"] = setting((0, 0), "JPEG quality; 0, 0: bop.jpeg_quality.")
    contrast: Annotated[tuple[float, float], "[-0.9, 4]"] = setting(
        (0.0, 0.0), "Relative change of the contrast of sRGB values about their middle."
    )
    saturation: Annotated[tuple[float, float], "[-1, 4]"] = setting(
        (0.0, 0.0), "Relative change of the difference of sRGB values to their luma; -1: grey."
    )


def effect_ranges(effects: Effects) -> dict[str, tuple[float, float]]:
    """Minimum and maximum of each parameter of the camera effects, in the order of `Effect`; 0, 0: off."""
    spreads = {"exposure": effects.exposure_jitter, "red": effects.white_balance_jitter, "blue": effects.white_balance_jitter}
    return {name: (-spreads[name], spreads[name]) if name in spreads else getattr(effects, name) for name in names(Effect)}


@dataclass(frozen=True)
class DepthSensor:
    """Depth camera model: structured light for the layer depth_sensor; for ir_left, ir_right and depth_stereo an active stereo camera,
    which of the settings above projector has baseline, disparity_step, max_disparity and distances. Axial noise is sigma_z = noise +
    noise_growth (z - noise_distance)² + noise_angle / √z · (θ / (π/2 - θ))² (Nguyen, Izadi and Lovell, 3DIMPVT 2012), with z in m and θ the
    angle of incidence; noise of disparity adds z² disparity_noise / (f · baseline). Not in the paper.
    """

    preset: str = setting("", "Sensor that sets what is not set beside it, [as listed](#sensor-presets).", choices=("", *SENSORS))
    baseline: Annotated[float, "(0, 1] m"] = setting(
        0.075, "Distance from the camera to the projector at its right (Khoshelham and Elberink, 2012), or to the right camera."
    )
    disparity_step: Annotated[float, "(0, 16] px"] = setting(
        0.125, "Disparity quantization: depth steps of z² / (f · baseline) times this (Khoshelham and Elberink, 2012)."
    )
    disparity_noise: Annotated[float, "[0, 16] px"] = setting(
        0.0, "Standard deviation of disparity: depth noise of z² / (f · baseline) times this."
    )
    max_disparity: Annotated[float, "[0, 1e4] px"] = setting(
        0.0, "Largest disparity that is searched: the least depth is f · baseline / max_disparity; 0: no limit."
    )
    distances: Annotated[tuple[float, float], "(0, 100] m"] = setting((0.4, 5.0), "Minimum and maximum depth that is measured.")
    noise: Annotated[float, "[0, 1] m"] = setting(0.0012, "Axial noise at noise_distance, as standard deviation.")
    noise_growth: Annotated[float, "[0, 1] 1/m"] = setting(0.0019, "Quadratic growth of axial noise with depth.")
    noise_distance: Annotated[float, "[0, 100] m"] = setting(0.4, "Depth of minimum axial noise.")
    noise_angle: Annotated[float, "[0, 1] m^1.5"] = setting(1e-4, "Growth of axial noise with the angle of incidence.")
    lateral_noise: Annotated[float, "[0, 16] px"] = setting(
        0.5, "Standard deviation of the pixel offset at which depth is sampled: ragged edges (Handa et al., 2014)."
    )
    noise_width: Annotated[int, "[1, 64] px"] = setting(
        1, "Distance of lattice points between which noise is interpolated, so that neighbours' noise correlates; 1: each pixel its own."
    )
    grazing_angle: Annotated[float, "[10, 89] °"] = setting(80.0, "Angle of incidence above which there is no depth.")
    edge_width: Annotated[int, "[0, 16] px"] = setting(1, "Distance to a disparity edge below which there is no depth.")
    edge_step: Annotated[float, "(0, 1e3] px"] = setting(1.0, "Disparity difference that makes an edge.")
    shadows: bool = setting(True, "No depth where the projector is occluded, or the infrared camera that registration names.")
    registration: Fraction = setting(
        0.0,
        "Place on the baseline of the camera to whose image depth is registered: 0 the infrared camera, 1 the projector; in between, "
        "shadows at both sides of objects.",
    )
    projector: Fraction = setting(0.5, "Place of a stereo camera's dot projector on its baseline: 0 left, 1 right camera.")
    dot_spacing: Annotated[float, "[2, 64] px"] = setting(
        4.0, "Width of a cell of the projected pattern, which has one dot at a random place."
    )
    dot_brightness: Annotated[float, "[0, 1e3]"] = setting(
        2.0, "Brightness of projected dots on a white surface at 1 m, relative to full scale; 0: no pattern."
    )
    ambient: Annotated[float, "[0, 10]"] = setting(
        0.25, "Brightness of infrared images by ambient light, relative to that of colour images."
    )
    infrared_noise: Fraction = setting(0.005, "Standard deviation of noise in infrared images, relative to full scale.")
