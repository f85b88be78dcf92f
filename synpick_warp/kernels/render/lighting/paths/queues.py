"""Path queues of the coarse path pass: stream compaction between bounces, as in wavefront path tracing (Laine, Karras and Aila, 2013).

Half of the paths end at their first bounce, which leaves the threads of a warp without work. The others are compacted into queues, and
another kernel extends them by a bounce with full warps. Each region of `lists` has a queue of its own, so that neighbours in a queue are
neighbours in the image, and few threads contend for a counter.
"""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import SplitRadiance
from synpick_warp.kernels.render.lighting.paths.lists import KNOWN_BITS, REGION_PIXELS
from synpick_warp.kernels.render.lighting.paths.tracing import Path
from synpick_warp.kernels.render.visibility.records import read_record, write_record

wp.set_module_options({"enable_backward": False})

QUEUE_CAPACITY = REGION_PIXELS
"""Paths that a region's queue holds: one from each coarse pixel."""
PATH_RECORDS = wp.constant(10)
"""Number of 16-byte records of a queued path; see `write_path`."""
_SEGMENT_BITS = wp.constant(8)
"""Bits of a segmentation id."""


@wp.struct
class PathQueues:
    """Wavefront queues of the paths that go on after a bounce, by region and stage. Scratch."""

    count: wp.array3d[int]
    """(queue_view, region, stage): length of a queue. Stage s holds paths with `Path.bounce` = s + 1."""
    slot: wp.array4d[wp.uint16]
    """(queue_view, region, stage % 2, rank): slot of each queued path from stage 1 on; double-buffered. In stage 0 it is the rank."""
    record: wp.array3d[wp.vec4]
    """(queue_view, region, path_record): paths packed by `write_path`; element k * QUEUE_CAPACITY + slot is record k of a slot."""


@wp.struct
class PathPixel:
    """Coarse pixel of a path: what its light is combined with when it terminates: index in the region, segmentation id, valid paths of the
    history, Sobol' index, diffuse colour, unoccluded light, firefly limit.
    """

    offset: int
    """Index of the coarse pixel in its region, in interleaved order."""
    segment: int
    known: int
    number: int
    """Sobol' index of the path; of the first one, if it has several."""
    diffuse: wp.vec3
    unoccluded: SplitRadiance
    specular_limit: float
    """Firefly clamp of specular light: limit of the largest channel."""


@wp.func
def queue_view(queues: PathQueues, view: int) -> int:
    """Row of the queues of a view: views of a large batch take turns."""
    return view % queues.count.shape[0]


@wp.func
def first_record(queues: PathQueues, view: int, region: int, slot: int) -> int:
    """Flat index of a slot's first record; the next ones follow at a distance of QUEUE_CAPACITY."""
    return (queue_view(queues, view) * queues.count.shape[1] + region) * (PATH_RECORDS * QUEUE_CAPACITY) + slot


@wp.func
def record_of(values: wp.vec3, last: float) -> wp.vec4:
    """Record of 16 bytes of a vector and one more value."""
    return wp.vec4(values[0], values[1], values[2], last)


@wp.func
def vector_of(record: wp.vec4) -> wp.vec3:
    """First three values of a record, the vector of `record_of`."""
    return wp.vec3(record[0], record[1], record[2])


@wp.func
def write_path(queues: PathQueues, first: int, path: Path, pixel: PathPixel):
    """Pack a path and its coarse pixel into records, from flat index `first` on; integers as bits."""
    segments = (((path.bounce << _SEGMENT_BITS) | path.hit.segment) << _SEGMENT_BITS) | pixel.segment
    place = (pixel.offset << KNOWN_BITS) | pixel.known
    b = path.hit.barycentric
    light = pixel.unoccluded
    write_record(queues.record, first, record_of(path.position, path.width))
    write_record(queues.record, first + QUEUE_CAPACITY, record_of(path.direction, wp.cast(path.hit.triangle, float)))
    write_record(queues.record, first + 2 * QUEUE_CAPACITY, wp.vec4(b[0], b[1], wp.cast(segments, float), wp.cast(place, float)))
    write_record(queues.record, first + 3 * QUEUE_CAPACITY, record_of(path.throughput.diffuse, wp.cast(pixel.number, float)))
    write_record(queues.record, first + 4 * QUEUE_CAPACITY, record_of(path.throughput.specular, pixel.specular_limit))
    write_record(queues.record, first + 5 * QUEUE_CAPACITY, record_of(path.radiance.diffuse, light.diffuse[0]))
    write_record(queues.record, first + 6 * QUEUE_CAPACITY, record_of(path.radiance.specular, light.diffuse[1]))
    write_record(queues.record, first + 7 * QUEUE_CAPACITY, record_of(path.radiance.indirect, light.diffuse[2]))
    write_record(queues.record, first + 8 * QUEUE_CAPACITY, record_of(pixel.diffuse, light.specular[0]))
    write_record(queues.record, first + 9 * QUEUE_CAPACITY, wp.vec4(light.specular[1], light.specular[2], 0.0, 0.0))


