"""Domain randomization: of materials, tables of distributions on the device, materials of each batch of views, and records for the host;
of light, variants of environment maps with lamps drawn into them, as distant discs of black-body colour."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Look, LookKind, LookPart
from synpick_warp.configs.episodes.randomize import CHOICE, FIXED, LOG_UNIFORM, NORMAL, OFF, UNIFORM, Distribution, Randomize
from synpick_warp.configs.fields import settings_of
from synpick_warp.kernels.distributions import LookDistribution, LookTable
from synpick_warp.kernels.render.lighting.background import shade_floor_kernel
from synpick_warp.kernels.render.lighting.looks import draw_looks_kernel, dress_bodies_kernel
from synpick_warp.kernels.render.lighting.paths.tracing import FinishedScene, RandomizedScene
from synpick_warp.kernels.render.lighting.surfaces import FinishedSurfaces, RandomizedSurfaces, Surfaces
from synpick_warp.kernels.render.lighting.wear import NOISE_SIZE, make_noise_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import FIXTURES
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.scenes.bins import FLOOR_DROP
from synpick_warp.scenes.environment import LUMINANCE, draw_sun_disc, map_directions
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.arrays import ArraySpec, StructArrays, allocate_struct
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.system.linear_algebra import DECIMALS, dot

SETTINGS = {
    (LookPart.OBJECT, Look.HUE): "object_hue",
    (LookPart.OBJECT, Look.BRIGHTNESS): "object_brightness",
    (LookPart.OBJECT, Look.ROUGHNESS): "object_roughness",
    (LookPart.OBJECT, Look.METALLIC): "object_metallic",
    (LookPart.OBJECT, Look.TRANSMISSION): "object_transmission",
    (LookPart.OBJECT, Look.SCRATCHES): "object_scratches",
    (LookPart.OBJECT, Look.RUST): "object_rust",
    (LookPart.OBJECT, Look.STAINS): "object_stains",
    (LookPart.OBJECT, Look.DUST): "object_dust",
    (LookPart.OBJECT, Look.LABEL): "object_label",
    (LookPart.BIN, Look.COLOR): "bin_color",
    (LookPart.BIN, Look.SCRATCHES): "bin_scratches",
    (LookPart.BIN, Look.STAINS): "bin_stains",
    (LookPart.BIN, Look.DUST): "bin_dust",
    (LookPart.BIN, Look.LABEL): "bin_label",
    (LookPart.BIN, Look.ROUGHNESS): "bin_roughness",
    (LookPart.BIN, Look.METALLIC): "bin_metallic",
    (LookPart.TABLE, Look.COLOR): "table_color",
    (LookPart.TABLE, Look.ROUGHNESS): "table_roughness",
    (LookPart.EPISODE, Look.EXPOSURE): "exposure",
    (LookPart.EPISODE, Look.COUNT): "distractors",
    (LookPart.LAMP, Look.COUNT): "lamps",
    (LookPart.LAMP, Look.ELEVATION): "lamp_elevation",
    (LookPart.LAMP, Look.RADIUS): "lamp_radius",
    (LookPart.LAMP, Look.STRENGTH): "lamp_strength",
    (LookPart.LAMP, Look.TEMPERATURE): "lamp_temperature",
}
"""Setting of `Randomize` that has a part's distribution of a parameter."""
_COPIED = ("color", "metallic", "roughness", "texture_size", "first_texel", "texture_levels", "maps")
"""Arrays of `Surfaces` with a row for each material, of every scene ..."""
_DRAWN = ("recolor", "repeats", "wear", "pattern", "glass", "label", "emission", "finish")
_TYPES = {name: RandomizedSurfaces.vars[name].type for name in (*_COPIED, *_DRAWN)}
_MATERIALS = StructArrays(
    RandomizedSurfaces, {name: ArraySpec(("material", "level")[: kind.ndim], kind.dtype, "") for name, kind in _TYPES.items()}
)
"""... and all that the materials of views have."""

WEAR = [name for (_, look), name in SETTINGS.items() if Look.SCRATCHES <= look <= Look.DUST]
"""Settings of wear."""
NOISE_SEED = 0x77656172
"""Seed of the noise of wear, "wear" in ASCII: each body shows another part of it."""
_ROW: Any = LookDistribution.numpy_dtype()


