"""GLB import (glTF 2.0, binary): chunks and JSON are validated and rewritten, so that the reader opens no file by itself.

Of the JSON chunk only what is declared here reaches the reader: geometry, nodes, base colour and metallic-roughness with their images.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from synpick_warp.errors import CatalogError
from synpick_warp.inputs.files import read_file
from synpick_warp.inputs.json import decode_json
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, MAX_TEXTURE_PIXELS, decode_texture
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE, MAX_PARTS, MAX_ROWS, FileTable, read_referred

MAX_DEPTH = 256
"""Maximum depth of the tree of nodes."""
_JSON, _BIN = b"JSON", b"BIN\0"
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES, _STRIP = 4, 5

_Index = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]
_Item = TypeVar("_Item")


class _Struct(msgspec.Struct, omit_defaults=True):
    """A part of the JSON chunk; keys that are not declared are left out."""


class _Buffer(_Struct):
    uri: str | None = None


class _View(_Struct):
    buffer: _Index
    byteLength: _Index  # noqa: N815
    byteOffset: _Index = 0  # noqa: N815
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None  # noqa: N815


class _Accessor(_Struct):
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]  # noqa: N815
    count: _Index
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: _Index | None = None  # noqa: N815
    byteOffset: _Index = 0  # noqa: N815


class _Primitive(_Struct):
    attributes: dict[str, _Index]
    indices: _Index | None = None
    mode: int = _TRIANGLES
    material: _Index | None = None


class _Mesh(_Struct):
    primitives: list[_Primitive]
    name: str | None = None


class _Node(_Struct):
    name: str | None = None
    mesh: _Index | None = None
    children: list[_Index] = []
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: _Three | None = None
    rotation: _Four | None = None
    scale: _Three | None = None


class _Scene(_Struct):
    nodes: list[_Index] = []


class _Image(_Struct):
    uri: str | None = None
    bufferView: _Index | None = None  # noqa: N815
    mimeType: str = ""  # noqa: N815


class _Texture(_Struct):
    source: _Index | None = None
    extensions: dict[str, Any] = {}


class _TextureInfo(_Struct):
    index: _Index


class _Pbr(_Struct):
    baseColorFactor: _Four | None = None  # noqa: N815
    metallicFactor: float | None = None  # noqa: N815
    roughnessFactor: float | None = None  # noqa: N815
    baseColorTexture: _TextureInfo | None = None  # noqa: N815
    metallicRoughnessTexture: _TextureInfo | None = None  # noqa: N815


class _Glossiness(_Struct):
    diffuseFactor: _Four | None = None  # noqa: N815
    specularFactor: _Three | None = None  # noqa: N815
    glossinessFactor: float | None = None  # noqa: N815
    diffuseTexture: _TextureInfo | None = None  # noqa: N815
    specularGlossinessTexture: _TextureInfo | None = None  # noqa: N815


class _Extensions(_Struct):
    glossiness: _Glossiness | None = msgspec.field(name="KHR_materials_pbrSpecularGlossiness", default=None)


class _Material(_Struct):
    pbrMetallicRoughness: _Pbr | None = None  # noqa: N815
    extensions: _Extensions | None = None


class _Gltf(_Struct):
    buffers: list[_Buffer] = []
    bufferViews: list[_View] = []  # noqa: N815
    accessors: list[_Accessor] = []
    images: list[_Image] = []
    textures: list[_Texture] = []
    materials: list[_Material] = []
    meshes: list[_Mesh] = []
    nodes: list[_Node] = []
    scenes: list[_Scene] | None = None
    scene: _Index | None = None


def prepare_glb(path: Path) -> tuple[bytes, FileTable]:
    """Read a GLB file and the files that it refers to.

    Returns:
        A GLB file of a JSON chunk only, for the reader; and the buffers and images that it refers to by name.

    Raises:
        CatalogError: The file is damaged, exceeds a limit, refers to a file outside of its folder, or contains a damaged image.
    """
    header, chunks = _split_chunks(read_file(path, MAX_MESH_FILE, CatalogError), path)
    gltf = decode_json(header, _Gltf, f"{path}: its JSON chunk", CatalogError)
    _check_sizes(gltf, path)
    _check_tree(gltf, path)
    table = FileTable(path.name)
    buffers = _read_buffers(gltf, chunks, path)
    _move_images(gltf, buffers, table, path)
    for number, buffer in enumerate(buffers):
        table.files[f"buffer{number}"] = buffer
    gltf.buffers = [_Buffer(f"buffer{number}") for number in range(len(buffers))]
    text = msgspec.json.encode(gltf)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), _JSON) + text, table


def _split_chunks(data: bytes, path: Path) -> tuple[bytes, list[bytes]]:
    """The JSON chunk and all binary chunks; chunks of other types are ignored, as glTF demands."""
    if data[:4] != b"glTF" or len(data) < 20 or data[4:8] != b"\2\0\0\0" or data[16:20] != _JSON:
        raise CatalogError(f"{path}: not readable as GLB (it does not begin with the header of glTF 2.0 and a JSON chunk)")
    at, chunks = 12, []
    while at + 8 <= len(data) and len(chunks) <= MAX_PARTS:
        length, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + length > len(data):
            raise CatalogError(f"{path}: not readable as GLB (its chunk at byte {at} is cut short)")
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 8 + length
    return chunks[0][1], [chunk for kind, chunk in chunks[1:] if kind == _BIN]


def _at(items: list[_Item], index: int, what: str, path: Path) -> _Item:
    if index >= len(items):
        raise CatalogError(f"{path}: refers to {what} {index}, but there are {len(items)}; export it again")
    return items[index]


def _check_sizes(gltf: _Gltf, path: Path) -> None:
    """Check what the reader would allocate: views and accessors in bytes, vertices and triangles of all meshes and of all nodes."""
    for name in ("buffers", "bufferViews", "accessors", "images", "textures", "materials", "meshes", "nodes"):
        limit = MAX_PARTS * (8 if name in ("bufferViews", "accessors") else 1)
        if len(getattr(gltf, name)) > limit:
            raise CatalogError(f"{path}: {len(getattr(gltf, name))} {name}; allowed: {limit}; merge the meshes' parts")
    viewed = sum(view.byteLength for view in gltf.bufferViews)
    stored = sum(each.count * _BYTES[each.componentType] * _WIDTHS[each.type] for each in gltf.accessors)
    if max(viewed, stored) > 2 * MAX_MESH_FILE:
        raise CatalogError(f"{path}: its accessors take {max(viewed, stored)} bytes; allowed: {2 * MAX_MESH_FILE}; decimate the mesh")
    rows = []
    for mesh in gltf.meshes:
        mesh.primitives = [each for each in mesh.primitives if each.mode in (_TRIANGLES, _STRIP)]
        rows.append(sum(_primitive_rows(gltf, each, path) for each in mesh.primitives))
    drawn = sum(_at(rows, node.mesh, "mesh", path) for node in gltf.nodes if node.mesh is not None)
    parts = sum(len(gltf.meshes[node.mesh].primitives) for node in gltf.nodes if node.mesh is not None)
    if max(sum(rows), drawn) > MAX_ROWS or max(parts, sum(len(mesh.primitives) for mesh in gltf.meshes)) > MAX_PARTS:
        raise CatalogError(f"{path}: more than {MAX_ROWS} vertices or {MAX_PARTS} parts; decimate the mesh")


def _primitive_rows(gltf: _Gltf, primitive: _Primitive, path: Path) -> int:
    """Vertices or triangles of a primitive, whichever are more; attributes that the reader does not need are removed."""
    kept = {key: index for key, index in primitive.attributes.items() if key in ("POSITION", "NORMAL", "TEXCOORD_0", "COLOR_0")}
    primitive.attributes = kept
    if "POSITION" not in kept:
        raise CatalogError(f"{path}: a mesh has no positions; export it again")
    for key, index in (*kept.items(), *([("indices", primitive.indices)] if primitive.indices is not None else ())):
        accessor = _at(gltf.accessors, index, "accessor", path)
        if accessor.bufferView is None and accessor.count:
            raise CatalogError(f"{path}: {key} without data, as in files with compressed geometry; export it without compression")
        if key in ("POSITION", "NORMAL") and accessor.type != "VEC3":
            raise CatalogError(f"{path}: {key} is of type {accessor.type}; needed: VEC3; export it again")
    count = gltf.accessors[kept["POSITION"]].count
    corners = gltf.accessors[primitive.indices].count if primitive.indices is not None else count
    return max(count, corners // 3 if primitive.mode == _TRIANGLES else corners)


def _check_tree(gltf: _Gltf, path: Path) -> None:
    """Check that nodes form trees, as glTF demands: one parent each, roots without, and no deeper than MAX_DEPTH."""
    parents: dict[int, int] = {}
    for number, node in enumerate(gltf.nodes):
        for child in node.children:
            _at(gltf.nodes, child, "node", path)
            if parents.setdefault(child, number) != number or child == number:
                raise CatalogError(f"{path}: node {child} has two parents; export it again")
    for scene in gltf.scenes or []:
        for root in scene.nodes:
            _at(gltf.nodes, root, "node", path)
            if root in parents:
                raise CatalogError(f"{path}: node {root} is a root and a child; export it again")
    for number in range(len(gltf.nodes)):
        depth, node = 0, number
        while node in parents:
            depth, node = depth + 1, parents[node]
            if depth > MAX_DEPTH:
                raise CatalogError(f"{path}: its nodes are nested deeper than {MAX_DEPTH}; export it again")


def _read_buffers(gltf: _Gltf, chunks: list[bytes], path: Path) -> list[bytes]:
    """Content of all buffers: binary chunks, embedded ones, and files in the model's folder."""
    buffers, rest, total = [], list(reversed(chunks)), 0
    for buffer in gltf.buffers:
        buffers.append(_read_uri(buffer.uri, MAX_MESH_FILE, path) if buffer.uri is not None else rest.pop() if rest else b"")
        total += len(buffers[-1])
        if total > 2 * MAX_MESH_FILE:
            raise CatalogError(f"{path}: its buffers take more than {2 * MAX_MESH_FILE} bytes; decimate the mesh")
    for view in gltf.bufferViews:
        if view.byteOffset + view.byteLength > len(_at(buffers, view.buffer, "buffer", path)):
            raise CatalogError(f"{path}: not readable as GLB (a buffer is shorter than its views); the file is cut short")
    return buffers


