"""MTL material libraries: diffuse colour, textures with their options, and the PBR extension's metallic and roughness.

The renderer's material model is metallic-roughness. Statements of MTL's Phong model have no counterpart in it and are left out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, MAX_TEXTURE_PIXELS, FileMaterial, as_color, decode_texture
from synpick_warp.scenes.assets.asset_files import is_missing, read_referred
from synpick_warp.scenes.assets.mesh_parts import GREY, WHITE, Notes, plain_color

# Options of a texture statement and how many arguments each takes at most.
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-bm": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3}
_OPTIONS |= {"-texres": 1, "-type": 1, "-colorspace": 1}
# Option values that match what the renderer does anyway; others are reported as ignored.
_NEUTRAL = {"-blendu": ("on",), "-blendv": ("on",), "-cc": ("off",), "-clamp": ("off",), "-mm": ("0", "1"), "-colorspace": ("srgb",)}
_NEUTRAL |= {"-imfchan": ("m",), "-t": ("0", "0", "0"), "-boost": ("0",)}
_TOLERANCE = 1e-3
"""Amount by which a colour may exceed 1 through rounding."""
# Statements that are left out without a report: most are of the Phong model, and nearly every exporter writes them.
_SILENT = {"ka", "ks", "ns", "ni", "illum", "tf", "d", "tr", "ke", "pcr", "aniso", "anisor", "sharpness", "ps", "pc", "xd"}


@dataclass(eq=False)
class MtlMaterial:
    """Colours, factors and image names of a material as its library states; the images are not yet read."""

    library: Path
    color: tuple[float, float, float] | None = None
    """Diffuse colour (Kd), sRGB in 0..1; None: not stated."""
    maps: dict[str, str] = field(default_factory=dict)
    """Image file names of the statements map_kd, map_pm and map_pr, by statement."""
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    """Scale and offset of map_Kd's texture coordinates (options -s and -o)."""
    clamp: bool = False
    """Whether map_Kd is clamped to its edges instead of repeated (option -clamp)."""
    factors: dict[str, float] = field(default_factory=dict)
    """Metallic (pm) and roughness (pr) in 0..1, as far as they are stated."""
    ignored: list[str] = field(default_factory=list)
    """Names of statements and options that are not used."""

    def transform(self, uv: np.ndarray) -> np.ndarray:
        """Texture coordinates (V, 2) with the options -s and -o of map_Kd applied."""
        return uv * self.scale + self.offset

    def missing_images(self) -> list[str]:
        """Names of the images that the material refers to and that do not exist."""
        return [name for name in self.maps.values() if is_missing(self.library.parent, name.partition(" #")[0], self.library)]


