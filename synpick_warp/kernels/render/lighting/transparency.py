"""Transparent bodies: their place among a view's bodies, and how much light from behind passes their first surface, along which ray.

What is behind is the scene without any transparent body. Bodies that transmit half of the light or more cast no shadow and are in no
reflection; the others cast whole ones.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import coat_albedo, widen_roughness
from synpick_warp.kernels.render.lighting.materials import brdf_of, interpolate_surface, material_at, sample_base_color, wear_at
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.surfaces import RandomizedSurfaces
from synpick_warp.kernels.render.visibility.camera import hit_position
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Hit, ViewBodies, body_of
from synpick_warp.kernels.render.visibility.ray_bodies import RAY_RECORDS

wp.set_module_options({"enable_backward": False})

SHADOWLESS = wp.constant(0.5)
"""Transmission from which on a body casts no shadow."""


@wp.struct
class BodyGroups:
    """Bodies of views by rank: opaque ones first, then transparent ones with a shadow, those without one last. Members are as those of
    `ViewBodies`, by whose names they replace them."""

    order: wp.array2d[int]
    """(view, rank)."""
    ray_record: wp.array3d[wp.vec4]
    """(view, rank, record)."""
    opaque: wp.array[int]
    """(view): number of opaque bodies, which are behind ..."""
    blocking: wp.array[int]
    """(view): ... and with those that cast shadows, which all other rays meet."""
    body_mask: wp.array3d[wp.uint64]
    """(view, tile, word): of opaque bodies alone."""


@wp.func
def group_of(surfaces: RandomizedSurfaces, view: int, body: int) -> int:
    """0: the body is opaque; 1: it is transparent and casts a shadow; 2: it casts none."""
    transmission = surfaces.glass[surfaces.row[view, body]][0]
    return wp.where(transmission > 0.0, wp.where(transmission < SHADOWLESS, 1, 2), 0)


@wp.kernel
def group_bodies_kernel(surfaces: RandomizedSurfaces, bodies: ViewBodies, groups_out: BodyGroups):
    """Stable sort of each view's bodies by `group_of`, opaque ones first. Launched over view, rank."""
    view, rank = wp.tid()
    present = bodies.present[view]
    own = int(-1)
    if rank < present:
        own = group_of(surfaces, view, bodies.order[view, rank])
    place = int(0)
    opaque = int(0)
    blocking = int(0)
    for other in range(present):
        group = group_of(surfaces, view, bodies.order[view, other])
        opaque += wp.where(group == 0, 1, 0)
        blocking += wp.where(group < 2, 1, 0)
        if group < own or (group == own and other < rank):
            place += 1
    if rank == 0:
        groups_out.opaque[view] = opaque
        groups_out.blocking[view] = blocking
    if own >= 0:
        groups_out.order[view, place] = bodies.order[view, rank]
        for record in range(RAY_RECORDS):
            groups_out.ray_record[view, place, record] = bodies.ray_record[view, rank, record]


@wp.struct
class PassingLight:
    """Light that passes a surface towards the camera: factor on that from behind, and the ray by which this is seen."""

    weight: wp.vec3
    passing: float
    """The same without the tint of the surface."""
    direction: wp.vec3
    """Unit direction from the camera to where the light enters the body, in the world."""
    start: wp.vec3
    """Point on this ray as far as the surface, in the world [m]."""


@wp.func
def passing_light(scene: AnyScene, shot: AnyShot, view: int, hit: Hit, ray: wp.vec3, width: float) -> PassingLight:
    """Light that passes the first surface of a camera ray: what the coat lets in, tinted by the base colour; zero where it is opaque. It is
    bent once, by the thickness of the body, as in a pane. `width` is the pixel's footprint [m]."""
    result = PassingLight()
    if hit.segment == Segment.NOTHING or hit.segment == Segment.TABLE:
        return result
    body = body_of(hit.segment, shot.views.instances)
    glass = scene.surfaces.glass[scene.surfaces.row[view, body]]
    if glass[0] == 0.0:
        return result
    cameras = shot.views.cameras
    outgoing = -wp.normalize(cameras.to_world[view] * ray)
    surface = interpolate_surface(scene.meshes, scene.surfaces, shot.bodies, view, body, hit.triangle, hit.barycentric, outgoing, width)
    wear = wear_at(scene.surfaces, surface, False)
    material = material_at(scene.surfaces, surface, wear)
    roughness = widen_roughness(material.roughness, surface.normal_spread)
    brdf = brdf_of(scene.surfaces, surface, material, roughness, outgoing, 0.0)
    # Dust covers; what is no metal does not rust.
    result.passing = material.transmission * (1.0 - wear.share[3]) * (1.0 - coat_albedo(brdf, brdf.albedo))
    result.weight = result.passing * sample_base_color(scene.surfaces, surface)
    cosine = wp.dot(brdf.normal, outgoing)
    eta = 1.0 / glass[1]
    bent = (eta * cosine - wp.sqrt(1.0 - eta * eta * (1.0 - cosine * cosine))) * brdf.normal - eta * outgoing
    position = hit_position(cameras, view, ray, hit.depth)
    entry = position + glass[2] * bent
    result.direction = wp.normalize(entry - wp.vec3(cameras.center[view]))
    result.start = entry - wp.dot(entry - position, result.direction) * result.direction
    return result
