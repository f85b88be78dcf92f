"""Lens distortion: OpenCV's pinhole model with 4, 5, 8 or 12 coefficients, and its fisheye model with 4, forward and inverse, in float64.

A point (x, y, 1) in camera axes lies at (x, y) in the normalised image plane. A lens maps this plane to itself, and fx, fy, cx, cy map the
result to pixels, whose centres are at + 0.5. The pinhole model is that of Brown (1971) with the rational and thin-prism terms of OpenCV,
the fisheye model that of Kannala and Brandt (2006).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.configs.calibration.files import COUNTS, FISHEYE, MAX_NUMBER, PINHOLE
from synpick_warp.errors import ConfigError, format_value
from synpick_warp.system.linear_algebra import matmul

MAX_ANGLE = 85.0
"""Largest angle between a ray and the optical axis [°]; planar depth and the normalised plane end at 90°."""
BORDER = 8
"""Width of the border around the image within which the lens is not yet continued linearly [px]: the size of a tile."""
TOLERANCE = 1e-9
"""Largest distance between a pixel and the projection of its ray [px]."""
_MAX_STEPS = 60
"""Newton steps; a handful are usual."""
_HALVINGS = 12
"""Most halvings of a Newton step."""
_RADII, _ANGLES = 2048, 48
"""Samples of the plane in polar coordinates, for the search of folds."""
_EDGE = 256
"""Most samples of an edge of the image."""
_BOUND_MARGIN = 1.1
"""Factor on sampled maxima."""
_REACH = 8.0
"""Radius, in radii of the domain, to which the linear continuation is checked; farther out it is straighter still."""
_CLOSE = 1e-8
"""Squared radius below which the fisheye model is evaluated by its series."""
_BLOCK = 2**18
"""Pixels whose rays are found at a time."""


@dataclass(frozen=True)
class Lens:
    """Distortion model and its coefficients, in OpenCV's order. Raises ConfigError: there is no such model, it has another number of
    coefficients, or one is not finite or absurdly large."""

    model: str = PINHOLE
    coefficients: tuple[float, ...] = (0.0,) * 4

    def __post_init__(self) -> None:
        if self.model not in COUNTS:
            raise ConfigError(f"distortion has the model {format_value(self.model)}; allowed: {', '.join(COUNTS)}")
        if len(self.coefficients) not in COUNTS[self.model]:
            allowed = " or ".join(map(str, COUNTS[self.model]))
            raise ConfigError(f"distortion has {len(self.coefficients)} coefficients; allowed: {allowed} with the model {self.model}")
        if not (np.abs(self.coefficients) <= MAX_NUMBER).all():
            given = format_value(list(self.coefficients))
            raise ConfigError(f"distortion has coefficients that are not finite or above {MAX_NUMBER:g}: {given}; give numbers")

    @property
    def is_identity(self) -> bool:
        """Whether nothing is distorted."""
        return self.model == PINHOLE and not any(self.coefficients)

    def linearize(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distorted points (..., 2) and Jacobian matrices (..., 2, 2) at points (..., 2) of the normalised plane."""
        x, y = points[..., 0], points[..., 1]
        square = x * x + y * y
        scale, slope = self._radial(square)
        _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = self._padded()
        image = np.stack(
            (
                x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square),
                y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square),
            ),
            axis=-1,
        )
        prism_x, prism_y = 2 * (s1 + 2 * s2 * square), 2 * (s3 + 2 * s4 * square)
        shared = 2 * (slope * x * y + p1 * x + p2 * y)
        jacobian = np.stack(
            (
                scale + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + prism_x * x,
                shared + prism_x * y,
                shared + prism_y * x,
                scale + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + prism_y * y,
            ),
            axis=-1,
        )
        return image, jacobian.reshape(*points.shape, 2)

    def _padded(self) -> tuple[float, ...]:
        """The twelve coefficients of the pinhole model, zeros with a fisheye model."""
        given = self.coefficients if self.model == PINHOLE else ()
        return (*given, *(0.0,) * (12 - len(given)))

    def _radial(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radial scale of points with the given squared radius, and its derivative by the squared radius."""
        if self.model == FISHEYE:
            return self._fisheye(square)
        k1, k2, _, _, k3, k4, k5, k6 = self._padded()[:8]
        above, below = 1 + square * (k1 + square * (k2 + square * k3)), 1 + square * (k4 + square * (k5 + square * k6))
        above_slope, below_slope = k1 + square * (2 * k2 + 3 * square * k3), k4 + square * (2 * k5 + 3 * square * k6)
        return above / below, (above_slope * below - above * below_slope) / (below * below)

    def _fisheye(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `_radial`, of the fisheye model: angles θ are at the radius θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)."""
        k1, k2, k3, k4 = self.coefficients
        radius = np.sqrt(np.maximum(square, _CLOSE))
        angle = np.arctan(radius)
        even = angle * angle
        scale = angle * (1 + even * (k1 + even * (k2 + even * (k3 + even * k4)))) / radius
        growth = (1 + even * (3 * k1 + even * (5 * k2 + even * (7 * k3 + even * 9 * k4)))) / (1 + radius * radius)
        slope = np.where(square < _CLOSE, k1 - 1 / 3, (growth - scale) / (2 * radius * radius))
        return np.where(square < _CLOSE, 1 + (k1 - 1 / 3) * square, scale), slope

    def pole(self) -> float:
        """Radius at which the denominator of the rational model vanishes; infinity if it never does."""
        # Roots of the reversed polynomial are the inverse squared radii; it does not lose its degree to coefficients that are 0.
        roots = np.roots((1.0, *self._padded()[5:8]))
        real = roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 1e-9)]
        return float(1 / np.sqrt(real.max())) if len(real) else np.inf


