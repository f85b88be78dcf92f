"""Infrared images of an active stereo camera: a rectified pair that sees ambient light and a projected dot pattern.

The left camera is the view's own, whose G-buffer is read; rays of the right one, beside it along the image's rows, are traced.
"""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.images.camera_effects import SensorParameters, shot_key
from synpick_warp.kernels.render.images.layers import seen_surface
from synpick_warp.kernels.render.lighting.brdf import AnyBrdf, evaluate_brdf, widen_roughness
from synpick_warp.kernels.render.lighting.color import luminance
from synpick_warp.kernels.render.lighting.environment import environment_radiance, rotate_z
from synpick_warp.kernels.render.lighting.materials import brdf_of, material_at, wear_at
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET, is_blocked, trace_ray
from synpick_warp.kernels.render.visibility.camera import AnyViews, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, GBuffer, Hit, ViewBodies, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import normal_pair, pixel_key, uniform
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False})

DOT_SIZE = wp.constant(0.7)
"""Standard deviation of a projected dot [px]: a sharper one would fall between pixels."""
DOT_PATTERN = wp.constant(wp.uint64(0x9E6D62D06F6A9A9B))
"""Key of the places of dots: the pattern is that of a product, the same in all bakes."""
LEAST_LIGHT = wp.constant(1.0e-4)
"""Light of dots below this, a fortieth of a grey level, needs no shadow ray."""


@wp.func
def dot_pattern(column: float, row: float, spacing: float) -> float:
    """Projected pattern at a place of the projector's image [px]: in each cell, `spacing` wide, a Gaussian dot at a random place.
    Stratified places have no large gaps, and repeat nowhere, as those of a lattice would, so that each window has one match."""
    x = int(wp.floor(column / spacing))
    y = int(wp.floor(row / spacing))
    light = float(0.0)
    # Not unrolled.
    one = int(1)
    for down in range(-one, one + 1):
        for right in range(-one, one + 1):
            key = pixel_key(pixel_key(DOT_PATTERN, y + down), x + right)
            away_x = column - spacing * (float(x + right) + uniform(key, 0))
            away_y = row - spacing * (float(y + down) + uniform(key, 1))
            light += wp.exp(-0.5 * (away_x * away_x + away_y * away_y) / (DOT_SIZE * DOT_SIZE))
    return wp.min(light, 1.0)


@wp.func
def eye_hit(
    scene: AnyScene, shot: AnyShot, bodies: ViewBodies, gbuffer: GBuffer, view: int, row: int, column: int, ray: wp.vec3, offset: float
) -> Hit:
    """Closest hit of a pixel's ray of the left camera, which is in the G-buffer, or of one beside it by `offset` [m]; planar depth."""
    hit = read_hit(gbuffer, view, row, column)
    if offset > 0.0:
        cameras = shot.views.cameras
        origin = wp.vec3(cameras.center[view]) + cameras.to_world[view] * wp.vec3(offset, 0.0, 0.0)
        direction = wp.normalize(cameras.to_world[view] * ray)
        hit = trace_ray(scene.meshes, scene.table, bodies, view, shot.views.instances, origin, direction)
        hit.depth = hit.depth / wp.length(ray)
    return hit


@wp.func
def dot_light(
    scene: AnyScene, sensor: SensorParameters, bodies: ViewBodies, views: AnyViews, view: int, point: wp.vec3, face: wp.vec3, brdf: AnyBrdf
) -> float:
    """Brightness of projected dots at a surface point, `point` in the camera's axes [m]: that of a white surface is the pattern's by
    cosine / z², in the open. `face`: geometric normal."""
    cameras = views.cameras
    from_projector = point - wp.vec3(sensor.projector, 0.0, 0.0)
    scale = cameras.intrinsics[view][0] / from_projector[2]
    light = sensor.dot_brightness / (from_projector[2] * from_projector[2])
    light *= dot_pattern(scale * from_projector[0], scale * from_projector[1], sensor.dot_spacing)
    to_projector = -wp.normalize(cameras.to_world[view] * from_projector)
    if light < LEAST_LIGHT or wp.dot(face, to_projector) <= 0.0:
        return 0.0
    value = evaluate_brdf(scene.surfaces.albedo, brdf, to_projector)
    reflected = wp.PI * light * luminance(value.diffuse * brdf.diffuse + value.specular)
    start = wp.vec3(cameras.center[view]) + cameras.to_world[view] * point + RAY_OFFSET * face
    reach = wp.length(from_projector)
    if reflected < LEAST_LIGHT or is_blocked(scene.meshes, scene.table, bodies, view, views.instances, start, to_projector, reach):
        return 0.0
    return reflected


