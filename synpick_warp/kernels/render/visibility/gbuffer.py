"""G-buffer: segmentation id, triangle, barycentric coordinates and depth of each pixel; and the structs of geometry it refers to."""

from typing import Any

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.camera import ImageGrid, LensViews, Views
from synpick_warp.kernels.render.visibility.variants import VARIANTS, variant_of
from synpick_warp.kernels.render.visibility.wide_bvh import WideBvh
from synpick_warp.kernels.state import Frames

wp.set_module_options({"enable_backward": False})

FIXTURES = wp.constant(3)
"""Tote, gripper shaft and cup, in this order: rows after a world's instances in `ViewBodies`, and after the catalog in `Meshes`."""
FAR = wp.constant(1.0e30)
"""Depth or distance of a miss [m]."""
MAX_COUNTS = wp.constant(65535.0)
"""Largest value of a 16-bit depth image."""


MASK_BITS = wp.constant(64)
"""Bodies of a word of `ViewBodies.body_mask`."""


@wp.struct
class Interior:
    """Empty interior of the tote; see `scenes.types.Interior`."""

    half: wp.vec3
    """Half extents at z = 0 [m]; negative: there is no interior."""
    growth: wp.vec3
    """Increase of the half extents with height [m/m]."""
    floor: float
    """[m]"""
    top: float
    """No vertex of the tote is higher [m]."""


@wp.struct
class Meshes:
    """Triangle meshes of the catalog, then bins, gripper shaft, cup, each in its own frame: handle, BVH, box and sphere [m], corners [m]
    and unit normals of all triangles, empty interior of the tote. Constant.
    """

    id: wp.array[wp.uint64]
    """(mesh): Warp's mesh handle."""
    bvh: WideBvh
    """BVHs, which the renderer's rays traverse."""
    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    """(mesh): bounding box [m]."""
    center: wp.array[wp.vec3]
    radius: wp.array[float]
    """(mesh): bounding sphere [m]."""
    first_triangle: wp.array[int]
    """(mesh + 1): index of the mesh's first triangle among all triangles; the last entry is their number."""
    corner: wp.array[wp.vec3]
    """(3 x triangle): corners of all triangles [m]."""
    face_normal: wp.array[wp.vec3]
    """(triangle): unit normals by the winding; zero for degenerate triangles."""
    entries: int
    """Row of the first bin; see `fixture_mesh`."""
    interior: Interior


@wp.struct
class Table:
    """Horizontal plane below the tote: whether it is visible (1), its z in the world [m], and how much of it cameras see."""

    visible: int
    height: float
    half: wp.vec2
    """Half length and width of what cameras see, about the world's origin; FAR: endless [m]."""


@wp.struct
class ViewBodies:
    """Poses, bounds and drawing order of the bodies in front of each view's camera. Body b is instance b, or fixture b - instances."""

    mesh: wp.array2d[int]
    """(view, body): row of `Meshes`; -1: the body is absent."""
    rotation: wp.array2d[wp.mat33]
    """(view, body): camera to body frame."""
    start: wp.array2d[wp.vec3]
    """(view, body): the point of the optical axis at depth `near`, in the body's frame [m]. Rays start so close that float32 suffices."""
    near: wp.array2d[float]
    """(view, body): lower bound of the planar depth of the body's points [m]."""
    box: wp.array2d[wp.vec4i]
    """(view, body): screen box (x_min, y_min, x_max, y_max) [px], inclusive, clipped to one image size beyond each border."""
    world_rotation: wp.array2d[wp.mat33]
    """(view, body): world to body frame."""
    position: wp.array2d[wp.vec3]
    """(view, body): body origin in the world [m]."""
    sphere: wp.array2d[wp.vec4]
    """(view, body): bounding sphere in the world: centre [m], squared radius [m²]; negative square: the body is absent."""
    order: wp.array2d[int]
    """(view, rank): present bodies, front to back by `near`, the tote last: after a near hit the others are seldom tested."""
    ray_record: wp.array3d[wp.vec4]
    """(view, rank, record): packed pose, bounding sphere and BVH of body `order[rank]`, see `visibility.ray_bodies`."""
    present: wp.array[int]
    """(view): number of present bodies."""
    uses_background: wp.array[int]
    """(view): 1: the tote has the pose at which the cached static background was rendered."""
    body_mask: wp.array3d[wp.uint64]
    """(view, tile, word): bit k of word w: rays through the tile can hit body order[64 w + k]."""


@wp.struct
class GBuffer:
    """Primary hit of each pixel."""

    segment: wp.array3d[wp.uint8]
    """(view, row, column): segmentation id: 0 nothing, 1 + instance, or a member of `Segment`."""
    triangle: wp.array3d[int]
    """(view, row, column): triangle index within the body's mesh."""
    barycentric: wp.array3d[wp.vec2]
    """(view, row, column): barycentric weights of the triangle's first and second corner."""
    depth: wp.array3d[float]
    """(view, row, column): planar depth [m]."""