def build_look_table(looks: Looks, first_texture: int, device: Any) -> Any:
    """The struct `LookTable`. `looks`: distributions and textures. `first_texture`: row of `Surfaces` of the first texture, of those in the
    order of `Looks.all_textures`. `device`: device of the arrays."""
    drawn: dict[tuple[int, int], tuple[Distribution, float, float]] = {}
    for place, name in SETTINGS.items():
        bounds = settings_of(Randomize)[name].bounds
        drawn[place] = getattr(looks.randomize, name), bounds.low, bounds.high
    drawn[LookPart.LAMP, Look.AZIMUTH] = Distribution(UNIFORM, ((-180.0,), (180.0,))), 0.0, 0.0
    for part, textures in looks.textures.items():
        if textures:
            rows = tuple((float(first_texture + index),) for index in range(len(textures)))
            drawn[part, Look.TEXTURE] = Distribution(CHOICE, rows), 0.0, 0.0
            drawn[part, Look.TEXTURE_WIDTH] = looks.randomize.texture_width, 0.01, 100.0
        first_texture += len(textures)
    distributions = np.zeros((len(LookPart), len(Look)), dtype=_ROW)
    choices: list[np.ndarray] = []
    for place, (distribution, low, high) in drawn.items():
        distributions[int(place[0]), int(place[1])] = _pack(distribution, low, high, len(choices))
        if distribution.kind == CHOICE:
            weights = np.array(distribution.weights or [1.0] * len(distribution.values))
            choices += list(np.column_stack([_vectors(distribution), np.cumsum(weights) / weights.sum()]))
    table = LookTable()
    table.distribution = wp.array(distributions, dtype=LookDistribution, device=device)
    table.choice = wp.array(np.array(choices or [np.zeros(4)], np.float32), dtype=wp.vec4, device=device)
    return table


def _vectors(distribution: Distribution) -> np.ndarray:
    """Parameters of a distribution as vectors (..., 3): scalars in the first component."""
    values = np.array(distribution.values, np.float64)
    return values if values.shape[1] == 3 else np.pad(values, [(0, 0), (0, 2)], constant_values=1.0)


def _pack(distribution: Distribution, low: float, high: float, first: int) -> Any:
    """A row of `LookDistribution`; `first` is the index of its first choice."""
    row: Any = np.zeros((), dtype=_ROW)
    row["kind"], row["low"], row["high"] = LookKind[distribution.kind.upper()], low, high
    row["first"], row["count"] = first, len(distribution.values)
    if distribution.kind in (FIXED, UNIFORM, LOG_UNIFORM, NORMAL):
        values = _vectors(distribution)
        values = np.log(values) if distribution.kind == LOG_UNIFORM else values
        row["a"], row["b"] = values[0], values[-1]
    return row


def materials_of_view(instances: int, background: bool = True) -> int:
    """Number of materials of a view of `instances` instances: theirs, of fixtures, table and background."""
    return instances + int(FIXTURES) + 1 + background


def allocate_materials(rows: int, levels: int, device: wp.Device) -> Any:
    """Allocate the members of the struct `RandomizedSurfaces` that materials have, for a number of these and of mip levels."""
    return allocate_struct(_MATERIALS, {"material": rows, "level": levels}, device)


def make_noise(device: wp.Device) -> wp.array:
    """Noise table of `kernels.render.lighting.wear`."""
    noise = wp.empty((int(NOISE_SIZE),) * 3, dtype=wp.uint32, device=device)
    wp.launch(make_noise_kernel, dim=noise.shape, inputs=[wp.uint32(NOISE_SEED)], outputs=[noise], device=device)
    return noise


def recast(source: Any, kind: Any, **given: Any) -> Any:
    """Struct of another kind with the members of a struct, but for those given."""
    result = kind()
    for name in kind.vars:
        setattr(result, name, given[name] if name in given else getattr(source, name))
    return result


