"""Multipath interference of depth sensors: projector light that reaches a pixel indirectly, over a second surface seen in specular
reflection.

It is a separate module so that sensors without multipath do not compile the ray tracing.
"""

from typing import Any

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.images.camera_effects import shot_key
from synpick_warp.kernels.render.images.depth_sensor import measured_pixel, read_out
from synpick_warp.kernels.render.images.layers import LayerScene
from synpick_warp.kernels.render.lighting.brdf import Brdf, evaluate_brdf, specular_albedo
from synpick_warp.kernels.render.lighting.color import luminance
from synpick_warp.kernels.render.lighting.finish import FinishedBrdf
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene, make_vertex
from synpick_warp.kernels.render.visibility.bvh_rays import is_blocked, trace_ray
from synpick_warp.kernels.render.visibility.camera import camera_ray, hit_position, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False})


@wp.func
def returned_light(scene: AnyScene, vertex: Any, projector: wp.vec3) -> float:
    """Luminance that a surface reflects of a point light of unit intensity: BRDF · cosine / distance²; 0 for a light behind it."""
    away = projector - vertex.origin
    direction = wp.normalize(away)
    if wp.dot(vertex.face_normal, direction) <= 0.0:
        return 0.0
    value = evaluate_brdf(scene.surfaces.albedo, vertex.brdf, direction)
    return luminance(value.specular + value.diffuse * vertex.brdf.diffuse) / wp.dot(away, away)


@wp.func
def mirror_albedo(brdf: Brdf) -> float:
    """Directional albedo of the specular lobe, as luminance."""
    return luminance(specular_albedo(brdf))


@wp.func
def mirror_albedo(brdf: FinishedBrdf) -> float:  # noqa: F811
    """Directional albedo of clear coat and specular lobe, as luminance."""
    return wp.lerp(1.0, luminance(specular_albedo(brdf)), brdf.passing)


@wp.func
def mirrored_light(scene: AnyScene, shot: AnyShot, view: int, vertex: Any, projector: wp.vec3, width: float) -> wp.vec2:
    """Indirect light of a pixel, found by one mirror ray from its surface p to a second surface q.

    Returns its radiance E L and the extra path length (|cp| + |pq| + |qc|) / 2 - |cp| [m], or zeros. E is the specular albedo of p; the
    whole lobe is assumed to hit q, which overestimates rough metal. L is the radiance from q to p, lit by the projector c if nothing
    occludes it. `width`: footprint of the pixel [m]."""
    none, instances, mirror = wp.vec2(0.0, 0.0), shot.views.instances, vertex.brdf
    direction = 2.0 * wp.dot(mirror.normal, mirror.outgoing) * mirror.normal - mirror.outgoing
    if wp.dot(direction, vertex.face_normal) <= 0.0:
        return none
    hit = trace_ray(scene.meshes, scene.table, shot.bodies, view, instances, vertex.origin, direction)
    if hit.segment == Segment.NOTHING:
        return none
    second = make_vertex(scene, shot, view, hit, vertex.origin + hit.depth * direction, -direction, width, 0.0, True)
    light = returned_light(scene, second, projector)
    back = projector - second.origin
    reach = wp.length(back)
    if light <= 0.0 or is_blocked(scene.meshes, scene.table, shot.bodies, view, instances, second.origin, back / reach, reach):
        return none
    return wp.vec2(mirror_albedo(mirror) * light, 0.5 * (hit.depth + reach - wp.length(projector - vertex.origin)))


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def add_multipath_kernel(
    # Scene:
    scene: AnyScene,
    layer: LayerScene,
    # In:
    shot: AnyShot,
    share: float,
    first: int,
    # Out:
    image_inout: wp.array3d[wp.uint16],  # (view, row, column)
):
    """Two-path multipath interference: add w times the extra length of the indirect path to the range, with w = s L_i / (L_d + s L_i).

    L_d and L_i are the direct and indirect radiance of a point light at the camera, s is `share`, the fraction of indirect light that the
    sensor does not reject. This approximates the phase of both returns (Freedman et al., ECCV 2014) if the extra length is small compared
    with the modulation wavelength. Pixels with s L_i > L_d are holes, as their codes are decoded wrongly (Gupta et al., CVPR 2011). Noise
    and quantization are those of the sensor without multipath. Diffuse interreflection and caustics are not modelled. Launched over view,
    pixel (tile order, starting at flat index `first`)."""
    grid, sensor, cameras = shot.grid, layer.sensor, shot.views.cameras
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or int(image_inout[view, row, column]) == 0:
        return
    key = shot_key(sensor.seed, shot, view, Stream.DEPTH_NOISE)
    at_row, at_column = measured_pixel(sensor, grid, key, row, column)
    hit = read_hit(shot.gbuffer, view, at_row, at_column)
    ray = camera_ray(cameras, view, at_row, at_column, wp.vec2(0.0, 0.0))
    toward = wp.normalize(cameras.to_world[view] * ray)
    projector, start = wp.vec3(cameras.center[view]), hit_position(cameras, view, ray, hit.depth)
    width = hit.depth / cameras.intrinsics[view][0]
    vertex = make_vertex(scene, shot, view, hit, start, -toward, width, 0.0, False)
    path = mirrored_light(scene, shot, view, vertex, projector, width)
    indirect = share * path[0]
    if indirect <= 0.0:
        return
    direct = returned_light(scene, vertex, projector)
    if indirect > direct:
        image_inout[view, row, column] = wp.uint16(0)
        return
    bias, cosine = indirect / (direct + indirect) * path[1] / wp.length(ray), wp.abs(wp.dot(vertex.face_normal, toward))
    image_inout[view, row, column] = read_out(layer, shot, view, row, column, hit.depth, cosine, bias)