@wp.struct
class ShotData:
    """Batch of views of one image size: their worlds and cameras, the bodies in front of each, and what their pixels show."""

    grid: ImageGrid
    snapshot: Frames
    """Frame and light of each world."""
    bodies: ViewBodies
    gbuffer: GBuffer
    views: Views


LensShot = variant_of(ShotData, "LensShot", views=LensViews)
"""Batch of views, where some cameras are distorted."""
AnyShot = Any
"""`ShotData`, or `LensShot`: kernels are compiled for each; see `variants`."""
VARIANTS["shot"] = ShotData, LensShot


COLOR_PASS, SHADE_PASS, EDGE_PASS = wp.constant(1), wp.constant(2), wp.constant(4)
"""Bits of `ShadedImage.passes`: the tile's colours, its radiance, and rays at its steep shadow edges are computed anew."""
ALL_PASSES = int(COLOR_PASS) | int(SHADE_PASS) | int(EDGE_PASS)


@wp.struct
class ShadedImage:
    """Linear radiance of a batch of views before post-processing, and how samples are resolved."""

    radiance: wp.array3d[wp.vec3]
    """Linear radiance (view, row, column) before exposure; of anti-aliased pixels, that of the pixel's centre."""
    resolve: wp.array3d[wp.uint32]
    """Resolve code (view, row, column). 0: the pixel's colour is its own radiance. Else it is the mean over its samples, each with
    SOURCE_BITS that select the pixel whose radiance it takes, see `images.antialias.source_offset`."""
    passes: wp.array2d[wp.uint8]
    """(view, tile): what is computed anew in a tile: bits as COLOR_PASS. Elsewhere the image is undefined, and colours stay."""
    samples: int
    """Number of coverage samples per anti-aliased pixel: 4, 8 or 16, distributed equally over its quadrants."""


@wp.struct
class Hit:
    """Closest hit of one ray: segmentation id (0: nothing), triangle, barycentric weights, and depth [m], planar of a camera ray, along the
    ray of any other.
    """

    segment: int
    triangle: int
    barycentric: wp.vec2
    depth: float


@wp.func
def fixture_mesh(meshes: Meshes, bin: int, fixture: int) -> int:
    """Row of `Meshes` of a fixture in a world with the bin `bin`: bins beside the first lie before it, in reverse order."""
    if fixture == 0:
        return meshes.entries - bin
    return meshes.entries + fixture


@wp.func
def body_of(segment: int, instances: int) -> int:
    """Row of `ViewBodies` of a segmentation id, which must not be NOTHING or TABLE."""
    if segment >= Segment.TOTE:
        return instances + segment - Segment.TOTE
    return segment - 1


@wp.func
def segment_of(body: int, instances: int) -> int:
    """Segmentation id of a body: 1 + instance, or the fixture's `Segment`; `body` is a row of `ViewBodies`."""
    if body >= instances:
        return Segment.TOTE + body - instances
    return body + 1


@wp.func
def store_hit(gbuffer: GBuffer, view: int, row: int, column: int, hit: Hit):
    """Write a pixel of the G-buffer."""
    gbuffer.segment[view, row, column] = wp.uint8(hit.segment)
    gbuffer.triangle[view, row, column] = hit.triangle
    gbuffer.barycentric[view, row, column] = hit.barycentric
    gbuffer.depth[view, row, column] = hit.depth


@wp.func
def read_hit(gbuffer: GBuffer, view: int, row: int, column: int) -> Hit:
    """Read a pixel of the G-buffer."""
    hit = Hit()
    hit.segment = int(gbuffer.segment[view, row, column])
    hit.triangle = gbuffer.triangle[view, row, column]
    hit.barycentric = gbuffer.barycentric[view, row, column]
    hit.depth = gbuffer.depth[view, row, column]
    return hit


@wp.func
def triangle_normal(meshes: Meshes, mesh: int, triangle: int) -> wp.vec3:
    """Unit normal of a mesh's triangle, in the mesh's own frame."""
    return meshes.face_normal[meshes.first_triangle[mesh] + triangle]


@wp.func
def face_normal(meshes: Meshes, shot: AnyShot, view: int, hit: Hit) -> wp.vec3:
    """Geometric unit normal of a hit in the world; its sign is that of the triangle's winding, not towards the ray."""
    if hit.segment == Segment.TABLE:
        return wp.vec3(0.0, 0.0, 1.0)
    body = body_of(hit.segment, shot.views.instances)
    return wp.transpose(shot.bodies.world_rotation[view, body]) * triangle_normal(meshes, shot.bodies.mesh[view, body], hit.triangle)
