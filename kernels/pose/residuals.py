"""Residuals of a pose hypothesis against an observation: surface distance, silhouette and colour, as normal equations of Gauss-Newton.

All residuals are in metres and weighted by area, so that points of the observation and samples of the model count alike. A step moves
the point p of the model, in the camera frame, to p + w x (p - c) / ρ + v: c is the object's origin, ρ its radius, (w, v) the step [m].
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(32)
"""Threads that share the sums of one hypothesis; their partial sums are added in a fixed order."""


@wp.struct
class Models:
    """Object models, in their own frames: mesh for closest-point queries, bounding radius [m], and samples evenly spread over the surface
    with outward normal, linear base colour and the area [m²] one stands for. Constant.
    """

    mesh: wp.array[wp.uint64]
    """(model): handle of the `wp.Mesh`."""
    radius: wp.array[float]
    """(model): radius of the bounding sphere about the origin [m]."""
    sample_area: wp.array[float]
    """(model): area that a sample stands for [m²]."""
    position: wp.array2d[wp.vec3]
    """(model, sample): [m]."""
    normal: wp.array2d[wp.vec3]
    """(model, sample): outward unit normal."""
    color: wp.array2d[wp.vec3]
    """(model, sample): base colour, linear, averaged over the neighbourhood."""


@wp.struct
class LossParameters:
    """Robust losses (Tukey, Huber): distances of outliers, weights, and the stride of points and samples."""

    cutoff: float
    """Distance from which a surface residual is an outlier (Tukey's biweight), and a silhouette residual grows linearly (Huber) [m]."""
    truncation: float
    """Distance at which the costs of hypotheses are truncated [m]."""
    margin: float
    """Depth by which a sample may lie in front of another surface without protruding, or behind its own and be visible [m]."""
    silhouette: float
    """Weight of silhouette residuals."""
    color: float
    """Length that a colour residual of the mean intensity counts as [m]; 0: colour is not used."""
    color_cutoff: float
    """Colour residual from which it counts as an outlier, relative to the mean intensity."""
    color_cost: float
    """Weight of colours in the costs of hypotheses."""
    step: int
    """Every n-th point and sample is used."""


@wp.struct
class Sums:
    """Partial sums, by hypothesis and lane, of the normal equations H s = g, and of costs and areas [m²] of points and samples."""

    hessian: wp.array2d[wp.spatial_matrix]
    """(pose, lane): [m²]."""
    gradient: wp.array2d[wp.spatial_vector]
    """(pose, lane): [m³]."""
    points: wp.array2d[wp.vec2]
    """(pose, lane): truncated cost of the observed points relative to the truncation, and their area [m²]."""
    samples: wp.array2d[wp.vec4]
    """(pose, lane): cost of protruding samples, area of visible samples, cost of their colours, area of samples with colour [m²]."""


@wp.func
def jacobian(point: wp.vec3, origin: wp.vec3, direction: wp.vec3, radius: float) -> wp.spatial_vector:
    """Derivative of a point's motion along `direction` with respect to the step (w, v)."""
    return wp.spatial_vector(wp.cross(point - origin, direction) / radius, direction)


@wp.func
def tukey_weight(residual: float, cutoff: float) -> float:
    """Tukey's biweight: (1 - (r / c)²)² within the cutoff c, else 0."""
    ratio = residual / cutoff
    inside = wp.max(1.0 - ratio * ratio, 0.0)
    return inside * inside
