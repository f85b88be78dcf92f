"""OBJ import with MTL material libraries.

Text is parsed by trimesh, in a form that it understands: it mistakes other line ends, indentation, comments behind numbers and indices of
vertex 0, and makes fans of concave polygons. All files are opened here, none by trimesh. Of materials diffuse colour, textures with their
options, and the PBR extension's metallic and roughness are read: the renderer's model is metallic-roughness, and statements of MTL's Phong
model have no counterpart in it.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.obj import load_obj
from trimesh.geometry import triangulate_quads

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets import appearance, asset_files
from synpick_warp.scenes.assets.mesh_parts import MeshPart, clip_ears, find_concave
from synpick_warp.system.inputs.files import read_file

MAX_LIBRARY = 2**22
"""Largest material library [bytes]: 4 MiB."""
_LIBRARY = "library"
_INDENT = re.compile(r"(?m)^ +")
_COMMENT = re.compile(r"(?m)^((?:f|fo|v|vt|vn|l|p|s) [^#\n]*)#.*$")
_OUTDATED = re.compile(r"(?m)^fo ")
_MATERIAL = re.compile(r"(?m)^usemtl .*$")
_ZERO = re.compile(r"(?m)^f (?:[^\n]* )?[-+]?0+(?=[/ \n]|\Z)")
_RELATIVE = re.compile(r"(?m)^f [^\n]*-")
_POLYGON = re.compile(r"(?m)^f +\S+ +\S+ +\S+ +\S+.*$")
_KINDS = ("v", "vt", "vn")


def read_obj(path: Path, notes: asset_files.Notes) -> list[MeshPart]:
    """Read an OBJ file, its material libraries, and the images of the materials that its faces use. Returns one part per material. Raises
    CatalogError: the file or one that it refers to cannot be used."""
    text = asset_files.decode_text(read_file(path, asset_files.MAX_TEXT_MESH, CatalogError))
    if text.count("\n") > 4 * asset_files.MAX_ROWS:
        raise CatalogError(f"{path}: more than {4 * asset_files.MAX_ROWS} lines; decimate the mesh")
    text = normalize_text(text, path, notes.ignored)
    lines = text.split("\n")
    # As the reader takes them: the rest of the line behind the word.
    used = dict.fromkeys(line[line.index("usemtl ") + 7 :].strip() for line in lines if "usemtl " in line)
    used.pop("", None)
    if len(used) > asset_files.MAX_PARTS or text.count("usemtl ") > asset_files.MAX_ROWS:
        raise CatalogError(f"{path}: more than {asset_files.MAX_PARTS} materials; merge them")
    known = _read_libraries(path, lines, notes)
    known |= {name: known[other] for name in used if name not in known and (other := _similar_name(name, known))}
    drawn = [known[name] for name in used if name in known]
    for name in [name for name, material in known.items() if material not in drawn]:
        notes.said += [f"the image {ascii(image)[:80]} of an unused material is missing" for image in known[name].missing_images()]
    pixels = TexturePixels(path)
    materials = {name: read_material(known[name], pixels, notes) for name in used if name in known}
    with asset_files.reading_as("OBJ", path, text.encode()):
        parts = [_part(mesh, used, known, materials, path, notes) for mesh in _load(text, used)]
    if not parts:
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return parts


def _load(text: str, used: dict[str, None]) -> list[dict[str, Any]]:
    """Parse OBJ text with trimesh. Returns one dictionary of arrays per material, sorted by name; `visual.material` has only a name."""
    # A library of names only: which mesh has which material; what the materials are is read here.
    table = {_LIBRARY: "\n".join(f"newmtl {name}" for name in used).encode()}
    content = load_obj(io.BytesIO(f"mtllib {_LIBRARY}\n{text}".encode()), resolver=table)
    return [mesh for _, mesh in sorted(content.get("geometry", {}).items())]


def _part(
    mesh: dict[str, Any],
    used: dict[str, None],
    known: dict[str, MtlMaterial],
    materials: dict[str, appearance.FileMaterial],
    path: Path,
    notes: asset_files.Notes,
) -> MeshPart:
    vertices, faces = np.asarray(mesh["vertices"], np.float64), triangulate_quads(mesh["faces"])
    normals, visual, colors = mesh.get("vertex_normals"), mesh.get("visual"), mesh.get("vertex_colors")
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or (normals is not None and np.shape(normals) != vertices.shape):
        raise CatalogError(f"{path}: vertices, normals or triangles with other than three numbers each; repair the mesh")
    # Without a material the reader invents one of some name.
    name, uv = getattr(getattr(visual, "material", None), "name", ""), getattr(visual, "uv", None)
    material = materials.get(name, appearance.NO_MATERIAL)
    if material.texture is not None:
        if uv is None or len(uv) != len(vertices):
            raise CatalogError(f"{path}: has a texture, but vertices without texture coordinates; unwrap it or remove the texture")
        uv = np.asarray(uv, np.float64)[:, :2] * known[name].scale + known[name].offset
        if known[name].clamp and len(uv) and (uv.min() < -appearance.UV_TOLERANCE or uv.max() > 1.0 + appearance.UV_TOLERANCE):
            image, uv = appearance.clamp_texture(material.texture, uv, (True, True), notes.ignored)
            material = replace(material, texture=image)
    if colors is not None:
        if len(colors) != len(vertices):
            raise CatalogError(f"{path}: {len(colors)} vertex colours for {len(vertices)} vertices; repair the mesh")
        if name in materials:
            notes.ignored.append("vertex colours beside a material")
        # OBJ does not specify the colours' space; files contain colours of sRGB images.
        colors = None if name in materials else _unit_colors(np.asarray(colors)[:, :3])
    if name not in materials:
        if known:
            what = f"no material {ascii(name)[:80]} in its libraries" if name in used else "triangles without a material"
            notes.said.append(f"{what}, the default is used")
        notes.ignored += ["texture coordinates without a texture"] if uv is not None else []
    if colors is not None:
        material = replace(appearance.NO_MATERIAL, color=appearance.WHITE)
    return MeshPart(vertices, faces, normals, None if material.texture is None else uv, colors, material)


def _unit_colors(colors: np.ndarray) -> np.ndarray:
    """Scale colours to 0..1; if any value exceeds 1, they are taken as 0..255."""
    colors = np.nan_to_num(np.asarray(colors, np.float64))
    return np.clip(colors / (255.0 if colors.size and colors.max() > 1.0 else 1.0), 0.0, 1.0)


def _similar_name(name: str, known: dict[str, MtlMaterial]) -> str | None:
    """Look up a material whose exact name no library defines: without a trailing comment, or ignoring case. None: there is none."""
    plain = name.partition(" #")[0].strip()
    return plain if plain in known else next((other for other in known if other.casefold() == plain.casefold()), None)


def _library_names(line: str, folder: Path, owner: Path) -> list[str]:
    """Libraries of an `mtllib` line: the rest of the line if a file of this name exists, else one per word if all end in .mtl."""
    name = line.partition(" ")[2].strip()
    choices = (name, name.strip('"'), name.partition(" #")[0].strip())
    whole = next((each for each in choices if each and not asset_files.is_missing(folder, each, owner)), None)
    words = name.partition(" #")[0].split()
    several = len(words) > 1 and all(word.lower().endswith(".mtl") for word in words)
    return [whole] if whole else words if several else [name]


def _read_libraries(path: Path, lines: list[str], notes: asset_files.Notes) -> dict[str, MtlMaterial]:
    """Read all libraries that an OBJ file refers to. Returns materials by name; a missing library is a warning, not an error."""
    known: dict[str, MtlMaterial] = {}
    named = dict.fromkeys(line for line in lines if line.startswith("mtllib ") and line[7:].strip())
    for name in dict.fromkeys(name for line in named for name in _library_names(line, path.parent, path)):
        try:
            library, data = asset_files.read_referred(path.parent, name, path, MAX_LIBRARY)
        except asset_files.MissingFileError:
            notes.said.append(f"there is no material library {ascii(name)[:80]}, the default material is used")
            continue
        known |= parse_library(asset_files.decode_text(data), library)
        if len(known) > asset_files.MAX_PARTS:
            raise CatalogError(f"{path}: its material libraries have more than {asset_files.MAX_PARTS} materials; merge them")
    return known


def normalize_text(text: str, path: Path, ignored: list[str]) -> str:
    """Rewrite the text of an OBJ file: lines end in a line feed and begin with a keyword and one blank, without comments behind numbers;
    indices are absolute, and concave polygons are triangles. `ignored`: what is left out is added to it. Raises CatalogError: a face refers
    to vertex 0."""
    text = join_lines(text).replace("\t", " ")
    text = _OUTDATED.sub("f ", _INDENT.sub("", text))
    text = _MATERIAL.sub(lambda match: " ".join(match[0].split()), text)
    if "#" in text:
        text = _COMMENT.sub(r"\1", text)
    if _ZERO.search(text):
        raise CatalogError(f"{path}: a face refers to vertex 0, but indices begin at 1; export it again")
    if _RELATIVE.search(text):
        text = _resolve_indices(text)
    return _split_concave(text, ignored) if _POLYGON.search(text) else text


def _resolve_indices(text: str) -> str:
    """Convert relative (negative) vertex indices to absolute ones."""
    counts, lines = dict.fromkeys(_KINDS, 0), text.split("\n")
    for number, line in enumerate(lines):
        kind, _, rest = line.partition(" ")
        if kind in counts:
            counts[kind] += 1
        elif kind == "f" and "-" in rest:
            known = tuple(counts.values())
            corners = (zip(corner.split("/"), known, strict=False) for corner in rest.split())
            lines[number] = "f " + " ".join(
                "/".join(str(count + 1 + int(index)) if index.startswith("-") else index for index, count in corner) for corner in corners
            )
    return "\n".join(lines)


def _split_concave(text: str, ignored: list[str]) -> str:
    """Triangulate concave polygons, since the reader makes triangle fans; other text is unchanged."""
    matches = list(_POLYGON.finditer(text))
    try:
        rows = [line.split()[1:4] for line in re.findall(r"(?m)^v [^\n]*", text)]
        vertices = np.array(rows, np.float64).reshape(-1, 3)
        polygons = [[int(corner.split("/")[0]) - 1 for corner in match[0].split()[1:]] for match in matches]
        flat = np.concatenate([np.array(polygon, np.int64) for polygon in polygons])
        if flat.min() < 0 or flat.max() >= len(vertices):
            return text
    except ValueError:  # The reader says what is wrong.
        return text
    parts, end = [], 0
    for index in find_concave(vertices, flat, np.array([len(polygon) for polygon in polygons]), ignored):
        match, corners = matches[index], matches[index][0].split()[1:]
        triangles = clip_ears(vertices[polygons[index]])
        parts += [text[end : match.start()], "\n".join("f " + " ".join(corners[at] for at in triangle) for triangle in triangles)]
        end = match.end()
    return "".join([*parts, text[end:]])


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
    """Material of an MTL library before its images are read: colours, factors and image file names."""

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
    """Metallic (Pm) and roughness (Pr) in 0..1, where the library states them."""
    ignored: list[str] = field(default_factory=list)
    """Names of unsupported statements and options."""

    def missing_images(self) -> list[str]:
        """Names of images that the material refers to and that are missing."""
        return [name for name in self.maps.values() if asset_files.is_missing(self.library.parent, name.partition(" #")[0], self.library)]


class TexturePixels(appearance.ImageCache):
    """Image cache of one OBJ file."""

    def read(self, name: str, library: Path, linear: bool) -> np.ndarray:
        """Decode an image that a material library names; `linear`: one of numbers, as roughness is. Returns the image (H, W, 3) uint8.
        Raises CatalogError: it is missing or damaged, or all images together have too many pixels."""
        plain = name.partition(" #")[0].strip()
        name = plain if plain and asset_files.is_missing(library.parent, name, library) else name
        path, data = asset_files.read_referred(library.parent, name, library, appearance.MAX_TEXTURE_FILE)
        return self.decode((path, linear and path.suffix.lower() == ".exr"), data, str(path), linear)


def join_lines(text: str) -> str:
    """Text with line feeds as line ends, and lines that end in a backslash joined with the next."""
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")


def parse_library(text: str, library: Path) -> dict[str, MtlMaterial]:
    """Parse a material library. Raises CatalogError: a colour is not finite."""
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
    """Whether an option with these arguments has no effect on the rendered texture."""
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
    return appearance.as_color(np.clip(color, 0.0, 1.0))


def read_material(material: MtlMaterial, pixels: TexturePixels, notes: asset_files.Notes) -> appearance.FileMaterial:
    """Read a material's images and convert it. The renderer takes one metallic and one roughness value: the means of their maps. Raises
    CatalogError: an image is damaged, or missing and not replaced."""
    notes.ignored += material.ignored
    images = {
        key: notes.image(lambda name=name, key=key: pixels.read(name, material.library, key != "map_kd"))
        for key, name in material.maps.items()
    }
    factors = dict(material.factors)
    factors |= {key[4:]: float(image.mean() / 255.0) for key, image in images.items() if key != "map_kd" and image is not None}
    texture = images.get("map_kd")
    # With an image Kd is ignored: exporters leave 0.64, or 0, there.
    plain = appearance.plain_color(material.color) if "map_kd" in material.maps else material.color or appearance.GREY
    color = appearance.WHITE if texture is not None else plain
    return appearance.FileMaterial(color, texture, factors.get("pm"), factors.get("pr"))
