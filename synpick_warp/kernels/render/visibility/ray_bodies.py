"""Per-body records for world-space ray queries: bounding sphere, pose and BVH root, packed in the order of `ViewBodies.order`."""

import warp as wp

from synpick_warp.kernels.render.visibility.gbuffer import Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.records import read_record

wp.set_module_options({"enable_backward": False})

RAY_RECORDS = wp.constant(5)
"""Number of 16-byte records per body in `ViewBodies.ray_record`. Record 0: bounding sphere, as in `ViewBodies.sphere`. Records 1 to 3: one
row of the world-to-body rotation, and x, y or z of the body's position in the world. Record 4: root node of its BVH and its row of
`ViewBodies`, both as bits."""


@wp.struct
class RayBody:
    """Body as a ray needs it: world-to-body rotation, origin in the world [m], BVH root, and row in `ViewBodies`."""

    rotation: wp.mat33
    position: wp.vec3
    root: int
    row: int


@wp.func
def first_ray_record(bodies: ViewBodies, view: int, rank: int) -> int:
    """Flat index of a body's first record, its bounding sphere."""
    return (view * bodies.order.shape[1] + rank) * RAY_RECORDS


@wp.func
def write_ray_body(meshes: Meshes, bodies_inout: ViewBodies, view: int, rank: int, body: int):
    """Pack bounding sphere, pose and BVH of a body into its ray records, for `read_ray_body`."""
    rotation = bodies_inout.world_rotation[view, body]
    position = bodies_inout.position[view, body]
    root = meshes.bvh.root[bodies_inout.mesh[view, body]]
    bodies_inout.ray_record[view, rank, 0] = bodies_inout.sphere[view, body]
    for row in range(3):
        bodies_inout.ray_record[view, rank, 1 + row] = wp.vec4(rotation[row, 0], rotation[row, 1], rotation[row, 2], position[row])
    bodies_inout.ray_record[view, rank, 4] = wp.vec4(wp.cast(root, float), wp.cast(body, float), 0.0, 0.0)


@wp.func
def read_ray_body(bodies: ViewBodies, first: int) -> RayBody:
    """Unpack the pose and BVH of a body by its `first_ray_record`; record 0, the bounding sphere, is not read."""
    x = read_record(bodies.ray_record, first + 1)
    y = read_record(bodies.ray_record, first + 2)
    z = read_record(bodies.ray_record, first + 3)
    rows = read_record(bodies.ray_record, first + 4)
    result = RayBody()
    result.rotation = wp.mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])
    result.position = wp.vec3(x[3], y[3], z[3])
    result.root = wp.cast(rows[0], int)
    result.row = wp.cast(rows[1], int)
    return result
