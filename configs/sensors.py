"""Settings of what real cameras do to a picture: effects on colour, and a depth camera. None of it is in the paper."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.fields import setting


@dataclass(frozen=True)
class Effects:
    """What a real camera does to colour. All are off by default; each view draws its own strengths, evenly, and they are recorded.

    A range is the least and the largest strength; 0, 0: off. Depth, ids and masks stay as they are.
    """

    exposure_jitter: float = setting(
        0.0,
        "stops",
        "A view's exposure is off by up to so much: a camera's automatic exposure changes from picture to picture.",
        low=0.0,
        high=5.0,
    )
    white_balance_jitter: float = setting(
        0.0,
        "stops",
        "Red and blue are off by up to so much, each on its own; 500 K more at 5,500 K are 0.12 more blue and 0.06 less red.",
        low=0.0,
        high=2.0,
    )
    vignette: tuple[float, float] = setting(
        (0.0, 0.0), "", "Share of light that is lost in the picture's corner; towards the middle it falls off as cos⁴.", low=0.0, high=1.0
    )
    chromatic_aberration: tuple[float, float] = setting(
        (0.0, 0.0),
        "px",
        "In the corner, red lies farther out by so much and blue as much farther in; negative: the reverse.",
        low=-16.0,
        high=16.0,
    )
    blur: tuple[float, float] = setting(
        (0.0, 0.0), "px", "Standard deviation of a Gaussian blur: what is out of focus.", low=0.0, high=16.0
    )
    shot_noise: tuple[float, float] = setting(
        (0.0, 0.0),
        "",
        "Standard deviation at full scale, as a share of it; a pixel of N electrons has 1/√N: 0.01 with 10,000.",
        low=0.0,
        high=1.0,
    )
    read_noise: tuple[float, float] = setting(
        (0.0, 0.0), "", "Standard deviation of the noise that does not depend on light, as a share of full scale.", low=0.0, high=1.0
    )
    jpeg_quality: tuple[int, int] = setting((0, 0), "", "Least and largest JPEG quality; 0, 0: bop.jpeg_quality.", low=0, high=100)


def effect_ranges(effects: Effects) -> dict[str, tuple[float, float]]:
    """Least and largest strength of every effect, in the order of `Effect`; 0, 0: off."""
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
    }


@dataclass(frozen=True)
class DepthSensor:
    """A depth camera that finds disparities between the camera and a projector beside it, for the layer depth_sensor.

    Noise grows as sigma_z = noise + noise_growth (z - noise_distance)² + noise_angle / √z · (θ / (π/2 - θ))², as Nguyen, Izadi and
    Lovell (3DIMPVT 2012) measured it of a Kinect, with z in m and θ the angle of incidence.
    """

    baseline: float = setting(0.075, "m", "The projector stands so far to the camera's right (Khoshelham and Elberink, 2012).", above=0.0)
    disparity_step: float = setting(
        0.125,
        "px",
        "Disparities are multiples of this, so depth is in steps of z² / (f · baseline) times it (Khoshelham and Elberink).",
        above=0.0,
        high=16.0,
    )
    distances: tuple[float, float] = setting((0.4, 5.0), "m", "Nearest and farthest depth that is measured.", above=0.0)
    noise: float = setting(0.0012, "m", "Noise at noise_distance (Nguyen et al.).", low=0.0)
    noise_growth: float = setting(0.0019, "1/m", "Growth of noise with the square of depth (Nguyen et al.).", low=0.0)
    noise_distance: float = setting(0.4, "m", "Depth of least noise (Nguyen et al.).", low=0.0)
    noise_angle: float = setting(1e-4, "m^1.5", "Growth of noise with the angle of incidence (Nguyen et al.).", low=0.0)
    lateral_noise: float = setting(
        0.5,
        "px",
        "A pixel sees a surface that lies off by so much, as standard deviation: ragged edges (Handa et al., 2014).",
        low=0.0,
        high=16.0,
    )
    grazing_angle: float = setting(80.0, "°", "No depth where a ray meets a surface at a larger angle of incidence.", above=0.0, high=89.0)
    edge_width: int = setting(1, "px", "No depth so near to an edge, where the window that is matched sees two surfaces.", low=0, high=16)
    edge_step: float = setting(1.0, "px", "An edge is a step of disparity by more.", above=0.0)
    shadows: bool = setting(True, "", "No depth where something hides the projector.")
