"""Colour conversion and textures: sRGB transfer function, image decoding, vertex colour baking, texture atlases."""

import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image, UnidentifiedImageError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import describe_error, quiet_decoding
from synpick_warp.scenes.types import BLACK, MAP_CENTER, OPAQUE, PLAIN, Finish, Glass, Material
from synpick_warp.system.linear_algebra import DECIMALS

MAX_TEXTURE_FILE = 2**27
"""Largest image file [bytes]: 128 MiB."""
MAX_TEXTURE_PIXELS = 2**26
"""Maximum number of pixels of a texture, and of all textures of one model: 8192², which take 0.7 GB while they are decoded."""
MAX_TEXTURE_SIDE = 2**14
"""Largest side of a texture of tiles [px]."""
UV_TOLERANCE = 1e-3
"""Texture coordinates may leave 0..1 by this, by rounding."""
MIN_MAP_SIDE = 4
"""Least width and height of a texture with maps [px], so that filtering does not bleed across an atlas."""
TEXTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "JPEG2000", "DDS")
"""Formats that Pillow may decode: rasters only; for others, such as EPS, it starts other programs."""

# Linear segment of the sRGB transfer function (IEC 61966-2-1).
_SRGB_TOE = 0.04045
_LINEAR_TOE = 0.0031308
EXR_MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of an OpenEXR file."""
_EXR_COLORS = (("R", "G", "B"), ("Y",))


@dataclass(frozen=True, eq=False)
class FileMaterial:
    """Material as a mesh file states it: base colour (sRGB, 0 to 1), texture, metallic, roughness; None: not stated."""

    color: tuple[float, float, float]
    """Base colour factor, sRGB in 0..1; multiplies the texture in linear light."""
    texture: np.ndarray | None
    """Base colour texture (H, W, 3) uint8, sRGB, top row first (v = 1); with maps (H, W, 7), see `Material.maps`, and with `Material.glow`
    behind these (H, W, 10). A last channel more is `Material.opacity`."""
    metallic: float | None
    roughness: float | None
    glass: Glass = OPAQUE
    emission: tuple[float, float, float] = BLACK
    has_glow: bool = False
    """Whether the file has an emission texture, which `texture` has, too, unless its maps were dropped."""
    finish: Finish = PLAIN

    @property
    def glow(self) -> np.ndarray | None:
        """Emission texture (H, W, 3) uint8, sRGB: channels 7 to 9 of `texture`; None: it has none."""
        return self.texture[..., 7:10] if self.texture is not None and self.texture.shape[2] >= 10 else None

    @property
    def light(self) -> tuple[float, float, float]:
        """Emission factor; zero if the file's emission texture was dropped."""
        return BLACK if self.has_glow and self.glow is None else self.emission

    @property
    def has_maps(self) -> bool:
        """Whether the texture has maps behind its colours."""
        return self.texture is not None and self.texture.shape[2] > 4

    @property
    def is_white_with_maps(self) -> bool:
        """Whether the material has maps (normal, roughness, ...) but no colour texture: its colours are all white."""
        return self.texture is not None and self.has_maps and bool((self.texture[..., :3] == 255).all())

    def complete(self, metallic: float, roughness: float) -> Material:
        """Material with these values where the file states none."""
        given = (metallic if self.metallic is None else self.metallic, roughness if self.roughness is None else self.roughness)
        if self.texture is None or self.texture.shape[2] == 3:
            return Material(self.color, self.texture, *given, glass=self.glass, emission=self.light, finish=self.finish)
        maps = self.texture[..., 3:7].copy() if self.has_maps else None
        opacity = self.texture[..., -1].copy() if self.texture.shape[2] in (4, 8, 11) else None
        glow = None if self.glow is None else self.glow.copy()
        return Material(self.color, self.texture[..., :3].copy(), *given, maps, self.glass, opacity, self.light, glow, self.finish)

    def add_glow(self, most: float) -> "FileMaterial":
        """Same emission as `most` (a factor that several parts share) times an emission texture; metallic and roughness must be stated."""
        mapped = self if self.has_maps else self.add_maps()
        assert mapped.texture is not None
        own = np.full((*mapped.texture.shape[:2], 3), 255, np.uint8) if self.glow is None else self.glow
        glow = tint(own, as_color(linear_to_srgb(np.array(self.light) / most)))
        return replace(mapped, texture=np.concatenate([mapped.texture[..., :7], glow], axis=2), emission=(most,) * 3, has_glow=True)

    def add_opacity(self, most: float) -> "FileMaterial":
        """Same transmission as `most` (shared by several parts), with a constant opacity channel that lowers it to the material's own."""
        texture = np.full((MIN_MAP_SIDE, MIN_MAP_SIDE, 3), 255, np.uint8) if self.texture is None else self.texture
        opacity = np.full((*texture.shape[:2], 1), round(255.0 * (1.0 - self.glass.transmission / most)), np.uint8)
        return replace(self, texture=np.concatenate([texture, opacity], axis=2), glass=replace(self.glass, transmission=most))

    def add_maps(self, **maps: np.ndarray) -> "FileMaterial":
        """Material with normal (H, W, 2), roughness and metallic (H, W, 1) maps, uint8 as of `Material.maps`, of any sizes; those that are
        not given are flat and constant. `glow` (H, W, 3) is one more if it is given. The material must state metallic and roughness. Raises
        CatalogError: too large together."""
        flat = {"color": (255, 255, 255), "normal": (MAP_CENTER, MAP_CENTER)}
        flat |= {"roughness": (round(255 * (self.roughness or 0.0)),), "metallic": (round(255 * (self.metallic or 0.0)),)}
        flat |= {"glow": (255, 255, 255)} if "glow" in maps else {}
        planes = maps if self.texture is None else {"color": self.texture, **maps}
        height, width = (max([MIN_MAP_SIDE, *(image.shape[axis] for image in planes.values())]) for axis in (0, 1))
        if height * width > MAX_TEXTURE_PIXELS:
            raise CatalogError(f"a texture with maps of {width} x {height} pixels; allowed: {MAX_TEXTURE_PIXELS} pixels; scale them alike")
        layers = [
            resize(planes[name], (width, height), Image.Resampling.BILINEAR)
            if name in planes
            else np.broadcast_to(np.array(value, np.uint8), (height, width, len(value)))
            for name, value in flat.items()
        ]
        return replace(self, texture=np.concatenate(layers, axis=2), has_glow="glow" in maps)


