"""Constant device data of the renderer: meshes, surfaces, cameras, lights. Shared by all worlds."""

from dataclasses import astuple, dataclass, replace
from typing import Any

import cv2
import numpy as np
import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.episodes.randomize import OFF
from synpick_warp.kernels.render.images.layers import SuctionScene
from synpick_warp.kernels.render.lighting.color import MAX_HALF
from synpick_warp.kernels.render.lighting.environment import MAX_LAMPS, Lights
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.lighting.shadows import LAMP_POINTS
from synpick_warp.kernels.render.lighting.surfaces import (
    GLOW_MAP,
    METALLIC_MAP,
    METALLIC_MASK,
    METALLIC_SHIFT,
    NORMAL_MAP,
    NORMAL_STEPS,
    NORMAL_ZERO,
    OPACITY_MASK,
    OPACITY_SHIFT,
    ROUGHNESS_MAP,
    ROUGHNESS_MASK,
    ROUGHNESS_SHIFT,
    TEXEL_BITS,
    TEXEL_MASK,
    TRIANGLE_RECORDS,
    Surfaces,
)
from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, ImageGrid
from synpick_warp.kernels.render.visibility.gbuffer import FAR, Meshes, Table
from synpick_warp.kernels.render.visibility.props import Props
from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.bins import TABLE_ROUGHNESS
from synpick_warp.scenes.environment import LUMINANCE
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.modelling import project_from_box
from synpick_warp.scenes.types import MAP_CENTER, OPAQUE, PLAIN, Camera, Catalog, EnvironmentMap, Fixture, Interior, Material, TriangleMesh
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.light_tables import (
    EnvironmentTables,
    build_environment_cdf,
    measure_albedo,
    precompute_environment,
    sh_basis,
)
from synpick_warp.stages.render.wide_bvh import build_wide_bvh
from synpick_warp.system.hardware.cores import map_in_threads
from synpick_warp.system.linear_algebra import dot, matmul


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Scene on the device, shared by all views, as kernel structs."""

    meshes: Any
    """The struct `Meshes`."""
    surfaces: Any
    """The struct `Surfaces`: materials and textures."""
    cameras: Any
    """The struct `CameraTable`."""
    lights: Any
    """The struct `Lights`: environment maps."""
    table: Any
    """The struct `Table`."""
    paths: Any
    """The struct `PathScene`, or a variant (`AnyScene`): all of the above that path tracing reads."""
    plain: Any
    """The struct `PathScene`, for kernels that read no materials of views."""
    grid: Any
    """The struct `ImageGrid` of the cameras' images."""
    obj_id: wp.array
    """obj_id of each catalog mesh (entry) int32; negative: a distractor or prop, without label."""
    camera_count: int
    device: wp.Device
    keep: tuple[wp.Mesh, ...]
    """Owners of the meshes whose handles `meshes` holds."""
    looks: Looks | None = None
    """What episodes draw their looks from; the textures' materials are the last rows of `surfaces`."""
    props: Any = None
    """The struct `Props`; None: there are none."""
    prop_count: int = 0
    suction_maps: Any = None
    """The struct `SuctionScene`: cup and centres of mass, of the layers `suction_seal` and `suction_wrench`."""

    glass: Any = None
    """(material): transmission, index of refraction, thickness [m]; None: all of them are opaque, and no episode draws another."""
    emission: tuple[wp.array, wp.array] | None = None
    """Arrays `emission` and `glow` of the struct `RandomizedSurfaces`; None if no material emits light."""
    finish: wp.array | None = None
    """Array `finish` of the struct `RandomizedSurfaces`; None: no material has a clear coat or is anisotropic."""

    @property
    def has_details(self) -> bool:
        """Whether a material has normal, roughness or metallic maps, or some are transparent or emit light."""
        return self.surfaces is not None and (
            self.surfaces.detail.size > 1 or self.is_transparent or self.emission is not None or self.finish is not None
        )

    @property
    def is_transparent(self) -> bool:
        """Whether some objects are or may be transparent."""
        return self.glass is not None

    @property
    def width(self) -> int:
        """Width of the images [px]."""
        return self.grid.width

    @property
    def height(self) -> int:
        """Height of the images [px]."""
        return self.grid.height