@dataclass(eq=False)
class TexturePixels:
    """Image decoder of one OBJ file: decodes each image once, and limits the number of pixels of all together."""

    owner: Path
    images: dict[tuple[Path, bool], np.ndarray] = field(default_factory=dict)

    def read(self, name: str, library: Path, linear: bool) -> np.ndarray:
        """Decode an image that a material library names; `linear`: one of numbers, as roughness is.

        Returns:
            The image (H, W, 3) uint8.

        Raises:
            CatalogError: It is missing or damaged, or all images together have too many pixels.
        """
        plain = name.partition(" #")[0].strip()
        name = plain if plain and is_missing(library.parent, name, library) else name
        path, data = read_referred(library.parent, name, library, MAX_TEXTURE_FILE)
        key = path, linear and path.suffix.lower() == ".exr"
        if key not in self.images:
            self.images[key] = decode_texture(data, str(path), linear)
            if sum(image.size // 3 for image in self.images.values()) > MAX_TEXTURE_PIXELS:
                raise CatalogError(f"{self.owner}: its textures have more than {MAX_TEXTURE_PIXELS} pixels together; scale them down")
        return self.images[key]


def join_lines(text: str) -> str:
    """Text with line feeds as line ends, and lines that end in a backslash joined with the next."""
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")


def parse_library(text: str, library: Path) -> dict[str, MtlMaterial]:
    """Parse a material library.

    Raises:
        CatalogError: A colour is not finite.
    """
    materials: dict[str, MtlMaterial] = {}
    current: MtlMaterial | None = None
    for line in join_lines(text).split("\n"):
        words = line.split()
        key = words[0].lower() if len(words) > 1 else ""
        if key == "newmtl":
            current = materials.setdefault(" ".join(words[1:]), MtlMaterial(library))
        elif current is not None and key and key[0] != "#":
            _parse_statement(current, key, words, line.strip())
    return materials


def _parse_statement(material: MtlMaterial, key: str, words: list[str], line: str) -> None:
    """Parse one statement of a material."""
    if not key.startswith("map_"):
        words = line.partition(" #")[0].split()
    if key == "kd":
        material.color = _color(words[1:], material)
    elif key in ("pm", "pr"):
        values = _numbers(words[1:2])
        if values and np.isfinite(values[0]):
            material.factors[key] = float(np.clip(values[0], 0.0, 1.0))
    elif key in ("map_kd", "map_pm", "map_pr"):
        _parse_map(material, key, words, line)
    elif key not in _SILENT:
        material.ignored.append(ascii(words[0])[1:-1][:40])
    elif (key == "d" and _numbers(words[-1:]) not in ([1.0], [])) or (key == "tr" and _numbers(words[1:2]) not in ([0.0], [1.0], [])):
        # Of Tr both ends are written for opaque materials.
        material.ignored.append("transparency")
    elif key == "ke" and any(_numbers(words[1:])):
        material.ignored.append("emission")


def _parse_map(material: MtlMaterial, key: str, words: list[str], line: str) -> None:
    """Parse a texture statement: options with their arguments, then a file name, which may contain blanks."""
    at = 1
    while at < len(words) and words[at].lower() in _OPTIONS:
        option = words[at].lower()
        end = at + 1
        while (
            end < len(words) - 1
            and end - at <= _OPTIONS[option]
            and (option not in ("-o", "-s", "-t", "-mm") or _numbers(words[end : end + 1]))
        ):
            end += 1
        arguments = words[at + 1 : end]
        values = _numbers(arguments)
        if option in ("-o", "-s") and values and np.isfinite(values).all() and key == "map_kd":
            # A value that is left out is the default: of -s 1, of -o 0.
            first, second = (*values, 1.0 if option == "-s" else 0.0)[:2]
            if option == "-s":
                material.scale = (first, second)
            else:
                material.offset = (first, second)
        elif option == "-clamp" and key == "map_kd" and arguments[:1] and arguments[0].lower() in ("on", "off"):
            material.clamp = arguments[0].lower() == "on"
        elif not _is_neutral(option, arguments):
            material.ignored.append(f"{ascii(words[0])[1:-1]} {option}")
        at = end
    name = line.split(maxsplit=at)[at:]
    if name:
        material.maps[key] = name[0].strip().strip('"')


def _is_neutral(option: str, arguments: list[str]) -> bool:
    """Whether an option with these arguments changes nothing in how the renderer draws the texture."""
    expected = _NEUTRAL.get(option)
    if expected is None:
        return option in ("-texres", "-type", "-bm", "-o", "-s")
    return all(
        word.lower() == other or _numbers([word]) == _numbers([other]) != [] for word, other in zip(arguments, expected, strict=False)
    )


def _numbers(words: list[str]) -> list[float]:
    """Convert words to numbers; an empty list if any of them is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _color(words: list[str], material: MtlMaterial) -> tuple[float, float, float] | None:
    """Parse a diffuse colour: one number for grey, or three. A colour given as a spectrum or in XYZ is reported as ignored."""
    values = _numbers(words)
    if not values:
        material.ignored.append(f"Kd {ascii(words[0])[1:-1][:20]}")
        return material.color
    if not np.isfinite(values).all():
        shown = ascii(" ".join(words))[1:-1][:80]
        raise CatalogError(f"{material.library}: Kd {shown} is not finite; give red, green and blue from 0 to 1")
    color = np.array((values if len(values) >= 3 else values[:1] * 3)[:3])
    if color.max() > 1.0 + _TOLERANCE:
        material.ignored.append(f"Kd beyond 1 ({' '.join(f'{value:g}' for value in color)})")
    return as_color(np.clip(color, 0.0, 1.0))


def read_material(material: MtlMaterial, pixels: TexturePixels, notes: Notes) -> FileMaterial:
    """Read a material's images and convert it. The renderer takes one metallic and one roughness value: the means of their maps.

    Raises:
        CatalogError: An image is damaged, or missing and not replaced.
    """
    notes.ignored += material.ignored
    images = {
        key: notes.image(lambda name=name, key=key: pixels.read(name, material.library, key != "map_kd"))
        for key, name in material.maps.items()
    }
    factors = dict(material.factors)
    factors |= {key[4:]: float(image.mean() / 255.0) for key, image in images.items() if key != "map_kd" and image is not None}
    texture = images.get("map_kd")
    # With an image Kd is ignored: exporters leave 0.64, or 0, there.
    plain = plain_color(material.color) if "map_kd" in material.maps else material.color or GREY
    color = WHITE if texture is not None else plain
    return FileMaterial(color, texture, factors.get("pm"), factors.get("pr"))
