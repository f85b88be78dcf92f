"""Exact nearest-neighbour search in a hierarchical grid (64³ root, 4³ branching) with a list of candidate vertices per leaf cell.

A cell with a long list is divided into 4 x 4 x 4 cells, and so on. A vertex is left out of a cell's list only if the vertex that is nearest
to the cell's centre is nearer everywhere in the cell, so that the search is exact: a query walks down to its cell and compares a handful
of vertices. Coordinates are in metres from the grid's lower corner, in double precision.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BRANCH = wp.constant(4)
"""Cells along an axis that a cell is divided into."""
CHILDREN = wp.constant(64)
"""Cells that a cell is divided into: BRANCH³."""
ROOT = wp.constant(64)
"""Cells along an axis of the coarsest grid."""
BLOCK = wp.constant(256)
"""Vertices of a model that one thread moves and looks up."""
_SCALE = wp.constant(wp.float64(4.0))
_SLACK = wp.constant(wp.float64(1.0e-14))
"""Slack of a comparison of squared distances, as a fraction of the grid's squared edge: some ten times its rounding."""
_FAR = wp.constant(wp.float64(1.0e300))


@wp.func
def child_center(corner: wp.vec3d, edge: wp.float64, child: int):
    """Centre of a child cell from the lower corner of its parent and the child's edge length."""
    half = wp.float64(0.5)
    x = wp.float64(child % BRANCH) + half
    y = wp.float64(child // BRANCH % BRANCH) + half
    z = wp.float64(child // (BRANCH * BRANCH)) + half
    return corner + edge * wp.vec3d(x, y, z)


@wp.func
def can_be_nearest(vertex: wp.vec3d, nearest: wp.vec3d, center: wp.vec3d, edge: wp.float64, slack: wp.float64):
    """Whether some point of a cell is at least as near to `vertex` as to `nearest`, the vertex nearest to the cell's centre.

    The difference of the squared distances is linear in the point, so that its extremes over the cell are known.
    """
    here = vertex - center
    there = nearest - center
    way = vertex - nearest
    return wp.dot(here, here) - wp.dot(there, there) <= edge * (wp.abs(way[0]) + wp.abs(way[1]) + wp.abs(way[2])) + slack


@wp.kernel
def list_candidates_kernel(
    # In:
    vertex: wp.array[wp.vec3d],  # (vertex)
    corner: wp.array[wp.vec3d],  # (parent)
    list_start: wp.array[int],  # (parent)
    list_length: wp.array[int],  # (parent)
    candidate: wp.array[int],  # (entry)
    child_start: wp.array[int],  # (cell)
    edge: wp.float64,
    grid_edge: wp.float64,
    fill: int,
    first: int,
    # Out:
    child_length_out: wp.array[int],  # (cell)
    child_candidate_out: wp.array[int],  # (child_entry)
):
    """Nearest-vertex grid: list the vertices of a parent's list that can be nearest to a point of its child cell.

    Launched twice over cell, from `first` on, to count and to fill. `edge` is that of a child. `child_length_out` receives the number of
    candidates; with `fill`, `child_candidate_out` receives the candidates from `child_start` on.
    """
    cell = first + wp.tid()
    if cell >= child_length_out.shape[0]:
        return
    parent = cell // CHILDREN
    center = child_center(corner[parent], edge, cell % CHILDREN)
    begin = list_start[parent]
    end = begin + list_length[parent]
    smallest = _FAR
    nearest = int(0)
    for entry in range(begin, end):
        offset = vertex[candidate[entry]] - center
        distance = wp.dot(offset, offset)
        if distance < smallest:
            smallest = distance
            nearest = candidate[entry]
    slack = _SLACK * grid_edge * grid_edge
    count = int(0)
    for entry in range(begin, end):
        index = candidate[entry]
        if can_be_nearest(vertex[index], vertex[nearest], center, edge, slack):
            if fill == 1:
                child_candidate_out[child_start[cell] + count] = index
            count += 1
    child_length_out[cell] = count


@wp.kernel
def sum_distances_kernel(
    # In:
    rotation: wp.array[wp.mat33d],  # (pose)
    translation: wp.array[wp.vec3d],  # (pose)
    query: wp.array[wp.vec3d],  # (vertex)
    weight: wp.array[wp.float64],  # (vertex)
    vertex: wp.array[wp.vec3d],  # (vertex)
    node: wp.array[int],  # (node)
    candidate: wp.array[int],  # (entry)
    cells_per_meter: wp.float64,
    first: int,
    # Out:
    sum_out: wp.array2d[wp.float64],  # (pose, block)
):
    """Sum the weighted distances from a model's vertices, moved by a pose, to its nearest vertex: a thread for a pose and BLOCK vertices.

    `query` are the vertices in the model's axes, `vertex` the same from the grid's lower corner, as poses move them to. All moved ones must
    be inside the grid. A node is the index of its first child node, or the complement of the start of its list in `candidate`, whose last
    entry is the complement of a vertex. Launched over task, from `first` on: a pose and a block of vertices.
    """
    task = first + wp.tid()
    blocks = sum_out.shape[1]
    pose = task // blocks
    if pose >= sum_out.shape[0]:
        return
    block = task % blocks
    orientation = rotation[pose]
    shift = translation[pose]
    total = wp.float64(0.0)
    for index in range(block * BLOCK, wp.min((block + 1) * BLOCK, query.shape[0])):
        point = orientation * query[index] + shift
        place = point * cells_per_meter
        x = wp.int32(place[0])
        y = wp.int32(place[1])
        z = wp.int32(place[2])
        entry = node[x + ROOT * (y + ROOT * z)]
        while entry >= 0:
            place = _SCALE * (place - wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(z)))
            x = wp.int32(place[0])
            y = wp.int32(place[1])
            z = wp.int32(place[2])
            entry = node[entry + x + BRANCH * (y + BRANCH * z)]
        entry = ~entry
        smallest = _FAR
        code = int(0)
        while code >= 0:
            code = candidate[entry]
            offset = vertex[wp.max(code, ~code)] - point
            smallest = wp.min(smallest, wp.dot(offset, offset))
            entry += 1
        total += weight[index] * wp.sqrt(smallest)
    sum_out[pose, block] = total