@wp.func
def read_path(queues: PathQueues, first: int) -> tuple[Path, PathPixel]:
    """Unpack a path and its coarse pixel from the records of `write_path`, from flat index `first` on."""
    origin = read_record(queues.record, first)
    ray = read_record(queues.record, first + QUEUE_CAPACITY)
    hit = read_record(queues.record, first + 2 * QUEUE_CAPACITY)
    diffuse = read_record(queues.record, first + 3 * QUEUE_CAPACITY)
    specular = read_record(queues.record, first + 4 * QUEUE_CAPACITY)
    direct_light = read_record(queues.record, first + 5 * QUEUE_CAPACITY)
    specular_light = read_record(queues.record, first + 6 * QUEUE_CAPACITY)
    indirect_light = read_record(queues.record, first + 7 * QUEUE_CAPACITY)
    surface = read_record(queues.record, first + 8 * QUEUE_CAPACITY)
    rest = read_record(queues.record, first + 9 * QUEUE_CAPACITY)
    segments = wp.cast(hit[2], int)
    place = wp.cast(hit[3], int)
    segment_mask = (1 << _SEGMENT_BITS) - 1
    path = Path()
    path.position = vector_of(origin)
    path.width = origin[3]
    path.direction = vector_of(ray)
    path.hit.triangle = wp.cast(ray[3], int)
    path.hit.barycentric = wp.vec2(hit[0], hit[1])
    path.hit.segment = (segments >> _SEGMENT_BITS) & segment_mask
    path.bounce = segments >> (2 * _SEGMENT_BITS)
    path.throughput.diffuse = vector_of(diffuse)
    path.throughput.specular = vector_of(specular)
    path.radiance.diffuse = vector_of(direct_light)
    path.radiance.specular = vector_of(specular_light)
    path.radiance.indirect = vector_of(indirect_light)
    pixel = PathPixel()
    pixel.offset = place >> KNOWN_BITS
    pixel.segment = segments & segment_mask
    pixel.known = place & ((1 << KNOWN_BITS) - 1)
    pixel.number = wp.cast(diffuse[3], int)
    pixel.diffuse = vector_of(surface)
    pixel.unoccluded.diffuse = wp.vec3(direct_light[3], specular_light[3], indirect_light[3])
    pixel.unoccluded.specular = wp.vec3(surface[3], rest[0], rest[1])
    pixel.specular_limit = specular[3]
    return path, pixel


@wp.func
def queue_path(queues: PathQueues, view: int, region: int, path: Path, pixel: PathPixel):
    """Queue a path after its first bounce. Slots are assigned in arbitrary order; results do not depend on it."""
    slot = wp.atomic_add(queues.count, queue_view(queues, view), region, 0, 1)
    write_path(queues, first_record(queues, view, region, slot), path, pixel)


@wp.func
def requeue_path(queues: PathQueues, view: int, region: int, stage: int, slot: int, path: Path, pixel: PathPixel):
    """Queue a path for a later `stage`, from 1 on; it stays in its slot."""
    rank = wp.atomic_add(queues.count, queue_view(queues, view), region, stage, 1)
    queues.slot[queue_view(queues, view), region, stage % 2, rank] = wp.uint16(slot)
    write_path(queues, first_record(queues, view, region, slot), path, pixel)


@wp.func
def queued_slot(queues: PathQueues, view: int, region: int, stage: int, rank: int) -> int:
    """Slot of the path with a `rank` in the queue of a stage; -1: the queue is shorter."""
    if rank >= queues.count[queue_view(queues, view), region, stage]:
        return -1
    if stage == 0:
        return rank
    return int(queues.slot[queue_view(queues, view), region, stage % 2, rank])