class Dresser:
    """Sampler of the materials of each batch of views. Owns a scene with space for them.

    Attributes:
        scene: The scene whose surfaces have a row for each body of each view.
    """

    def __init__(self, scene: RenderScene, seed: int, instances: int, views: int) -> None:
        """Allocate the materials of at most `views` views of worlds with `instances` instances."""
        looks = scene.looks or Looks(Randomize(), (), ())
        self._seed = wp.uint64(seed)
        self._first = scene.surfaces.color.shape[0]
        self._table = build_look_table(looks, self._first - len(looks.all_textures), scene.device)
        self._materials = materials_of_view(instances, bool(looks.background_textures))
        levels = scene.surfaces.first_texel.shape[1]
        surfaces = allocate_materials(self._first + views * self._materials, levels, scene.device)
        for name in Surfaces.vars:
            values = getattr(scene.surfaces, name)
            if name in _COPIED:
                wp.copy(getattr(surfaces, name), values, count=values.size)
            else:
                setattr(surfaces, name, values)
        if scene.glass is not None:
            wp.copy(surfaces.glass, scene.glass, count=scene.glass.size)
        surfaces.glow = wp.zeros(1, dtype=wp.uint32, device=scene.device)
        if scene.emission is not None:
            wp.copy(surfaces.emission, scene.emission[0], count=scene.emission[0].size)
            surfaces.glow = scene.emission[1]
        if scene.finish is not None:
            wp.copy(surfaces.finish, scene.finish, count=scene.finish.size)
        surfaces.row = wp.zeros((views, self._materials), dtype=wp.int32, device=scene.device)
        is_worn = any(getattr(looks.randomize, name).kind != OFF for name in WEAR)
        surfaces.noise = make_noise(scene.device) if is_worn else wp.zeros((1, 1, 1), dtype=wp.uint32, device=scene.device)
        if scene.prop_count:
            # Props keep the materials of their meshes: identity for what the drawn materials of views change.
            surfaces.recolor.fill_(np.eye(3))
            surfaces.repeats.fill_(1.0)
            rows = np.tile(scene.props.first + np.arange(scene.prop_count), (views, 1))
            self._props = slice(instances - scene.prop_count, instances), wp.array(rows, dtype=wp.int32, device=scene.device)
        shown = surfaces if scene.finish is None else recast(surfaces, FinishedSurfaces)
        paths = recast(scene.paths, RandomizedScene if scene.finish is None else FinishedScene, surfaces=shown)
        self.scene = replace(scene, surfaces=surfaces, paths=paths)

    def dress(self, snapshot: Snapshot, views: Any, bodies: Any) -> None:
        """Make the materials of the bodies of all views, of their tables and backgrounds; `bodies` must be set up."""
        scene = self.scene
        inputs = [self._seed, scene.meshes, self._table, snapshot.frames, views, bodies, self._first]
        wp.launch(
            kernel_for(dress_bodies_kernel, views),
            dim=(views.count, self._materials),
            inputs=inputs,
            outputs=[scene.surfaces],
            device=scene.device,
        )
        if scene.prop_count:
            bodies_of_props, rows = self._props
            wp.copy(scene.surfaces.row[:, bodies_of_props], rows)


def shade_floor(scene: RenderScene, shot: Any, image: Any) -> None:
    """Shade what the views show beyond the scene as a floor, if episodes draw a background."""
    if scene.looks is not None and scene.looks.background_textures:
        pixels = shot.views.count * scene.grid.tiles * int(TILE_PIXELS)
        launch_pixels(shade_floor_kernel, pixels, [scene.paths, FLOOR_DROP, shot], [image], scene.device)


