"""The fast picture's light: few paths for each cell of pixels, and a filter that shares them among neighbours on the same surface.

What a path finds is kept beside what the surface would reflect of the map if nothing stood in the way, which is known without any
path. Their ratio changes slowly over a surface, even where it bends or its colour changes; so the ratio is what is filtered, and
each pixel multiplies it by its own unhindered light (after Heitz, Hill and McGuire, 2018).
"""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.lighting.brdf import even_gloss
from synpick_warp.kernels.render.lighting.coarse_grid import CellGrid, Guide, cell_number, cell_pixel, spread_cell
from synpick_warp.kernels.render.lighting.color import LEAST_LIGHT
from synpick_warp.kernels.render.lighting.path_tracing import (
    ENDED,
    PathRules,
    PathScene,
    Place,
    Reflected,
    Vertex,
    begun,
    scattered,
    vertex_at,
)
from synpick_warp.kernels.render.lighting.unoccluded import Light, even_light
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, hit_position, in_image
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, ViewBodies, read_hit
from synpick_warp.kernels.rng import stream_key

wp.set_module_options({"enable_backward": False, "fast_math": True})

GATHER_REGISTERS = 56
"""As `kernels.render.visibility.gbuffer.RAY_REGISTERS`; with paths, a few less are better still."""
PERIOD = wp.constant(16)
"""Cells take their points from one sequence by their place in squares of PERIOD x PERIOD; aligned smaller squares hold aligned runs."""
MOST_BOUNCES = wp.constant(4.0)
"""A path's light from other surfaces counts by so many times what a white one that faces the main light sends back more: few paths find
such a one, and those for others, too."""
PHASES = wp.constant(1.0)
"""Points of the first dimension move so far through their unit square along the picture's height and width: slowly within a window, which
so keeps its points evenly spread, but enough for the picture's mean to be right."""


@wp.struct
class Gathered:
    """Scratch, one a view and cell: light that its surface reflects; diffuse light without the surface's colour."""

    diffuse: wp.array3d[wp.vec3]
    """From the map, without its main light."""
    gloss: wp.array3d[wp.vec3]
    """From the map, without its main light, and from other surfaces."""
    even_diffuse: wp.array3d[wp.vec3]
    even_gloss: wp.array3d[wp.vec3]
    """Both if nothing stood in the way."""
    between: wp.array3d[wp.vec3]
    """Diffuse light from other surfaces: it changes slowly, but few of the paths find much of it."""
    variance: wp.array3d[wp.vec2]
    """Of the ratios of `diffuse` and of `gloss` to even light, in luminance; of means, not of single paths."""


@wp.func
def limited(light: wp.vec3, most: wp.vec3) -> wp.vec3:
    """`light`, made darker if it exceeds `most`, in the same colour."""
    return light * wp.min(1.0, wp.max(most) / wp.max(wp.max(light), LEAST_LIGHT))


@wp.func
def paths_place(
    scene: PathScene,
    cells: CellGrid,
    rules: PathRules,
    views: Views,
    view: int,
    row: int,
    column: int,
    episode: int,
    light: int,
    turn: float,
) -> Place:
    """Where a cell's paths are. All of an episode's pictures take their points from one stream, so that what rests looks the same."""
    place = Place()
    place.view = view
    place.instances = views.instances
    place.light = light
    place.first_light = light + scene.lights.maps
    place.turn = turn
    place.key = stream_key(rules.seed, episode, 0, Stream.PATHS)
    place.shift = wp.vec2(PHASES * float(row) / float(cells.cells.height), PHASES * float(column) / float(cells.cells.width))
    return place


@wp.func
def mean_light(
    scene: PathScene,
    bodies: ViewBodies,
    rules: PathRules,
    place: Place,
    number: int,
    first: Vertex,
    width: float,
    even: Light,
    most_share: float,
) -> Reflected:
    """What the surface at `first` reflects of the light that paths from `number` on find, on the average.

    A path counts with at most `most_share` times the light that comes if nothing hides it, `even`; what other surfaces send, by
    MOST_BOUNCES more, since `even` knows nothing of the main light.
    """
    sum = Reflected()
    bounced = (MOST_BOUNCES / wp.PI) * scene.lights.main_irradiance[place.light]
    # One loop over all scatterings of all paths: a thread whose path ends early begins the next while others of its warp go on.
    sample = int(0)
    path = begun(first, width)
    while sample < rules.samples:
        path = scattered(scene, bodies, rules, place, number + sample, first.brdf.diffuse, path)
        if path.bounce == ENDED:
            sum.diffuse += limited(path.found.diffuse, most_share * even.diffuse)
            sum.between += limited(path.found.between, most_share * even.diffuse + bounced)
            sum.gloss += limited(path.found.gloss, most_share * even.gloss + wp.cw_mul(even_gloss(first.brdf), bounced))
            path = begun(first, width)
            sample += 1
    share = 1.0 / float(rules.samples)
    sum.diffuse = share * sum.diffuse
    sum.between = share * sum.between
    sum.gloss = share * sum.gloss
    return sum


@wp.kernel(cuda_max_registers=GATHER_REGISTERS)
def gather_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    cells: CellGrid,
    # State:
    episode: wp.array[int],
    light: wp.array[int],
    light_yaw: wp.array[float],
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    rules: PathRules,
    most_share: float,
    first: int,
    # Out:
    guide_out: Guide,
    gathered_out: Gathered,
):
    """Mean of N paths from the pixel in each cell's middle, and the light that they would find if nothing stood in their way.

    The main light is left out of the first surface's light: it casts sharp shadows, and is looked for at more pixels.
    """
    view, row, column = spread_cell(cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    pixel = cell_pixel(cells, row, column)
    hit = read_hit(gbuffer, view, pixel[0], pixel[1])
    guide_out.segment[view, row, column] = wp.uint8(hit.segment)
    if hit.segment == Segment.NOTHING:
        return
    camera = views.camera[view]
    world = views.world[view]
    ray = camera_ray(cameras.intrinsics[camera], pixel[0], pixel[1], wp.vec2(0.0, 0.0))
    outgoing = -wp.normalize(cameras.to_world[camera] * ray)
    position = hit_position(cameras, camera, ray, hit.depth)
    width = float(cells.size) * hit.depth / cameras.intrinsics[camera][0]
    vertex = vertex_at(scene, bodies, view, views.instances, hit, position, outgoing, width, 0.0)

    place = paths_place(scene, cells, rules, views, view, row, column, episode[world], light[world], light_yaw[world])
    even = even_light(scene.lights, place.light, place.turn, vertex.brdf)
    number = cell_number(PERIOD, row, column) * rules.samples
    found = mean_light(scene, bodies, rules, place, number, vertex, width, even, most_share)
    gathered_out.diffuse[view, row, column] = found.diffuse
    gathered_out.between[view, row, column] = found.between
    gathered_out.gloss[view, row, column] = found.gloss
    gathered_out.even_diffuse[view, row, column] = even.diffuse
    gathered_out.even_gloss[view, row, column] = even.gloss
    guide_out.normal[view, row, column] = wp.transpose(cameras.to_world[camera]) * vertex.brdf.normal
    guide_out.depth[view, row, column] = hit.depth
