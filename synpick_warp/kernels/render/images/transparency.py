"""What is seen through transparent bodies: added to an image from that of the scene behind, or by paths of the reference renderer."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.images.antialias import resolve_radiance
from synpick_warp.kernels.render.lighting.environment import environment_radiance, rotate_z
from synpick_warp.kernels.render.lighting.paths.tracing import (
    TERMINATED,
    AnyScene,
    PathRules,
    extend_path,
    init_path,
    make_vertex,
    next_vertex,
    pixel_context,
)
from synpick_warp.kernels.render.lighting.sampling import scrambled_point
from synpick_warp.kernels.render.lighting.surfaces import add_emission
from synpick_warp.kernels.render.lighting.transparency import passing_light
from synpick_warp.kernels.render.visibility.bvh_rays import hit_table, trace_camera_ray, trace_ray
from synpick_warp.kernels.render.visibility.camera import camera_ray, clamp_index, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, ShadedImage, ViewBodies, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})


@kernel_of_views(drawn=True)
def add_scene_behind_kernel(
    # Scene:
    scene: AnyScene,
    # In:
    shot: AnyShot,
    behind: ShadedImage,
    behind_depth: wp.array3d[float],  # (view, row, column) [m]
    first: int,
    # Out:
    image_inout: ShadedImage,
):
    """Add the radiance of the scene behind to pixels of transparent bodies, from the pixel where the bent ray leads (screen-space
    refraction), unless that pixel shows something in front of them. Launched over view, pixel (tile order, from flat index `first` on)."""
    grid, cameras = shot.grid, shot.views.cameras
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    hit = read_hit(shot.gbuffer, view, row, column)
    ray = camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))
    intrinsics = cameras.intrinsics[view]
    light = passing_light(scene, shot, view, hit, ray, hit.depth / intrinsics[0])
    if wp.max(light.weight) <= 0.0:
        return
    bent = wp.transpose(cameras.to_world[view]) * light.direction
    right = intrinsics[0] * (bent[0] / bent[2] - ray[0])
    down = intrinsics[1] * (bent[1] / bent[2] - ray[1])
    at_row = clamp_index(row + int(wp.round(down)), grid.height)
    at_column = clamp_index(column + int(wp.round(right)), grid.width)
    if bent[2] <= 0.0 or behind_depth[view, at_row, at_column] < hit.depth:
        at_row = row
        at_column = column
    image_inout.radiance[view, row, column] += wp.cw_mul(light.weight, resolve_radiance(behind, view, at_row, at_column))


@kernel_of_views(drawn=True)
def trace_scene_behind_kernel(scene: AnyScene, shot: AnyShot, opaque: ViewBodies, rules: PathRules, first: int, image_inout: ShadedImage):
    """Path-traced transmission: camera paths that meet a transparent body continue behind it, among `opaque` bodies alone, and their mean
    radiance is added to the image. Random numbers are those of `trace_paths_kernel`. Launched over view, pixel (tile order, from flat index
    `first` on)."""
    grid, views = shot.grid, shot.views
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    context = pixel_context(shot, rules, view, row, column)
    footprint = 1.0 / (views.cameras.intrinsics[view][0] * wp.sqrt(float(rules.samples)))
    total = wp.vec3(0.0, 0.0, 0.0)
    for index in range(rules.samples):
        ray = camera_ray(views.cameras, view, row, column, scrambled_point(context.key, index, 0) - wp.vec2(0.5, 0.5))
        front = trace_camera_ray(scene.meshes, shot.bodies, view, tile_of(grid, row, column), ray, views.instances)
        front = hit_table(scene.table, views.cameras, view, ray, front)
        light = passing_light(scene, shot, view, front, ray, footprint * front.depth)
        if wp.max(light.weight) > 0.0:
            direction = light.direction
            hit = trace_ray(scene.meshes, scene.table, opaque, view, views.instances, light.start, direction)
            if hit.segment == Segment.NOTHING:
                radiance = environment_radiance(scene.lights, context.light, rotate_z(direction, -context.yaw))
                total += wp.cw_mul(light.weight, radiance)
            else:
                width = footprint * (front.depth + hit.depth)
                vertex = make_vertex(scene, shot, view, hit, light.start + hit.depth * direction, -direction, width, 0.0, False)
                diffuse = vertex.brdf.diffuse
                emitted = add_emission(scene.surfaces, wp.vec3(), vertex.emission, scene.lights.exposure[context.light])
                path = init_path(width)
                while path.bounce != TERMINATED:
                    if path.bounce > 0:
                        vertex = next_vertex(scene, shot, rules, context, path)
                    path = extend_path(scene, shot, rules, context, index, diffuse, path, vertex)
                radiance = wp.cw_mul(diffuse, path.radiance.diffuse + path.radiance.indirect) + path.radiance.specular
                total += wp.cw_mul(light.weight, radiance + emitted)
    image_inout.radiance[view, row, column] += total / float(rules.samples)