def _read_uri(uri: str, limit: int, path: Path) -> bytes:
    """Content of a URI: data in base64, or a relative name."""
    if not uri.startswith("data:"):
        return read_referred(path.parent, uri, path, limit)[1]
    try:
        return base64.b64decode(uri.partition("base64,")[2])
    except (binascii.Error, ValueError):
        raise CatalogError(f"{path}: data that are not base64; export it again") from None


def _move_images(gltf: _Gltf, buffers: list[bytes], table: FileTable, path: Path) -> None:
    """Decode the images that materials use, and put them into the table; the others are left out."""
    used: dict[int, _Image] = {}
    pixels = 0
    for info in _texture_infos(gltf):
        texture = _at(gltf.textures, info.index, "texture", path)
        webp = texture.extensions.get("EXT_texture_webp")
        source = webp.get("source") if isinstance(webp, dict) else texture.source
        if not isinstance(source, int) or source < 0:
            raise CatalogError(f"{path}: texture {info.index} is of a format that cannot be read; use PNG or JPEG")
        texture.source, texture.extensions = source, {}
        if source in used:
            continue
        image = _at(gltf.images, source, "image", path)
        if image.uri is not None:
            data = _read_uri(image.uri, MAX_TEXTURE_FILE, path)
        else:
            view = _at(gltf.bufferViews, len(gltf.bufferViews) if image.bufferView is None else image.bufferView, "buffer view", path)
            data = buffers[view.buffer][view.byteOffset : view.byteOffset + view.byteLength]
        pixels += decode_texture(data, f"{path}: image {source}").size // 3
        if pixels > MAX_TEXTURE_PIXELS:
            raise CatalogError(f"{path}: its textures have more than {MAX_TEXTURE_PIXELS} pixels together; scale them down")
        table.files[f"image{source}"] = data
        used[source] = _Image(uri=f"image{source}")
    for texture in gltf.textures:
        texture.extensions = {}
    gltf.images = [used.get(number, _Image()) for number in range(len(gltf.images))]


def _texture_infos(gltf: _Gltf) -> Iterator[_TextureInfo]:
    """References to textures in all materials."""
    for material in gltf.materials:
        pbr, extensions = material.pbrMetallicRoughness, material.extensions
        infos = [] if pbr is None else [pbr.baseColorTexture, pbr.metallicRoughnessTexture]
        if extensions is not None and extensions.glossiness is not None:
            infos += [extensions.glossiness.diffuseTexture, extensions.glossiness.specularGlossinessTexture]
        yield from (info for info in infos if info is not None)
