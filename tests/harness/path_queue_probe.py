"""Test kernel for path queues: packing of a path and its coarse pixel."""

import warp as wp

from synpick_warp.kernels.render.lighting.paths.queues import PathPixel, PathQueues, first_record, read_path, write_path
from synpick_warp.kernels.render.lighting.paths.tracing import Path

wp.set_module_options({"enable_backward": False})

MAX_INTEGERS = (63, 255, (1 << 26) - 1, 511, 255, 255, (1 << 30) - 1)
"""Largest bounce, segmentation id and triangle of the hit; offset, segmentation id, known paths and Sobol' index of the coarse pixel."""
VECTORS = 12
"""Number of 3-vectors that hold a path's floating-point values."""


@wp.kernel
def repack_kernel(
    # In:
    integers: wp.array2d[int],  # (path, integer)
    vectors: wp.array2d[wp.vec3],  # (path, vector)
    # Out:
    queues_inout: PathQueues,
    integers_out: wp.array2d[int],  # (path, integer)
    vectors_out: wp.array2d[wp.vec3],  # (path, vector)
):
    """Round trip: store each path in its slot of the queue (view 0, region 0), and load it again.

    The last two vectors hold scalars: width, specular limit and barycentric weights.
    """
    slot = wp.tid()
    path = Path()
    pixel = PathPixel()
    path.bounce = integers[slot, 0]
    path.hit.segment = integers[slot, 1]
    path.hit.triangle = integers[slot, 2]
    pixel.offset = integers[slot, 3]
    pixel.segment = integers[slot, 4]
    pixel.known = integers[slot, 5]
    pixel.number = integers[slot, 6]
    path.position = vectors[slot, 0]
    path.direction = vectors[slot, 1]
    path.throughput.diffuse = vectors[slot, 2]
    path.throughput.specular = vectors[slot, 3]
    path.radiance.diffuse = vectors[slot, 4]
    path.radiance.specular = vectors[slot, 5]
    path.radiance.indirect = vectors[slot, 6]
    pixel.diffuse = vectors[slot, 7]
    pixel.unoccluded.diffuse = vectors[slot, 8]
    pixel.unoccluded.specular = vectors[slot, 9]
    path.width = vectors[slot, 10][0]
    pixel.specular_limit = vectors[slot, 10][1]
    path.hit.barycentric = wp.vec2(vectors[slot, 10][2], vectors[slot, 11][0])
    write_path(queues_inout, first_record(queues_inout, 0, 0, slot), path, pixel)
    again, place = read_path(queues_inout, first_record(queues_inout, 0, 0, slot))
    integers_out[slot, 0] = again.bounce
    integers_out[slot, 1] = again.hit.segment
    integers_out[slot, 2] = again.hit.triangle
    integers_out[slot, 3] = place.offset
    integers_out[slot, 4] = place.segment
    integers_out[slot, 5] = place.known
    integers_out[slot, 6] = place.number
    vectors_out[slot, 0] = again.position
    vectors_out[slot, 1] = again.direction
    vectors_out[slot, 2] = again.throughput.diffuse
    vectors_out[slot, 3] = again.throughput.specular
    vectors_out[slot, 4] = again.radiance.diffuse
    vectors_out[slot, 5] = again.radiance.specular
    vectors_out[slot, 6] = again.radiance.indirect
    vectors_out[slot, 7] = place.diffuse
    vectors_out[slot, 8] = place.unoccluded.diffuse
    vectors_out[slot, 9] = place.unoccluded.specular
    vectors_out[slot, 10] = wp.vec3(again.width, place.specular_limit, again.hit.barycentric[0])
    vectors_out[slot, 11] = wp.vec3(again.hit.barycentric[1], 0.0, 0.0)
