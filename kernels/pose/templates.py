"""Template search: observed points of an instance against depth templates of its object, all directions, all in-plane rotations.

A template is a depth image of the object alone, `TEMPLATE` px across, relative to the depth of the object's centre. Directions are spread
over the sphere; in-plane rotations (about the optical axis) are not stored: the observed points are rotated instead (Hinterstoisser et
al., 2012; Vidal et al., 2018, for the truncated cost that knows occlusion).
"""

import warp as wp

from synpick_warp.kernels.pose.observation import CROP, Images, Observation, Targets, read_depth
from synpick_warp.kernels.rng import TAU

wp.set_module_options({"enable_backward": False})

TEMPLATE = wp.constant(48)
"""Rows and columns of a template."""
TEMPLATE_MARGIN = wp.constant(1.05)
"""Width of a template relative to the object's diameter."""
EMPTY = wp.constant(1.0e6)
"""Background value of a template's depth image [m]."""
PROBED = wp.constant(2.0)
"""Width of the region around the crop whose pixels beside the mask are probed, in crops."""
SUPPRESSED = wp.constant(6)
"""A placement suppresses others of its direction within this part of a full turn: they converge to the same pose."""
MIN_COVERED = wp.constant(0.5)
"""Smallest fraction of the observed points on a template at a placement."""
NO_COST = wp.constant(1.0e6)
"""Cost of a placement that is not possible."""


@wp.struct
class Templates:
    """Depth images of each object model from all directions: depth relative to the object's centre [m] (EMPTY: beside the object), rotation
    from object to template camera by direction, pixel width [m] by model. Constant.
    """

    depth: wp.array4d[float]
    """(model, direction, row, column): depth of the surface minus that of the object's centre [m]; `EMPTY`: beside the object."""
    rotation: wp.array[wp.quat]
    """(direction): object to template camera."""
    width: wp.array[float]
    """(model): width of a pixel at the object's centre [m]."""


@wp.struct
class Probes:
    """Points at which templates are compared with the observation, as offset (x, y) from the instance's centroid and depth relative to it
    [m]: on the visible surface (inside), and beside the mask (outside), with weight and viewing direction.
    """

    inside: wp.array2d[wp.vec3]
    """(instance, probe): observed surface points: offset (x, y) from the centroid, and depth relative to it [m]."""
    insides: wp.array[int]
    """(instance): number of inside probes."""
    outside: wp.array2d[wp.vec3]
    """(instance, probe): points beside the mask: offset (x, y) from the centroid, and depth seen there, relative to it [m]."""
    outsides: wp.array[int]
    """(instance): number of outside probes."""
    weight: wp.array[float]
    """(instance): area that an outside probe stands for, relative to the visible mask's."""
    ray: wp.array[wp.quat]
    """(instance): rotation of the optical axis to the viewing direction of the centroid."""


@wp.struct
class Search:
    """Template search: in-plane rotations, shifts of the template, and tolerances in depth."""

    rotations: int
    """Number of in-plane rotations, about the optical axis."""
    shifts: int
    """Shifts to each side of the centred placement, along either axis."""
    shift: float
    """Step of the shifts relative to the object's diameter."""
    truncation: float
    """Distance in depth at which a point counts as unexplained [m]."""
    margin: float
    """Depth by which a template may lie in front of the background beside the mask [m]."""