def draw_parameters(looks: Looks, seed: int, episode: int, parts: list[tuple[LookPart, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Sample all parameters of bodies (part, index within it) on the CPU, by the function that the renderer calls. Returns `LookKind` of
    each parameter (part, look), and the values (body, look, 3) float32."""
    table = build_look_table(looks, 0, "cpu")
    part, body = (wp.array(column, dtype=wp.int32, device="cpu") for column in zip(*parts, strict=True))
    values = wp.zeros((len(parts), len(Look)), dtype=wp.vec3, device="cpu")
    inputs = [wp.uint64(seed), table, wp.full(len(parts), episode, dtype=wp.int32, device="cpu"), part, body]
    wp.launch(draw_looks_kernel, dim=values.shape, inputs=inputs, outputs=[values], device="cpu")
    return table.distribution.numpy()["kind"], values.numpy()


def draw_looks(looks: Looks, seed: int, episode: int, objects: int, distractors: Mapping[int, str] | None = None) -> dict[str, Any]:
    """Record of the looks of an episode: by part and parameter, of each object and distractor. Textures by index, colours in sRGB.

    Computed on the CPU by the function that the renderer calls; a GPU's values differ by the rounding of logarithms and cosines. `looks`:
    what is drawn from. `seed`: seed of the bake. `episode`: index of the episode. `objects`: number of the first instances, whose looks are
    wanted. `distractors`: names of the distractors by instance; None: none can be drawn."""
    distractors = distractors or {}
    instances = [(LookPart.OBJECT, index) for index in (*range(objects), *distractors)]
    scene = (LookPart.EPISODE, LookPart.BACKGROUND, LookPart.BIN, LookPart.TABLE)
    parts = [*((part, 0) for part in scene), *instances]
    kinds, drawn = draw_parameters(looks, seed, episode, parts)
    rows = [_record(kinds[part], drawn[index], looks, part) for index, (part, _) in enumerate(parts)]
    record = {name: value for name, value in rows[0].items() if name != "count"}
    if looks.background_textures:
        record["background"] = rows[1]
    record |= {"bin": rows[2], "table": rows[3], "objects": rows[4 : 4 + objects]}
    if looks.randomize.most_distractors:
        named = zip(distractors.items(), rows[4 + objects :], strict=True)
        record["distractors"] = [{"instance": instance, "name": name, **row} for (instance, name), row in named]
    return record


def _record(kinds: np.ndarray, values: np.ndarray, looks: Looks, part: LookPart) -> dict[str, Any]:
    """Parameters of a body that are drawn, by name."""
    record: dict[str, Any] = {}
    for look in Look:
        if kinds[look] != LookKind.OFF:
            value = values[look].astype(np.float64).round(6)
            record[look.name.lower()] = value.tolist() if look == Look.COLOR else float(value[0])
    if "texture" in record:
        before = itertools.takewhile(lambda other: other != part, looks.textures)
        record["texture"] = int(record["texture"]) - sum(len(looks.textures[other]) for other in before)
    return record


SUN_CLEARANCE = 25.0
"""Lamps keep this angle from a set's sun [°], which takes in what is bright about it; nearer ones go to the opposite azimuth."""
MAX_LAMPS = 4
# Planckian locus in CIE xy (Kim et al., 2002): piecewise polynomials for x as a function of 1000 K / T, and for y as a function of x. Each
# piece: upper end of its range, coefficients from the highest power down.
_LOCUS_X = ((4000.0, (-0.2661239, -0.2343589, 0.8776956, 0.179910)), (25000.0, (-3.0258469, 2.1070379, 0.2226347, 0.240390)))
_LOCUS_Y = (
    (2222.0, (-1.1063814, -1.34811020, 2.18555832, -0.20219683)),
    (4000.0, (-0.9549476, -1.37418593, 2.09137015, -0.16748867)),
    (25000.0, (3.0817580, -5.87338670, 3.75112997, -0.37001483)),
)
_RGB_OF_XYZ = np.array([[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]])
"""Linear sRGB of CIE XYZ (IEC 61966-2-1)."""


def load_scene_lights(
    folder: str, randomize: Randomize, seed: int, report: Callable[[str], None], strict: bool = False
) -> tuple[EnvironmentMap, ...]:
    """Load the environment maps of a folder (`load_lights`); if lamps are randomized, `lamp_variants` variants of each with its lamps."""
    lights = load_lights(folder, report, strict)
    if randomize.lamps.kind == OFF:
        return lights
    looks = Looks(randomize, (), ())
    variants = randomize.lamp_variants
    return tuple(
        add_lamps(light, f"{light.name}+{variant}", looks, seed, index * variants + variant)
        for index, light in enumerate(lights)
        for variant in range(variants)
    )


def add_lamps(light: EnvironmentMap, name: str, looks: Looks, seed: int, variant: int) -> EnvironmentMap:
    """Draw lamps into an environment map, which gets a new name; `variant` is the index of the random draw."""
    _, drawn = draw_parameters(looks, seed, variant, [(LookPart.LAMP, index) for index in range(MAX_LAMPS)])
    directions, solid_angles = map_directions(light.radiance.shape[0])
    upward = np.maximum(directions[..., 2], 0.0) * solid_angles
    ambient = float(dot((light.radiance * upward[..., None]).sum(axis=(0, 1)), LUMINANCE))
    radiance = light.radiance.astype(np.float64)
    for values in drawn[: int(np.rint(drawn[0, Look.COUNT, 0])), :, 0].astype(np.float64):
        direction = lamp_direction(values[Look.AZIMUTH], values[Look.ELEVATION])
        if light.sun is not None and dot(direction, light.sun.direction) > np.cos(np.radians(SUN_CLEARANCE)).round(DECIMALS):
            direction = direction * (-1.0, -1.0, 1.0)
        irradiance = ambient * values[Look.STRENGTH] / direction[2] * black_body_color(values[Look.TEMPERATURE])
        tangent = round(float(np.tan(np.radians(values[Look.RADIUS]))), DECIMALS)
        radiance += draw_sun_disc(np.zeros(radiance.shape[:2], bool), direction, irradiance, tangent)
    return replace(light, name=name, radiance=radiance.astype(np.float32))


def lamp_direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit direction (3) of an azimuth and an elevation [°]."""
    turn, height = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]).round(DECIMALS)


def black_body_color(temperature: float) -> np.ndarray:
    """Linear sRGB (3) of a black body of a temperature [K], 1,700 to 25,000, of luminance 1; components are at least 0. Cubic approximation
    of the Planckian locus (Kim et al., 2002)."""
    inverse = 1000.0 / temperature
    x = np.polyval(next(row for end, row in _LOCUS_X if temperature <= end), inverse)
    y = np.polyval(next(row for end, row in _LOCUS_Y if temperature <= end), x)
    color = np.maximum(dot(_RGB_OF_XYZ, np.array((x / y, 1.0, (1.0 - x - y) / y))), 0.0)
    return color / dot(color, LUMINANCE)
