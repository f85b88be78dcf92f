"""Depth sensors on transparent bodies: holes, and what is measured and seen behind them.

A module of its own, since scenes without these layers need `images.transparency` alone.
"""

import warp as wp

from synpick_warp.codes import Stream
from synpick_warp.kernels.render.images.camera_effects import SensorParameters, shot_key
from synpick_warp.kernels.render.images.depth_sensor import measured_pixel
from synpick_warp.kernels.render.images.infrared import eye_hit, infrared_byte, infrared_light
from synpick_warp.kernels.render.images.layers import LayerScene
from synpick_warp.kernels.render.lighting.color import luminance
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.transparency import passing_light
from synpick_warp.kernels.render.visibility.camera import camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, GBuffer, ViewBodies, body_of, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import normal_pair, pixel_key, view_key
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False})

PATCH_WIDTH = wp.constant(0.02)
"""Cell of the noise by which a depth sensor fails on transparent bodies [m]. Holes of the four real frames of a D435 in the repository of
ClearGrasp (Sajjan et al., ICRA 2020) correlate by 0.68 at 6 mm and by 0.47 at 11 mm; those of this noise by 0.71 and 0.48."""


@wp.func
def patch_shares(key: wp.uint64, place: wp.vec3) -> wp.vec2:
    """Two independent noise values, each uniform in 0..1, at a point: 3D value noise (`depth_sensor.lattice_normals` in space), with cells
    of unit size, mapped to uniform by the normal distribution's CDF."""
    x, y, z = int(wp.floor(place[0])), int(wp.floor(place[1])), int(wp.floor(place[2]))
    part = place - wp.vec3(float(x), float(y), float(z))
    total, squares = wp.vec2(0.0, 0.0), float(0.0)
    for corner in range(8):
        right, down, deep = corner % 2, corner // 2 % 2, corner // 4
        weight = wp.where(right == 1, part[0], 1.0 - part[0]) * wp.where(down == 1, part[1], 1.0 - part[1])
        weight *= wp.where(deep == 1, part[2], 1.0 - part[2])
        total += weight * normal_pair(pixel_key(pixel_key(pixel_key(key, x + right), y + down), z + deep), 0)
        squares += weight * weight
    scale = wp.sqrt(2.0 * squares)
    return wp.vec2(0.5 + 0.5 * wp.erf(total[0] / scale), 0.5 + 0.5 * wp.erf(total[1] / scale))


@kernel_of_views(drawn=True)
def measure_behind_kernel(
    # Scene:
    scene: AnyScene,
    layer: LayerScene,
    # In:
    shot: AnyShot,
    behind_depth: wp.array3d[float],  # (view, row, column) [m]
    behind: wp.array3d[wp.uint16],  # (view, row, column)
    first: int,
    # Out:
    image_inout: wp.array3d[wp.uint16],  # (view, row, column)
):
    """Depth sensor on transparent bodies: replace depth measured on them as if opaque by that of what is `behind`, or by holes (0).

    For each patch of the surface (value noise, fixed to the body), the surface itself is measured with probability s / (s + p²): p is the
    tinted transmission of one pass, s = 1 - untinted transmission. Else the background, at a distance g behind the surface, is measured
    with probability exp(-g / clear_reach), closer by the refraction shift t (1 - 1 / n) of a pane of thickness t, index n; else a hole.
    Random stream: (seed, episode, camera, CLEAR). Launched over view, pixel (tile order, from flat index `first` on)."""
    grid, sensor, cameras = shot.grid, layer.sensor, shot.views.cameras
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    at_row, at_column = measured_pixel(sensor, grid, shot_key(sensor.seed, shot, view, Stream.DEPTH_NOISE), row, column)
    hit = read_hit(shot.gbuffer, view, at_row, at_column)
    ray = camera_ray(cameras, view, at_row, at_column, wp.vec2(0.0, 0.0))
    light = passing_light(scene, shot, view, hit, ray, hit.depth / cameras.intrinsics[view][0])
    passed = luminance(light.weight)
    if passed <= 0.0:
        return
    body = body_of(hit.segment, shot.views.instances)
    mesh = scene.meshes.id[shot.bodies.mesh[view, body]]
    place = wp.mesh_eval_position(mesh, hit.triangle, hit.barycentric[0], hit.barycentric[1])
    episode = shot.snapshot.episode[shot.views.world[view]]
    key = view_key(sensor.seed, episode, 0, shot.views.camera[view], Stream.CLEAR)
    share = patch_shares(pixel_key(key, body), place / PATCH_WIDTH)
    own = 1.0 - light.passing
    if share[0] * (own + passed * passed) < own:
        return
    counts = float(0.0)
    if share[1] < wp.exp((hit.depth - behind_depth[view, at_row, at_column]) / sensor.clear_reach):
        glass = scene.surfaces.glass[scene.surfaces.row[view, body]]
        counts = wp.max(float(behind[view, row, column]) - sensor.counts_per_meter * glass[2] * (1.0 - 1.0 / glass[1]), 0.0)
    image_inout[view, row, column] = wp.uint16(wp.rint(counts))


@kernel_of_views(drawn=True, cuda_max_registers=RAY_REGISTERS)
def see_through_kernel(
    # Scene:
    scene: AnyScene,
    # In:
    sensor: SensorParameters,
    shot: AnyShot,
    opaque: ViewBodies,
    behind: GBuffer,
    eye: int,
    first: int,
    # Out:
    image_out: wp.array3d[wp.uint8],  # (view, row, column)
):
    """Infrared image (`render_infrared_kernel`) with what is behind transparent bodies: dimmed once for ambient light, twice for projected
    dots. No refraction, no shadows of dots. Launched over view, pixel (tile order, from flat index `first` on)."""
    view, row, column = tile_pixel(shot.grid, wp.tid() + first)
    if not in_image(shot.grid, row, column):
        return
    ray = camera_ray(shot.views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    offset = wp.where(eye == 0, 0.0, sensor.baseline)
    hit = eye_hit(scene, shot, shot.bodies, shot.gbuffer, view, row, column, ray, offset)
    light = infrared_light(scene, sensor, shot, shot.bodies, opaque, view, hit, ray, offset)
    passed = luminance(passing_light(scene, shot, view, hit, ray, hit.depth / shot.views.cameras.intrinsics[view][0]).weight)
    if passed > 0.0:
        hit = eye_hit(scene, shot, opaque, behind, view, row, column, ray, offset)
        further = infrared_light(scene, sensor, shot, opaque, opaque, view, hit, ray, offset)
        light += passed * wp.vec2(further[0], passed * further[1])
    image_out[view, row, column] = infrared_byte(sensor, shot, view, row, column, eye, light)