ALL_MAPS = int(NORMAL_MAP) | int(ROUGHNESS_MAP) | int(METALLIC_MAP)
"""Bits of `Surfaces.maps` of a material with maps: a file that states only some has its constants in the others."""


def blank_scene(cameras: int, width: int, height: int, device: wp.Device, glass: Any = None, props: int = 0) -> RenderScene:
    """Scene of cameras, and a number of props, without content: in a dry run, constructors ask it for sizes alone. `glass`: True if objects
    are transparent."""
    content = dict.fromkeys(("meshes", "surfaces", "cameras", "lights", "table", "paths", "plain"))
    ids, grid = wp.empty(0, dtype=wp.int32, device="cpu"), build_grid(width, height)
    more = {"glass": glass, "prop_count": props}
    return RenderScene(**content, grid=grid, obj_id=ids, camera_count=cameras, device=device, keep=(), **more)


def mip_levels(texture: np.ndarray) -> list[np.ndarray]:
    """Mip pyramid of a texture (H, W, 3) uint8: box-filtered in linear light, down to one texel."""
    levels = [np.ascontiguousarray(texture)]
    linear = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)[texture]
    while max(linear.shape[:2]) > 1:
        height, width = linear.shape[:2]
        linear = cv2.resize(linear, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
        levels.append(np.rint(linear_to_srgb(linear) * 255.0).astype(np.uint8))
    return levels


def pack_texels(image: np.ndarray) -> np.ndarray:
    """Pack an sRGB image (H, W, 3) uint8 into texels (H W) uint32: the layout of `Surfaces.texel`."""
    bits = int(TEXEL_BITS)
    root = np.rint(np.sqrt(srgb_to_linear(np.arange(256) / 255.0)) * int(TEXEL_MASK)).astype(np.uint32)
    red, green, blue = root[image.reshape(-1, 3).T]
    return red | green << bits | blue << 2 * bits


def pack_opacity(opacity: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bits of the texels (H W) uint32 of a mip level of this shape (H, W, 3) for a material's opacity."""
    level = cv2.resize(opacity, shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.rint(level.reshape(-1) / 255.0 * int(OPACITY_MASK)).astype(np.uint32) << int(OPACITY_SHIFT)


def packed_levels(material: Material) -> list[np.ndarray]:
    """Mip pyramid of a material's texture with its opacity, each level packed as (H W) uint32; empty without a texture."""
    chain, opacity = [] if material.texture is None else mip_levels(material.texture), material.opacity
    packed = [pack_texels(level) for level in chain]
    return packed if opacity is None else [color | pack_opacity(opacity, level.shape) for color, level in zip(packed, chain, strict=True)]


def detail_levels(maps: np.ndarray) -> list[np.ndarray]:
    """Mip pyramid of maps (H, W, 4) uint8 as of `Material.maps`, packed (H W) uint32. The variance of the normals below a texel widens
    its roughness (Toksvig, 2005), as the squared GGX width, which is averaged."""
    scaled = maps.astype(np.float32)
    x, y = (scaled[..., :2].transpose(2, 0, 1) - MAP_CENTER) / (MAP_CENTER - 1)
    # In two images, as OpenCV averages at most four channels where a side is odd.
    planes = np.stack([x, y, np.sqrt(np.clip(1.0 - x * x - y * y, 0.0, 1.0))], axis=-1), scaled[..., 2:] / 255.0
    planes[1][..., 0] **= 4
    levels = [pack_details(*planes)]
    while max(planes[0].shape[:2]) > 1:
        height, width = planes[0].shape[:2]
        size = max(width // 2, 1), max(height // 2, 1)
        normals, values = (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes)
        planes = normals, values
        levels.append(pack_details(*planes))
    return levels


def pack_details(normals: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Texels (H W) uint32 of `Surfaces.detail` from filtered maps: mean normals (H, W, 3), squared GGX width and metallic (H, W, 2)."""
    normals, (alpha2, metallic) = normals.reshape(-1, 3), values.reshape(-1, 2).T
    length = np.clip(np.linalg.norm(normals, axis=1), 1e-3, 1.0)
    # Variance of a von Mises-Fisher distribution of normals along one axis, by the length of their mean (Banerjee et al., 2005).
    variance = (1.0 - length**2) / (length * (3.0 - length**2))
    roughness = np.clip(alpha2 + 2.0 * variance, 0.0, 1.0) ** 0.25
    x, y = np.rint(np.clip(normals[:, :2].T / length, -1.0, 1.0) * float(NORMAL_STEPS)).astype(np.int32) + int(NORMAL_ZERO)
    packed = (x | y << int(TEXEL_BITS)).astype(np.uint32)
    packed |= np.rint(roughness * int(ROUGHNESS_MASK)).astype(np.uint32) << int(ROUGHNESS_SHIFT)
    return packed | np.rint(metallic * int(METALLIC_MASK)).astype(np.uint32) << int(METALLIC_SHIFT)


def face_normals(mesh: TriangleMesh) -> np.ndarray:
    """Unit normals of triangles by their winding (F, 3) float32; zero for degenerate ones."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals / np.where(length > 0.0, length, np.inf)).astype(np.float32)


def uv_density(mesh: TriangleMesh) -> np.ndarray:
    """Texture density of each triangle (F) float32 [texture widths per metre]: sqrt(uv area / area); 0 for degenerate triangles."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    flat = mesh.uv[mesh.faces].astype(np.float64)
    edge, other = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    uv_area = np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0])
    return np.sqrt(uv_area / np.where(area > 0.0, area, np.inf)).astype(np.float32)


def build_meshes(
    shapes: list[TriangleMesh], entries: int, device: wp.Device, interior: Interior | None = None
) -> tuple[Any, tuple[wp.Mesh, ...]]:
    """The struct `Meshes`, and a `wp.Mesh` per shape, which must outlive it; `entries` is the row of the first bin, `interior` its empty
    interior (None: none)."""
    keep = tuple(
        wp.Mesh(
            points=wp.array(shape.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(shape.faces.reshape(-1), dtype=wp.int32, device=device),
            bvh_constructor="sah",
            bvh_leaf_size=1,
        )
        for shape in shapes
    )
    lower = np.array([shape.vertices.min(axis=0) for shape in shapes])
    upper = np.array([shape.vertices.max(axis=0) for shape in shapes])
    center = ((lower + upper) / 2.0).astype(np.float32)
    radius = [np.linalg.norm(shape.vertices.astype(np.float64) - c, axis=1).max() for shape, c in zip(shapes, center, strict=True)]
    meshes = Meshes()
    meshes.id = wp.array([mesh.id for mesh in keep], dtype=wp.uint64, device=device)
    meshes.bvh = build_wide_bvh(shapes, device)
    meshes.lower = wp.array(lower, dtype=wp.vec3, device=device)
    meshes.upper = wp.array(upper, dtype=wp.vec3, device=device)
    meshes.center = wp.array(center, dtype=wp.vec3, device=device)
    # Enlarged by 1e-6, so that rounding never lets a bounding sphere exclude its own mesh.
    meshes.radius = wp.array(np.array(radius) * (1.0 + 1e-6), dtype=wp.float32, device=device)
    meshes.first_triangle = wp.array(np.cumsum([0] + [len(shape.faces) for shape in shapes]), dtype=wp.int32, device=device)
    meshes.corner = wp.array(np.concatenate([shape.vertices[shape.faces].reshape(-1, 3) for shape in shapes]), dtype=wp.vec3, device=device)
    meshes.face_normal = wp.array(np.concatenate([face_normals(shape) for shape in shapes]), dtype=wp.vec3, device=device)
    meshes.entries = entries
    meshes.interior.half = wp.vec3(-1.0, -1.0, -1.0)
    if interior is not None:
        meshes.interior.half, meshes.interior.growth = wp.vec3(*interior.half), wp.vec3(*interior.growth)
        meshes.interior.floor, meshes.interior.top = interior.floor, interior.top
    return meshes, keep


def build_surfaces(shapes: list[TriangleMesh], materials: list[Material], device: wp.Device) -> Any:
    """The struct `Surfaces`: normals, uv, materials, mip-mapped textures; after those of the shapes, `materials` may have others."""
    chains = map_in_threads(packed_levels, materials)
    depth = max(1, *(len(chain) for chain in chains))
    first_texel = np.zeros((len(chains), depth), dtype=np.int32)
    texels: list[np.ndarray] = []
    details: list[np.ndarray] = []
    total = 0
    mapped = map_in_threads(lambda material: None if material.maps is None else detail_levels(material.maps), materials)
    for row, (packed, levels) in enumerate(zip(chains, mapped, strict=True)):
        texels += packed
        details += packed if levels is None else levels
        for level, image in enumerate(packed):
            first_texel[row, level] = total
            total += len(image)
    if all(levels is None for levels in mapped):
        details = [np.zeros(1, np.uint32)]
    sizes = [(0, 0) if each.texture is None else each.texture.shape[1::-1] for each in materials]
    surfaces = Surfaces()
    surfaces.triangle = wp.array(np.concatenate(map_in_threads(pack_triangles, shapes)), dtype=wp.vec4, device=device)
    surfaces.color = wp.array(srgb_to_linear(np.array([m.color for m in materials])), dtype=wp.vec3, device=device)
    surfaces.metallic = wp.array([m.metallic for m in materials], dtype=wp.float32, device=device)
    surfaces.roughness = wp.array([m.roughness for m in materials], dtype=wp.float32, device=device)
    surfaces.texture_size = wp.array(sizes, dtype=wp.vec2i, device=device)
    surfaces.first_texel = wp.array(first_texel, dtype=wp.int32, device=device)
    surfaces.texture_levels = wp.array([len(chain) for chain in chains], dtype=wp.int32, device=device)
    surfaces.texel = wp.array(np.concatenate(texels) if texels else np.zeros(1, np.uint32), dtype=wp.uint32, device=device)
    maps = [(0 if m.maps is None else ALL_MAPS) | (0 if m.glow is None else int(GLOW_MAP)) for m in materials]
    surfaces.maps = wp.array(maps, dtype=wp.int32, device=device)
    surfaces.detail = wp.array(np.concatenate(details), dtype=wp.uint32, device=device)
    surfaces.albedo = measure_albedo(device)
    return surfaces


def pack_triangles(mesh: TriangleMesh) -> np.ndarray:
    """Pack the shading data of a mesh's triangles into records (TRIANGLE_RECORDS F, 4) float32, as in `Surfaces.triangle`."""
    uv = mesh.uv[mesh.faces]
    records = np.empty((len(mesh.faces), int(TRIANGLE_RECORDS), 4), np.float32)
    records[:, :3, :3], records[:, :3, 3] = mesh.normals[mesh.faces], uv[..., 0]
    records[:, 3, :3], records[:, 3, 3] = uv[..., 1], uv_density(mesh)
    records[:, 4, :3], records[:, 4, 3] = face_normals(mesh), normal_gradient(mesh)
    return records.reshape(-1, 4)


def normal_gradient(mesh: TriangleMesh) -> np.ndarray:
    """Frobenius norm of the interpolated normal's gradient along each triangle (F) float32 [rad/m]."""
    edges, turns = (np.diff(values[mesh.faces].astype(np.float64), axis=1) for values in (mesh.vertices, mesh.normals))
    # A gradient G takes edges E, as columns, to the turns G E of the normal along them: |G|² is the trace of (EᵀE)⁻¹ (GE)ᵀ(GE).
    gram, turned = (matmul(rows, rows.transpose(0, 2, 1)) for rows in (edges, turns))
    adjugate = gram[:, ::-1, ::-1] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    squared, area = np.einsum("fij,fij->f", adjugate, turned), np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return (np.sqrt(np.maximum(squared, 0.0)) / np.where(area > 0.0, area, np.inf)).astype(np.float32)


def build_glass(materials: list[Material], objects: int, looks: Looks | None, device: wp.Device) -> wp.array | None:
    """Transmission of the materials (material) as of `RenderScene.glass`, of the first `objects`; others are opaque."""
    glass = [(each.glass.transmission, each.glass.ior, each.glass.thickness) for each in materials[:objects]]
    if not any(row[0] for row in glass) and (looks is None or looks.randomize.object_transmission.kind == OFF):
        return None
    return wp.array(glass + [(0.0, OPAQUE.ior, 0.0)] * (len(materials) - objects), dtype=wp.vec3, device=device)


def build_emission(materials: list[Material], surfaces: Any, exposure: float) -> tuple[wp.array, wp.array] | None:
    """Emission of the materials of the struct `Surfaces` as of `RenderScene.emission`, times the factor `exposure` on the automatic one."""
    if not any(max(each.emission) for each in materials):
        return None
    device, glowing = surfaces.texel.device, [row for row, each in enumerate(materials) if each.glow is not None]
    glow, first = np.zeros(surfaces.texel.size if glowing else 1, np.uint32), surfaces.first_texel.numpy()
    for row in glowing:
        for start, level in zip(first[row], mip_levels(np.asarray(materials[row].glow)), strict=False):
            glow[start : start + level.size // 3] = pack_texels(level)
    emission = exposure * np.array([each.emission for each in materials])
    return wp.array(emission, dtype=wp.vec3, device=device), wp.array(glow, dtype=wp.uint32, device=device)


def build_finish(materials: list[Material], device: wp.Device) -> wp.array | None:
    """Clear coat and anisotropy of the materials (material) as of `RenderScene.finish`."""
    if all(each.finish == PLAIN for each in materials):
        return None
    return wp.array([astuple(each.finish) for each in materials], dtype=wp.vec4, device=device)


def with_cameras(scene: RenderScene, cameras: tuple[Camera, ...]) -> RenderScene:
    """The same scene with other cameras, of one image size."""
    grid = build_grid(*cameras[0].resolution)
    return replace(scene, cameras=build_cameras(cameras, scene.device), grid=grid, camera_count=len(cameras))


def build_grid(width: int, height: int) -> Any:
    """The struct `ImageGrid` of images of `width` x `height` px."""
    grid = ImageGrid()
    grid.width, grid.height = width, height
    grid.tile_columns = -(-width // int(TILE_WIDTH))
    grid.tiles = grid.tile_columns * -(-height // int(TILE_HEIGHT))
    assert int(TILE_WIDTH) * int(TILE_HEIGHT) == int(TILE_PIXELS)
    return grid


def pack_half3_array(colors: np.ndarray) -> np.ndarray:
    """Pack colours (..., 3) into (...) uint64: the kernels' `pack_half3`."""
    halves = np.zeros((*colors.shape[:-1], 4), np.float16)
    halves[..., :3] = np.minimum(colors, float(MAX_HALF))
    return halves.view(np.uint64)[..., 0]


GRIPPER = 2
"""Fixtures of the gripper: shaft and cup."""
MAX_RAYS_PER_LAMP = 4
"""Maximum number of shadow rays per lamp and pixel of the shadow grid: 8 would gain 0.05 dB in PSNR."""


def lamp_table(tables: list[EnvironmentTables], name: str, *shape: int) -> np.ndarray:
    """Member `name`, of `shape`, of the lamps of all maps (map, MAX_LAMPS, ...) float32; zero beyond a map's lamps."""
    result = np.zeros((len(tables), int(MAX_LAMPS), *shape), np.float32)
    for index, table in enumerate(tables):
        for rank, lamp in enumerate(table.lamps):
            result[index, rank] = getattr(lamp, name)
    return result


def rays_per_lamp(lamps: int) -> int:
    """Shadow rays to each of a map's lamps: the fewer lamps, the more light each has, and the more its penumbra shows noise."""
    return max(rays for rays in (1, 2, MAX_RAYS_PER_LAMP) if rays * max(lamps, 1) <= int(MAX_LAMPS) or rays == 1)


def build_lights(
    maps: tuple[EnvironmentMap, ...], ground: np.ndarray | None, exposure: float, device: wp.Device, lamps: int = int(MAX_LAMPS)
) -> Any:
    """The struct `Lights`; `exposure` multiplies the automatic one, `ground` is the table's linear albedo, `lamps` the most of a map."""
    tables = map_in_threads(lambda light: precompute_environment(light, ground, lamps), maps)
    lights = Lights()
    lights.maps = len(tables)
    radiance = np.stack([t.radiance for t in tables] + [t.lampless for t in tables])
    lights.radiance = wp.array(np.pad(radiance, [(0, 0)] * 3 + [(0, 1)]), dtype=wp.vec4, device=device)
    lights.prefiltered = wp.array(np.stack([pack_half3_array(exposure * t.exposure * t.prefiltered) for t in tables]), device=device)
    lights.irradiance = wp.array(np.stack([t.irradiance for t in tables]), dtype=wp.vec3, device=device)
    lights.lamps = wp.array([len(t.lamps) for t in tables], dtype=wp.int32, device=device)
    direction, irradiance = (lamp_table(tables, name, 3) for name in ("direction", "irradiance"))
    centers = np.concatenate([direction, lamp_table(tables, "radius_tangent", 1)], axis=-1)
    fluxes = np.concatenate([irradiance, lamp_shares(tables)], axis=-1)
    lights.lamp = wp.array(np.stack([centers, fluxes], axis=2), dtype=wp.vec4, device=device)
    lights.lamp_point = wp.array(lamp_table(tables, "points", int(LAMP_POINTS), 3), dtype=wp.vec3, device=device)
    lights.lamp_rays = wp.array([rays_per_lamp(len(t.lamps)) for t in tables], dtype=wp.int32, device=device)
    lights.total_lamp_irradiance = wp.array(irradiance.sum(axis=1), dtype=wp.vec3, device=device)
    lights.exposure = wp.array([exposure * t.exposure for t in tables], dtype=wp.float32, device=device)
    return lights


def lamp_shares(tables: list[EnvironmentTables]) -> np.ndarray:
    """Share of each lamp in the irradiance of an open surface that faces up (map, lamp, 1), 0 where a map has fewer lamps."""
    upward = dot(np.einsum("k,mkc->mc", sh_basis(np.array([0.0, 0.0, 1.0])), np.stack([table.irradiance for table in tables])), LUMINANCE)
    lamps = dot(lamp_table(tables, "irradiance", 3), LUMINANCE) * lamp_table(tables, "direction", 3)[..., 2]
    return (lamps / np.maximum(upward + lamps.sum(axis=1), 1e-9)[:, None])[..., None]


def build_suction_scene(catalog: Catalog, radius: float, device: wp.Device) -> Any:
    """The struct `SuctionScene` of a cup of `radius` [m]."""
    suction = SuctionScene()
    suction.radius = radius
    suction.center_of_mass = wp.array([entry.center_of_mass for entry in catalog.bodies], dtype=wp.vec3, device=device)
    return suction


def build_props(catalog: Catalog, device: wp.Device) -> Any:
    """The struct `Props` of the props of a catalog, whose meshes are behind those of its bodies."""
    result = Props()
    result.first = len(catalog.bodies)
    result.pose = wp.array(np.array([prop.pose for prop in catalog.props]).reshape(-1, 7), dtype=wp.transform, device=device)
    result.follows = wp.array([int(prop.follows) for prop in catalog.props], dtype=wp.int32, device=device)
    return result


def build_table(settings: schema.Render, height: float) -> Any:
    """The struct `Table` of a table at this z [m]."""
    table = Table()
    table.visible, table.height = int(settings.table), height
    table.half = wp.vec2(*(0.5 * size if size > 0.0 else FAR for size in settings.table_size))
    return table


def build_render_scene(
    settings: schema.Render,
    table_height: float,
    catalog: Catalog,
    fixtures: tuple[Fixture, ...],
    cameras: tuple[Camera, ...],
    lights: tuple[EnvironmentMap, ...],
    device: wp.Device,
    looks: Looks | None = None,
    cup_radius: float = schema.Suction().radius,
) -> RenderScene:
    """Put all constant data of the renderer on the device. `table_height`: z of the table, on which the first bin stands [m]. `catalog`:
    the objects; `Snapshot.catalog_index` is the index into it. Its props are the meshes behind them. `fixtures`: bins, then gripper shaft
    and cup, each in its own frame. `cameras`: cameras of one image size; `Views.camera` is the index into it. `lights`: environment maps;
    `Snapshot.light` is the index into it. `looks`: what episodes draw their looks from; None: nothing. `cup_radius`: radius of the suction
    cup of the layers `suction_seal` and `suction_wrench` [m]."""
    # The first bin comes last, see `fixture_mesh`.
    bins, grip = fixtures[:-GRIPPER], fixtures[-GRIPPER:]
    fixtures = (*(prop.fixture for prop in catalog.props), *reversed(bins), *grip)
    shapes = [entry.mesh for entry in catalog.bodies] + [fixture.mesh for fixture in fixtures]
    if looks and looks.bin_textures:
        first = len(catalog.bodies) + len(catalog.props)
        shapes[first : first + len(bins)] = map(project_from_box, shapes[first : first + len(bins)])
    materials = [each.material for each in (*catalog.bodies, *fixtures)] + [Material(settings.table_color, None, 0.0, TABLE_ROUGHNESS)]
    materials += [Material((1.0, 1.0, 1.0), texture, 0.0, 1.0) for texture in (looks.all_textures if looks else ())]
    meshes, keep = build_meshes(shapes, len(shapes) - len(grip) - 1, device, bins[0].interior if len(bins) == 1 else None)
    ground = srgb_to_linear(np.array(settings.table_color)) if settings.table else None
    paths = PathScene()
    paths.meshes, paths.table = meshes, build_table(settings, table_height)
    paths.surfaces = build_surfaces(shapes, materials, device)
    # Mode unoccluded, which is for speed, takes the strongest lamp alone.
    lamps = min(settings.lamps, 1) if settings.mode == schema.UNOCCLUDED else settings.lamps
    paths.lights = build_lights(lights, ground, settings.exposure, device, lamps)
    paths.cdf = build_environment_cdf(paths.lights.radiance.numpy()[..., :3], device, settings.table)
    return RenderScene(
        meshes=meshes,
        surfaces=paths.surfaces,
        cameras=build_cameras(cameras, device),
        lights=paths.lights,
        table=paths.table,
        paths=paths,
        plain=paths,
        grid=build_grid(*cameras[0].resolution),
        obj_id=wp.array(catalog.object_ids, dtype=wp.int32, device=device),
        camera_count=len(cameras),
        device=device,
        keep=keep,
        looks=looks,
        suction_maps=build_suction_scene(catalog, cup_radius, device),
        glass=build_glass(materials, len(catalog.bodies), looks, device),
        emission=build_emission(materials, paths.surfaces, settings.exposure),
        finish=build_finish(materials, device),
        props=build_props(catalog, device),
        prop_count=len(catalog.props),
    )