@wp.kernel
def sample_probes_kernel(
    # In:
    images: Images,
    targets: Targets,
    observation: Observation,
    # Out:
    probes_out: Probes,
):
    """Sample the probes of each instance: observed points at regular ranks, and pixels beside the mask on a regular grid.

    The grid covers a square that contains the crop and is twice as wide (`PROBED`). Writes all members of `probes_out`; without observed
    points the counts alone. Launched over instance.
    """
    instance = wp.tid()
    count = observation.points[instance]
    centroid = observation.centroid[instance]
    capacity = probes_out.inside.shape[1]
    used = wp.min(count, capacity)
    probes_out.insides[instance] = used
    probes_out.outsides[instance] = 0
    if used == 0:
        return
    probes_out.ray[instance] = wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), wp.normalize(centroid))
    inverse = wp.quat_inverse(probes_out.ray[instance])
    for k in range(used):
        point = wp.quat_rotate(inverse, observation.point[instance, k * count // used] - centroid)
        probes_out.inside[instance, k] = point
    view = targets.view[instance]
    intrinsics = images.intrinsics[view]
    corner = observation.corner[instance]
    pitch = observation.pitch[instance]
    free = int(0)
    outside = probes_out.outside.shape[1]
    side = int(wp.sqrt(float(outside)))
    cell = PROBED * pitch * float(CROP) / float(side)
    left = corner[0] - 0.5 * (PROBED - 1.0) * pitch * float(CROP)
    top = corner[1] - 0.5 * (PROBED - 1.0) * pitch * float(CROP)
    probes_out.weight[instance] = cell * cell / float(observation.pixels[instance])
    for k in range(side * side):
        u = left + (float(k % side) + 0.5) * cell
        v = top + (float(k // side) + 0.5) * cell
        if u >= 0.0 and v >= 0.0 and u < float(images.width) and v < float(images.height):
            row = int(v)
            column = int(u)
            depth = read_depth(images, view, row, column)
            if depth > 0.0 and int(images.label[view, row, column]) != targets.label[instance]:
                x = (u - intrinsics[2]) / intrinsics[0]
                y = (v - intrinsics[3]) / intrinsics[1]
                # On the plane across the viewing direction through the centroid; the depth is relative to it.
                direction = wp.quat_rotate(inverse, wp.vec3(x, y, 1.0))
                distance = wp.length(centroid)
                scale = distance / direction[2]
                across = wp.vec2(direction[0] * scale, direction[1] * scale)
                probes_out.outside[instance, free] = wp.vec3(across[0], across[1], depth * direction[2] - distance)
                free += 1
    probes_out.outsides[instance] = free


@wp.struct
class Placement:
    """Alignment of a template with the observation: model, direction, in-plane rotation, and shift of the origin from the centroid."""

    model: int
    direction: int
    cosine: float
    sine: float
    """Cosine and sine of the in-plane rotation."""
    x: float
    y: float
    """Offset across the viewing direction [m]."""


@wp.func
def template_depth(templates: Templates, place: Placement, point: wp.vec3) -> float:
    """Relative depth of a placed template at a probe; `EMPTY`: beside the object."""
    x = point[0] - place.x
    y = point[1] - place.y
    width = templates.width[place.model]
    half = 0.5 * float(TEMPLATE)
    column = int(wp.floor((place.cosine * x + place.sine * y) / width + half))
    row = int(wp.floor((place.cosine * y - place.sine * x) / width + half))
    if row < 0 or column < 0 or row >= TEMPLATE or column >= TEMPLATE:
        return EMPTY
    return templates.depth[place.model, place.direction, row, column]


@wp.func
def center_depth(
    templates: Templates, probes: Probes, place: Placement, instance: int, start: float, cutoff: float, min_hits: float
) -> float:
    """Depth of the object's centre relative to the centroid: mean of observed minus template depth over probes within `cutoff` of `start`.

    `EMPTY` if fewer than `min_hits` probes take part.
    """
    total = float(0.0)
    hits = float(0.0)
    for k in range(probes.insides[instance]):
        point = probes.inside[instance, k]
        depth = template_depth(templates, place, point)
        if depth < EMPTY and wp.abs(point[2] - depth - start) < cutoff:
            total += point[2] - depth
            hits += 1.0
    if hits < min_hits:
        return EMPTY
    return total / hits


@wp.func
def unexplained(templates: Templates, probes: Probes, place: Placement, instance: int, depth: float, truncation: float) -> float:
    """Cost of the observed points: mean truncated depth difference from the template, from 0 to 1; points beside the template count 1."""
    total = float(0.0)
    count = probes.insides[instance]
    for k in range(count):
        point = probes.inside[instance, k]
        total += wp.min(wp.abs(point[2] - template_depth(templates, place, point) - depth) / truncation, 1.0)
    return total / float(count)


@wp.func
def protruding(templates: Templates, probes: Probes, place: Placement, instance: int, depth: float, margin: float) -> float:
    """Free-space violation: area beside the mask in which the template lies in front of the observed depth by `margin`, over the area of
    the mask."""
    count = float(0.0)
    for k in range(probes.outsides[instance]):
        point = probes.outside[instance, k]
        if template_depth(templates, place, point) + depth < point[2] - margin:
            count += 1.0
    return count * probes.weight[instance]


@wp.kernel
def search_templates_kernel(
    # Scene:
    templates: Templates,
    search: Search,
    # In:
    targets: Targets,
    probes: Probes,
    # Out:
    cost_out: wp.array3d[float],  # (instance, direction, rotation)
    offset_out: wp.array3d[wp.vec3],  # (instance, direction, rotation) [m]
):
    """Cost of a direction and in-plane rotation at its best shift, and the object's centre there, relative to the centroid.

    The centre's depth is a trimmed mean. At least half of the observed points must lie on the template. Launched over instance, direction,
    in-plane rotation.
    """
    instance, direction, inplane = wp.tid()
    count = probes.insides[instance]
    best = float(NO_COST)
    offset = wp.vec3(0.0, 0.0, 0.0)
    place = Placement()
    place.model = targets.model[instance]
    place.direction = direction
    angle = TAU * float(inplane) / float(search.rotations)
    place.cosine = wp.cos(angle)
    place.sine = wp.sin(angle)
    step = search.shift * templates.width[place.model] * float(TEMPLATE) / TEMPLATE_MARGIN
    side = 2 * search.shifts + 1
    shifts = side * side
    if count == 0:
        shifts = 0
    for k in range(shifts):
        place.x = float(k % side - search.shifts) * step
        place.y = float(k // side - search.shifts) * step
        start = center_depth(templates, probes, place, instance, 0.0, EMPTY, MIN_COVERED * float(count))
        if start < EMPTY:
            depth = center_depth(templates, probes, place, instance, start, 2.0 * search.truncation, 1.0)
            if depth == EMPTY:
                depth = start
            price = unexplained(templates, probes, place, instance, depth, search.truncation)
            if price < best:
                price += protruding(templates, probes, place, instance, depth, search.margin)
            if price < best:
                best = price
                offset = wp.vec3(place.x, place.y, depth)
    cost_out[instance, direction, inplane] = best
    offset_out[instance, direction, inplane] = offset


@wp.kernel
def choose_placements_kernel(
    # Scene:
    templates: Templates,
    search: Search,
    # In:
    observation: Observation,
    probes: Probes,
    offset: wp.array3d[wp.vec3],  # (instance, direction, rotation) [m]
    hypotheses: int,
    # Out:
    cost_inout: wp.array3d[float],  # (instance, direction, rotation)
    pose_out: wp.array[wp.transform],  # (pose) [m]
):
    """Choose the best placements of each instance as poses, by greedy non-maximum suppression over in-plane rotations.

    A placement suppresses rotations of its direction within 60°, by overwriting their costs in `cost_inout`. `pose_out` receives
    `hypotheses` poses: where there are fewer placements, the best is repeated; without any, the pose is the centroid without rotation.
    Launched over instance.
    """
    instance = wp.tid()
    ray = probes.ray[instance]
    for k in range(hypotheses):
        best = float(NO_COST)
        direction = int(-1)
        inplane = int(0)
        for i in range(cost_inout.shape[1]):
            for j in range(search.rotations):
                if cost_inout[instance, i, j] < best:
                    best = cost_inout[instance, i, j]
                    direction = i
                    inplane = j
        index = instance * hypotheses + k
        if direction < 0:
            pose_out[index] = wp.transform(observation.centroid[instance], wp.quat_identity())
            if k > 0:
                pose_out[index] = pose_out[instance * hypotheses]
        else:
            angle = TAU * float(inplane) / float(search.rotations)
            around = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle)
            place = observation.centroid[instance] + wp.quat_rotate(ray, offset[instance, direction, inplane])
            pose_out[index] = wp.transform(place, wp.normalize(ray * around * templates.rotation[direction]))
            for j in range(search.rotations):
                # One rotation and its neighbours lead to the same pose; the opposite ones of a direction are another.
                apart = wp.abs(j - inplane)
                if wp.min(apart, search.rotations - apart) <= search.rotations / SUPPRESSED:
                    cost_inout[instance, direction, j] = NO_COST