def resize(image: np.ndarray, size: tuple[int, int], filter: Image.Resampling) -> np.ndarray:
    """Resize an image of any number of channels (H, W, C) uint8 to a width and height."""
    if image.shape[1::-1] == size:
        return image
    return np.stack(
        [np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize(size, filter)) for plane in image.transpose(2, 0, 1)], -1
    )


# Default base colour (sRGB): a light grey, since highlights do not show on pure white.
GREY = (0.7, 0.7, 0.7)
WHITE = (1.0, 1.0, 1.0)
NO_MATERIAL = FileMaterial(GREY, None, None, None)
"""Material of a part whose file has none: light grey, the rest by the settings."""
_ROUNDING = 1e-6


def plain_color(color: tuple[float, float, float] | None) -> tuple[float, float, float]:
    """Colour for a material whose texture is missing: its own base colour, or light grey if there is none or it is pure white or black
    (placeholders that exporters write beside a texture)."""
    return GREY if color is None or all(value < _ROUNDING for value in color) or all(value > 1.0 - _ROUNDING for value in color) else color


def encode_normals(image: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Encode a normal map of glTF (H, W, 3) uint8 as x and y (H, W, 2) uint8 of `Material.maps`; `scale` is a factor on x and y."""
    normals = (image.astype(np.float32) / 127.5 - 1.0) * np.array((scale, scale, 1.0), np.float32)
    # Images from other programs have 127 or 128 where a surface is flat.
    normals[np.abs(image - 127.5) <= 0.5] = 0.0
    normals[..., 2] = np.maximum(normals[..., 2], _ROUNDING)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return (np.rint(normals[..., :2] * (MAP_CENTER - 1)) + MAP_CENTER).astype(np.uint8)


def srgb_to_linear(value: Any) -> np.ndarray:
    """Decode sRGB in 0..1 to linear light in 0..1, any shape."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= _SRGB_TOE, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).round(DECIMALS)


def linear_to_srgb(value: Any) -> np.ndarray:
    """Encode linear light, clipped to 0..1, as sRGB in 0..1, any shape."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)
    return np.where(value <= _LINEAR_TOE, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055).round(DECIMALS)


def as_color(channels: np.ndarray) -> tuple[float, float, float]:
    """Convert a colour (3) to a tuple."""
    return float(channels[0]), float(channels[1]), float(channels[2])


def rgb8(image: Image.Image) -> np.ndarray:
    """Convert an image of any mode to 8-bit RGB (H, W, 3).

    Grey becomes three equal channels; palettes and CMYK are converted. 16-bit grey is rounded to 8 bits, 16-bit colour is truncated.
    Alpha is dropped, since masks are cut out and texture bakers pad transparent texels with colour for filtering.
    """
    if image.mode == "F":
        grey = np.clip(np.nan_to_num(np.asarray(image)), 0.0, 1.0) * 255.0
    elif image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.float64).clip(0, 65535) / 257.0
    else:
        return np.ascontiguousarray(np.asarray(image.convert("RGB"), dtype=np.uint8))
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def decode_texture(data: bytes, source: str, linear: bool = False) -> np.ndarray:
    """Decode an image as (H, W, 3) uint8; its size is checked in the header before any pixel is decoded. `linear`: keep the values of an
    OpenEXR image (roughness and the like) instead of encoding them as sRGB; other formats are never converted. Raises CatalogError: the
    image is too large, of another format, or damaged."""
    if data.startswith(EXR_MAGIC):
        light = decode_exr(data, source, MAX_TEXTURE_PIXELS)
        return np.rint(255.0 * (np.clip(light, 0.0, 1.0) if linear else linear_to_srgb(light))).astype(np.uint8)
    limit = f"allowed: {MAX_TEXTURE_PIXELS} pixels, such as 8192 x 8192; scale it down"
    with quiet_decoding():
        try:
            with Image.open(io.BytesIO(data), formats=TEXTURE_FORMATS) as image:
                if image.width * image.height <= MAX_TEXTURE_PIXELS:
                    return rgb8(image)
                size = f"{image.width} x {image.height}"
        except Image.DecompressionBombError:
            raise CatalogError(f"{source}: too large an image; {limit}") from None
        except UnidentifiedImageError:
            raise CatalogError(f"{source}: not readable as an image (its format is unknown); use PNG or JPEG") from None
        except Exception as error:  # Pillow's decoders raise nearly anything on damaged files
            raise CatalogError(f"{source}: not readable as an image ({describe_error(error)}); use PNG or JPEG") from None
    raise CatalogError(f"{source}: too large an image, {size} pixels; {limit}")


@dataclass(eq=False)
class ImageCache:
    """Images of one model by any key, each decoded once; limits the number of pixels of all together."""

    owner: Path
    images: dict[Any, np.ndarray] = field(default_factory=dict)

    def decode(self, key: Any, data: bytes, source: str, linear: bool = False) -> np.ndarray:
        """Decode an image as `decode_texture` does; raises CatalogError also if all together have too many pixels."""
        if key not in self.images:
            self.images[key] = decode_texture(data, source, linear)
            if sum(image.size // 3 for image in self.images.values()) > MAX_TEXTURE_PIXELS:
                raise CatalogError(f"{self.owner}: its textures have more than {MAX_TEXTURE_PIXELS} pixels together; scale them down")
        return self.images[key]


def bake_vertex_colors(
    faces: np.ndarray, colors: np.ndarray, factor: np.ndarray | None = None, skin: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Bake vertex colours, and a texture beneath them, into a texture atlas with N x N texels for each triangle.

    Without a texture N is 2: with corner colours a, b, c, three texels hold these and the fourth b + c - a, clipped to 0 .. 1. Where
    nothing is clipped, bilinear filtering equals barycentric interpolation over the triangle up to 8-bit rounding. It never reads another
    triangle's texels. `faces`: vertex indices (F, 3). `colors`: vertex colours, sRGB in 0..1 (V, 3). `factor`: linear factor (3); None: 1.
    `skin`: texture coordinates (V, 2), and the texture (H, W, 3) uint8, which repeats; its colours are multiplied in linear light.

    Returns the texture coordinates of the 3 F corners (3 F, 2) float32, and the texture (S, S, 3) uint8."""
    texels = 2 if skin is None else _texels_per_triangle(faces, *skin)
    cells = int(np.ceil(np.sqrt(len(faces))))
    side = texels * cells
    row, column = (texels * index for index in np.divmod(np.arange(len(faces)), cells))
    light = srgb_to_linear(colors) * (1.0 if factor is None else factor)
    atlas = np.zeros((side, side, 3), np.uint8)
    for down in range(texels):
        for right in range(texels):
            weights = np.array([texels - 1 - down - right, right, down]) / (texels - 1)
            texel = np.einsum("c,fci->fi", weights, light[faces]).clip(0.0, 1.0)
            if skin is not None:
                texel = texel * _sample(skin[1], np.einsum("c,fci->fi", weights, skin[0][faces]))
            atlas[row + down, column + right] = np.rint(linear_to_srgb(texel) * 255.0)
    rows = np.stack([row, row, row + texels - 1], axis=1) + 0.5
    columns = np.stack([column, column + texels - 1, column], axis=1) + 0.5
    uv = np.stack([columns / side, 1.0 - rows / side], axis=-1).reshape(-1, 2)
    return uv.astype(np.float32), atlas


def _texels_per_triangle(faces: np.ndarray, uv: np.ndarray, texture: np.ndarray) -> int:
    """Texels along a triangle's edge, enough for 95 % of the triangles in the texture; the atlas stays within a quarter of the limit."""
    edges = np.diff(uv[faces][:, (0, 1, 2, 0)] * (texture.shape[1], texture.shape[0]), axis=1)
    wanted = np.ceil(np.percentile(np.linalg.norm(edges, axis=2).max(axis=1), 95)) + 1.0
    return int(np.clip(wanted, 2, max(np.sqrt(MAX_TEXTURE_PIXELS / 8 / len(faces)), 2)))


def _sample(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear samples of a texture that repeats, in linear light (N, 3)."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right_share, low_share = (x - left)[:, None], (y - top)[:, None]
    table = srgb_to_linear(np.arange(256) / 255.0)
    upper, lower = (
        table[texture[line % height, left % width]] * (1.0 - right_share) + table[texture[line % height, (left + 1) % width]] * right_share
        for line in (top, top + 1)
    )
    return upper * (1.0 - low_share) + lower * low_share


def tile_texture(texture: np.ndarray, tiles: tuple[int, int], said: list[str]) -> np.ndarray:
    """Lay out a texture in tiles, columns times rows, scaled down as far as the limit on pixels demands, which is added to `said`."""
    height, width = texture.shape[:2]
    scale = np.sqrt(MAX_TEXTURE_PIXELS / 4 / (height * width * tiles[0] * tiles[1]))
    if scale < 1.0:
        width, height = max(int(width * scale), 1), max(int(height * scale), 1)
        said.append(f"a texture repeats {tiles[0]} x {tiles[1]} times beside other materials: scaled to {width} x {height} pixels")
        # With more repetitions than pixels, the texture is its mean, and the rest is left out.
        tiles = min(tiles[0], MAX_TEXTURE_SIDE // width), min(tiles[1], MAX_TEXTURE_SIDE // height)
        texture = resize(texture, (width, height), Image.Resampling.BOX)
    return np.tile(texture, (tiles[1], tiles[0], 1))


def clamp_texture(texture: Any, uv: np.ndarray, axes: tuple[bool, bool], ignored: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Extend a texture by its border texels as far as texture coordinates reach beyond it (clamp to edge), since textures repeat here.
    `texture`: (H, W, 3) uint8. `uv`: texture coordinates (V, 2), v up. `axes`: whether u and v are clamped. `ignored`: what is not done is
    added to it: an image that would exceed a quarter of the limit on pixels is not extended. Returns the image, and coordinates in it."""
    sides = np.array(texture.shape[1::-1], np.float64)
    low, high = np.minimum(uv.min(axis=0), 0.0), np.maximum(uv.max(axis=0), 1.0)
    # One texel more, which filtering at the border reads.
    before, after = (np.where(axes & (margin > 0.0), np.ceil(margin * sides) + 1.0, 0.0) for margin in (-low, high - 1.0))
    larger = sides + before + after
    if larger.prod() > MAX_TEXTURE_PIXELS / 4 or larger.max() > MAX_TEXTURE_SIDE:
        ignored.append("clamping of a texture far beyond its borders")
        return texture, uv
    left, below, right, above = (int(count) for count in (*before, *after))
    return np.pad(texture, ((above, below), (left, right), (0, 0)), mode="edge"), (uv * sides + before) / larger


def join_textures(parts: list[tuple[np.ndarray | None, FileMaterial]], owner: str, said: list[str]) -> tuple[list[np.ndarray], np.ndarray]:
    """Merge the materials of several parts into one texture atlas, with base colour factors multiplied in. `parts`: texture coordinates (V,
    2) in 0..1, or None, and the material, of each part. `said`: warnings are added to it. Returns new texture coordinates of each part, one
    row (1, 2) for parts without texture and anisotropy; and the atlas (H, W, C) uint8. Raises CatalogError: the atlas is too large."""
    places: dict[tuple[int, tuple[float, ...]], int] = {}
    blocks, index = [], []
    for uv, material in parts:
        texture = None if uv is None and (material.texture is None or material.texture.shape[2] == 3) else material.texture
        key = (id(texture), material.color)
        if key not in places:
            places[key] = len(blocks)
            blocks.append(tint(np.full((4, 4, 3), 255, np.uint8) if texture is None else texture, material.color))
        index.append(places[key])
    blocks = _fit_blocks(blocks, owner, said)
    width, height = max(block.shape[1] for block in blocks), sum(block.shape[0] for block in blocks)
    atlas, tops = np.zeros((height, width, blocks[0].shape[2]), np.uint8), np.cumsum([0, *(block.shape[0] for block in blocks)])
    for block, top in zip(blocks, tops, strict=False):
        atlas[top : top + block.shape[0], : block.shape[1]] = block
        # Maps go on beside a narrow block, as mip levels blend across its border.
        atlas[top : top + block.shape[0], block.shape[1] :, 3:] = block[:, -1:, 3:]
    uvs = []
    for (uv, material), place in zip(parts, index, strict=True):
        uv = np.full((1, 2), 0.5) if uv is None or (material.texture is None and not material.finish.anisotropy) else uv
        rows, columns = blocks[place].shape[:2]
        # At least half a texel from the block's border, so that filtering does not bleed.
        column = np.clip(uv[:, 0] * columns, 0.5, columns - 0.5)
        row = tops[place] + np.clip((1.0 - uv[:, 1]) * rows, 0.5, rows - 0.5)
        uvs.append(np.stack([column / width, 1.0 - row / height], axis=1))
    return uvs, atlas


def tint(texture: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    """Multiply the colours of a texture by a base colour factor, sRGB, in linear light; by white it stays as it is."""
    # A table of the 256 levels, since whole images in 64-bit floats take eight times the room.
    levels = srgb_to_linear(np.arange(256) / 255.0)[:, None] * srgb_to_linear(color)
    table = np.rint(linear_to_srgb(levels) * 255.0).astype(np.uint8)
    colors = [table[texture[..., channel], channel] for channel in range(3)]
    return np.stack([*colors, *texture[..., 3:].transpose(2, 0, 1)], axis=-1)


def _fit_blocks(blocks: list[np.ndarray], owner: str, said: list[str]) -> list[np.ndarray]:
    """Scale the blocks of an atlas down until it is within the limit on pixels."""
    first = blocks
    for halvings in range(8):
        if halvings:
            sizes = [(max(block.shape[1] >> halvings, 4), max(block.shape[0] >> halvings, 4)) for block in first]
            blocks = [resize(block, size, Image.Resampling.BOX) for block, size in zip(first, sizes, strict=True)]
        if max(block.shape[1] for block in blocks) * sum(block.shape[0] for block in blocks) <= MAX_TEXTURE_PIXELS:
            said += [f"its textures together are too large: scaled by 1/{2**halvings}"] if halvings else []
            return blocks
    raise CatalogError(f"{owner}: {len(blocks)} textures are too many for one image; merge its materials")


def decode_exr(data: bytes, source: str, most: int) -> np.ndarray:
    """Decode the colour or grey channels of an OpenEXR image as (H, W, 3) float32, linear; the first layer that has them. `most`: maximum
    number of pixels, which is checked by the header. Raises CatalogError: the image is too large, damaged or has no such channels."""
    try:
        low, high = OpenEXR.File(io.BytesIO(data), header_only=True).header()["dataWindow"]
        width, height = (int(size) for size in np.subtract(high, low, dtype=np.int64) + 1)
        if width * height > most:
            raise CatalogError(f"{source}: too large an image, {width} x {height} pixels; allowed: {most} pixels; scale it down")
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    except CatalogError:
        raise
    except Exception as error:  # the library raises nearly anything on damaged files
        raise CatalogError(f"{source}: not readable as OpenEXR ({describe_error(error)}); use PNG or JPEG") from None
    planes = _exr_planes({str(name): np.asarray(channel.pixels) for name, channel in channels.items()})
    if planes is None:
        raise CatalogError(f"{source}: an OpenEXR image without channels R, G, B or Y of one size; use PNG or JPEG")
    return np.nan_to_num(np.stack(planes, axis=-1).astype(np.float32), nan=0.0, posinf=1.0, neginf=0.0)


def _exr_planes(channels: dict[str, np.ndarray]) -> list[np.ndarray] | None:
    """Three planes (H, W) of the first layer with colours, or with grey; a sole channel of any name is grey. None: there are none."""
    layers = sorted({name.rpartition(".")[0] for name in channels}, key=lambda layer: (len(layer), layer))
    for names in _EXR_COLORS:
        for layer in layers:
            found = [channels.get(f"{layer}.{name}" if layer else name) for name in names]
            planes = [plane for plane in found if plane is not None]
            if len(planes) == len(names) and len({plane.shape for plane in planes}) == 1:
                return planes * (3 // len(planes))
    return list(channels.values()) * 3 if len(channels) == 1 else None