def read_lens(camera: Mapping[str, Any], size: tuple[int, int]) -> LensMap | None:
    """Projection of an entry of scene_camera.json, by its `cam_K`, `cam_dist` and `cam_dist_model`, for images of this size [px]; None: a
    pinhole. Raises ConfigError: the values are none of a lens that covers the image."""
    if not camera.get("cam_dist"):
        return None
    try:
        coefficients = tuple(float(value) for value in camera["cam_dist"])
        fx, _, cx, _, fy, cy, *_ = (float(value) for value in camera["cam_K"])
    except (TypeError, ValueError, KeyError):
        raise ConfigError(f"cam_dist is {format_value(camera['cam_dist'])}; allowed: OpenCV's coefficients beside cam_K") from None
    made = make_lens_map(str(camera.get("cam_dist_model", PINHOLE)), coefficients, (fx, fy, cx, cy), size)
    return None if made.lens.is_identity else made


@functools.lru_cache(maxsize=4096)
def make_lens_map(
    model: str, coefficients: tuple[float, ...], intrinsics: tuple[float, float, float, float], size: tuple[int, int]
) -> LensMap:
    """Projection through a lens, as of `LensMap`; made once for the same numbers."""
    return LensMap(Lens(model, coefficients), intrinsics, size)


def pixel_rays(matrix: np.ndarray, lens: LensMap | None, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rays (x, y, 1) of pixels' centres: x and y (height, width) float32, for a camera matrix (3, 3) [px], or a lens, and width and height
    of the image [px]. Rays of the lenses used last are kept."""
    if lens is not None:
        return _rays_of(lens)
    (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
    y = (np.arange(size[1])[:, None] + 0.5 - cy) / fy
    x = (np.arange(size[0]) + 0.5 - cx - skew * y) / fx
    return x.astype(np.float32), np.broadcast_to(y, x.shape).astype(np.float32)


@functools.lru_cache(maxsize=4)
def _rays_of(lens: LensMap) -> tuple[np.ndarray, np.ndarray]:
    """The two components of `LensMap.rays`, not writable."""
    rays = lens.rays()
    rays.flags.writeable = False
    return rays[..., 0], rays[..., 1]


def with_matrix(lens: LensMap | None, matrix: np.ndarray, size: tuple[int, int] | None = None) -> LensMap | None:
    """The same lens before a sensor with another camera matrix (3, 3) [px], and of another size [px] unless None; None: a pinhole. Raises
    ConfigError: the lens does not cover the image."""
    if lens is None:
        return None
    fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return make_lens_map(lens.lens.model, lens.lens.coefficients, (fx, fy, cx, cy), size or lens.size)


class LensMap:
    """Projection of the normalised plane to the pixels of an image through a lens, continued linearly beyond the image, and its inverse.

    Within `radius`, which covers the image and a border of 8 px, the projection is the lens's; beyond, it is linear along each direction
    from the axis. So every point in front of the camera has one place, and nothing outside of the image is folded into it.
    """

    radius: float
    """Radius of the disc of the normalised plane within which the lens is not continued."""
    bend: float
    """Upper bound of the second derivative of the projection in any direction [px]. The image of a straight segment of length L in the
    normalised plane is nowhere farther than bend L² / 8 from its chord [px]."""
    stretch: float
    """Upper bound of the distance of two rays in the normalised plane, by the distance of their pixels [1/px]."""

    def __init__(self, lens: Lens, intrinsics: tuple[float, float, float, float], size: tuple[int, int]) -> None:
        """Distortion, fx, fy, cx, cy [px], and width and height of the image [px]. Raises ConfigError: the distortion folds over inside the
        image, a pixel's ray is more than MAX_ANGLE off the axis, or intrinsics are none of an image."""
        if not (min(intrinsics[:2]) > 1 / MAX_NUMBER and (np.abs(intrinsics) <= MAX_NUMBER).all()):
            raise ConfigError(
                f"fx, fy, cx, cy are {format_value(list(intrinsics))}; allowed: focal lengths above 0 and a centre in the image"
            )
        self.lens, self.size = lens, size
        self._focal, self._center = np.array(intrinsics[:2], float), np.array(intrinsics[2:], float)
        limit, folds = _limit(lens)
        inner = np.abs(self._rays_of_border(0, limit))
        if not (inner <= limit).all():
            raise ConfigError(self._refusal(limit, folds))
        outer, inside = np.max(self._rays_of_border(BORDER, limit)), np.max(inner)
        # Close to a fold the lens cannot be continued: the slope there is 0.
        self.radius = float(min(1.02 * outer, inside + 0.9 * (limit - inside)))
        self.bend, self.stretch = self._bounds()

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates (..., 2) of points (..., 2) of the normalised plane."""
        return self._continued(np.asarray(points, float))[0] * self._focal + self._center

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the normalised plane that are projected to `pixels` (..., 2), by Newton's method with damped steps. Raises
        ConfigError: A pixel's ray was not found."""
        pixels = np.asarray(pixels, float)
        goal = ((pixels - self._center) / self._focal).reshape(-1, 2)
        rays = np.concatenate([self._invert(part) for part in np.array_split(goal, -(-len(goal) // _BLOCK) or 1)])
        return rays.reshape(pixels.shape)

    def rays(self) -> np.ndarray:
        """Ray (x, y, 1) of each pixel's centre: (height, width, 2) float32."""
        return self.unproject(_pixel_centers(self.size)).astype(np.float32)

    def cropped(self, left: int, top: int, size: tuple[int, int]) -> LensMap:
        """The same projection with its origin at a pixel of the image, for an image of another size, which may reach beyond this one."""
        made = copy.copy(self)
        made.size, made._center = size, self._center - (left, top)
        return made

    def undistortion_maps(self) -> np.ndarray:
        """Maps (2, height, width) float32 for `cv2.remap`, x and y: where each pixel of the undistorted picture lies in the distorted one.

        The undistorted picture is that of a pinhole camera of the same fx, fy, cx, cy. Pixel centres are at integers, as in OpenCV.
        """
        places = self.project((_pixel_centers(self.size) - self._center) / self._focal) - 0.5
        return np.ascontiguousarray(np.moveaxis(places, -1, 0), np.float32)

    def _rays_of_border(self, border: int, limit: float) -> np.ndarray:
        """Radii of the rays of an enlarged image's edge; infinity where no ray within `limit` has such a pixel."""
        x, y = (np.linspace(-border, side + border, min(side, _EDGE) + 1) for side in self.size)
        pixels = np.concatenate([np.stack(np.broadcast_arrays(*pair), -1) for pair in ((x, y[0]), (x, y[-1]), (x[0], y), (x[-1], y))])
        goal = (pixels - self._center) / self._focal
        self.radius = limit
        edge, _ = self.lens.linearize(limit * _directions(2048))
        found = np.full(len(goal), np.inf)
        inside = _winding(edge, goal) == 1
        if inside.any():
            found[inside] = np.linalg.norm(self._invert(goal[inside]), axis=-1)
        return found

    def _refusal(self, limit: float, folds: bool) -> str:
        """Error message for an image with pixels that no ray through the lens reaches."""
        corners = np.array([(x, y) for x in (0, self.size[0]) for y in (0, self.size[1])])
        away = np.max(np.linalg.norm(corners - self._center, axis=1))
        edge, _ = self.lens.linearize(limit * _directions(_ANGLES))
        at = np.min(np.linalg.norm(edge * self._focal, axis=1))
        if folds:
            return (
                f"distortion folds over at {at:.0f} px from the principal point, inside the image, whose farthest corner is {away:.0f} px "
                "away; take coefficients that hold for the whole image, or a smaller one"
            )
        return (
            f"distortion has no ray within {MAX_ANGLE:g}° of the axis for pixels farther than {at:.0f} px from the principal point, and "
            f"the image's farthest corner is {away:.0f} px away; take a smaller image, or a longer focal length"
        )

    def _continued(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distorted points and Jacobian matrices as of `Lens.linearize`, of the lens that is continued beyond `radius`."""
        distance = np.linalg.norm(points, axis=-1, keepdims=True)
        beyond = distance[..., 0] > self.radius
        at = points * np.where(distance > self.radius, self.radius / np.maximum(distance, self.radius), 1.0)
        image, jacobian = self.lens.linearize(at)
        if beyond.any():
            out, edge, matrix = points[beyond] - at[beyond], at[beyond], jacobian[beyond]
            image[beyond] += np.einsum("nij,nj->ni", matrix, out)
            # Derivative of the Jacobian along the direction, by central differences; and of the foot on the circle.
            unit, step = edge / self.radius, 1e-5 * self.radius
            turn = (self.lens.linearize(edge + step * unit)[1] - self.lens.linearize(edge - step * unit)[1]) / (2 * step)
            foot = (self.radius / distance[beyond])[..., None] * (np.eye(2) - unit[:, :, None] * unit[:, None, :])
            jacobian[beyond] += np.linalg.norm(out, axis=-1)[:, None, None] * matmul(turn, foot)
        return image, jacobian

    def _invert(self, goal: np.ndarray) -> np.ndarray:
        """Points (n, 2) whose distorted points are `goal` (n, 2)."""
        points = self._first_guess(goal)
        image, jacobian = self._continued(points)
        error = image - goal
        for _ in range(_MAX_STEPS):
            size = np.linalg.norm(error * self._focal, axis=1)
            if (size <= TOLERANCE / 4).all():
                break
            (a, b), (c, d) = np.moveaxis(jacobian, 0, -1)
            step = np.stack((d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]), -1) / _det(jacobian)[:, None]
            start = points
            for _ in range(_HALVINGS):
                points = start - step
                image, jacobian = self._continued(points)
                error = image - goal
                worse = np.linalg.norm(error * self._focal, axis=1) > np.maximum(size, TOLERANCE / 4)
                if not worse.any():
                    break
                step[worse] /= 2
        lost = np.linalg.norm(error * self._focal, axis=1) > TOLERANCE
        if lost.any():
            x, y = goal[lost][0] * self._focal + self._center
            raise ConfigError(f"distortion has no ray for pixel ({x:.0f}, {y:.0f}); check the coefficients' order and signs")
        return points

    def _first_guess(self, goal: np.ndarray) -> np.ndarray:
        """Points (n, 2) whose distorted points would be `goal`, if distortion were radial: by a table."""
        radii = np.linspace(0, _REACH * self.radius, _RADII)
        image = np.maximum.accumulate(self._continued(np.stack((radii, np.zeros_like(radii)), -1))[0][:, 0])
        size = np.linalg.norm(goal, axis=1)
        return goal * (np.interp(size, image, radii) / np.where(size > 0, size, 1))[:, None]

    def _bounds(self) -> tuple[float, float]:
        """Upper bounds of the second derivative, and of the inverse of the first, over the domain and its continuation."""
        directions, step = _directions(_ANGLES), 1e-4 * self.radius
        radii = self.radius * np.concatenate((np.linspace(0, 1, 64), np.geomspace(1.0 + 1e-3, _REACH, 32)))
        points = radii[:, None, None] * directions
        image, jacobian = self._continued(points)
        if not (_det(jacobian) > 0).all():
            raise ConfigError("distortion folds over beyond the image, where it is continued; check the coefficients' order and signs")
        halves = directions[: _ANGLES // 2 : 2]
        second = [self._continued(points + step * v)[0] - 2 * image + self._continued(points - step * v)[0] for v in halves]
        bend = np.max(np.linalg.norm(np.array(second) * self._focal, axis=-1)) / step**2
        # The smaller singular value of a 2 x 2 matrix, from the squares' sum and the product of both.
        scaled = jacobian * self._focal[:, None]
        half, area = (scaled**2).sum(axis=(-2, -1)) / 2, np.abs(_det(scaled))
        least = np.min(area / np.sqrt(half + np.sqrt(np.maximum(half**2 - area**2, 0))))
        return float(_BOUND_MARGIN * bend), float(_BOUND_MARGIN / least)


def _det(matrix: np.ndarray) -> np.ndarray:
    """Determinants of 2 x 2 matrices (..., 2, 2)."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


@functools.lru_cache(maxsize=64)
def _limit(lens: Lens) -> tuple[float, bool]:
    """Radius of the largest disc in which a lens is invertible and has no pole, and whether it folds over at its edge."""
    most = min(np.tan(np.radians(MAX_ANGLE)), lens.pole() * (1 - 1e-6))
    directions = _directions(_ANGLES)
    # Squared, so that samples are close where those of a long lens are.
    radii = most * np.linspace(0, 1, _RADII) ** 2
    for _ in range(4):
        _, jacobian = lens.linearize(radii[:, None, None] * directions)
        bad = np.nonzero((_det(jacobian) <= 0).any(axis=1))[0]
        if not len(bad):
            return float(most), False
        radii = np.linspace(radii[max(bad[0] - 1, 0)], radii[bad[0]], 64)
    return float(radii[0]), True


def _directions(count: int) -> np.ndarray:
    """Unit vectors (count, 2) all around."""
    angle = np.arange(count) * (2 * np.pi / count)
    return np.stack((np.cos(angle), np.sin(angle)), -1)


def _pixel_centers(size: tuple[int, int]) -> np.ndarray:
    """Image coordinates of pixel centres (height, width, 2) [px]."""
    return np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), axis=-1)


def _winding(curve: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding number of a closed polygon (n, 2) about each of the points (m, 2): how often an invertible map of a disc reaches a point."""
    # It is the same at all points of a disc about the origin that the polygon does not enter.
    free = np.min(np.linalg.norm(curve, axis=1)) - np.max(np.linalg.norm(np.diff(curve, axis=0, append=curve[:1]), axis=1))
    beyond = np.linalg.norm(points, axis=1) >= free
    found = np.full(len(points), _turns(curve, np.zeros((1, 2)))[0])
    found[beyond] = _turns(curve, points[beyond])
    return found


def _turns(curve: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding number as of `_winding`, by the edges that a ray from each point crosses."""
    start, stop = curve, np.roll(curve, -1, axis=0)
    above = (start[:, 1] <= points[:, None, 1]) & (stop[:, 1] > points[:, None, 1])
    below = (start[:, 1] > points[:, None, 1]) & (stop[:, 1] <= points[:, None, 1])
    edge, to = stop - start, points[:, None] - start
    side = edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0]
    return (above & (side > 0)).sum(axis=1) - (below & (side < 0)).sum(axis=1)