@wp.func
def infrared_light(
    scene: AnyScene,
    sensor: SensorParameters,
    shot: AnyShot,
    bodies: ViewBodies,
    blockers: ViewBodies,
    view: int,
    hit: Hit,
    ray: wp.vec3,
    offset: float,
) -> wp.vec2:
    """Ambient and projected light of a hit on `bodies` along a ray of the camera that is beside the left one by `offset` [m]; `blockers`
    cast shadows of dots. Ambient light is the unoccluded environment's luminance, without lamps; surfaces reflect it as visible light."""
    cameras = shot.views.cameras
    world = shot.views.world[view]
    which = shot.snapshot.light[world]
    yaw = shot.snapshot.light_yaw[world]
    outgoing = -wp.normalize(cameras.to_world[view] * ray)
    radiance = float(0.0)
    dots = float(0.0)
    if hit.segment == Segment.NOTHING:
        radiance = luminance(environment_radiance(scene.lights, which, rotate_z(-outgoing, -yaw)))
    else:
        point = hit.depth * ray + wp.vec3(offset, 0.0, 0.0)
        surface = seen_surface(scene, shot, bodies, view, hit, point, outgoing)
        material = material_at(scene.surfaces, surface, wear_at(scene.surfaces, surface, False))
        roughness = widen_roughness(material.roughness, surface.normal_spread)
        brdf = brdf_of(scene.surfaces, surface, material, roughness, outgoing, 0.0)
        ambient = unoccluded_light(scene.lights, which, yaw, brdf)
        radiance = luminance(wp.cw_mul(brdf.diffuse, ambient.diffuse) + ambient.specular)
        dots = dot_light(scene, sensor, blockers, shot.views, view, point, surface.face_normal, brdf)
    return wp.vec2(sensor.ambient * scene.lights.exposure[which] * radiance, dots)


@wp.func
def infrared_byte(sensor: SensorParameters, shot: AnyShot, view: int, row: int, column: int, eye: int, light: wp.vec2) -> wp.uint8:
    """Pixel of an infrared image, with noise of the random number stream (seed, episode, frame, camera, INFRARED_NOISE), eye and pixel."""
    key = shot_key(sensor.seed, shot, view, Stream.INFRARED_NOISE)
    noise = normal_pair(pixel_key(key, (eye * shot.grid.height + row) * shot.grid.width + column), 0)[0]
    return wp.uint8(wp.rint(255.0 * wp.clamp(light[0] + light[1] + sensor.infrared_noise * noise, 0.0, 1.0)))


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def render_infrared_kernel(
    # Scene:
    scene: AnyScene,
    # In:
    sensor: SensorParameters,
    shot: AnyShot,
    eye: int,
    first: int,
    # Out:
    image_out: wp.array3d[wp.uint8],  # (view, row, column)
):
    """Infrared image of the left (eye 0) or right (1) camera: 8 bits, linear, with noise, at one ray a pixel. Launched over view, pixel
    (tile order, from flat index `first` on)."""
    view, row, column = tile_pixel(shot.grid, wp.tid() + first)
    if not in_image(shot.grid, row, column):
        return
    ray = camera_ray(shot.views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    offset = wp.where(eye == 0, 0.0, sensor.baseline)
    hit = eye_hit(scene, shot, shot.bodies, shot.gbuffer, view, row, column, ray, offset)
    light = infrared_light(scene, sensor, shot, shot.bodies, shot.bodies, view, hit, ray, offset)
    image_out[view, row, column] = infrared_byte(sensor, shot, view, row, column, eye, light)
