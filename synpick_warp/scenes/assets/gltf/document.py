"""glTF 2.0 documents (.glb, .gltf): container, JSON schema and buffers.

Of the JSON only what is declared here is read: geometry, nodes, base colour and metallic-roughness with their images.
"""

import base64
import binascii
import os
import re
import struct
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import unquote, unquote_to_bytes

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE, MAX_PARTS, Notes, read_referred
from synpick_warp.system.inputs.files import decode_json, read_file

_JSON, _BIN = b"JSON", b"BIN\0"
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy types of an accessor's components."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6
QUANTIZATION, TRANSFORM, WEBP = "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"
GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
TRANSMISSION, IOR, VOLUME = "KHR_materials_transmission", "KHR_materials_ior", "KHR_materials_volume"
EMISSION = "KHR_materials_emissive_strength"
CLEARCOAT, ANISOTROPY = "KHR_materials_clearcoat", "KHR_materials_anisotropy"
_IMPLEMENTED = {QUANTIZATION, TRANSFORM, WEBP, GLOSSINESS, TRANSMISSION, IOR, VOLUME, EMISSION, CLEARCOAT, ANISOTROPY}
# Required extensions that change how a surface looks, or what is beside it, but neither its shape nor its base colour: they are ignored.
_DISPENSABLE = ("KHR_materials_", "KHR_lights_", "EXT_lights_", "KHR_animation_", "KHR_xmp", "KHR_node_visibility")
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")

Index = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
_Item = TypeVar("_Item")


class Buffer(msgspec.Struct):
    """glTF buffer: bytes of a file, of a data URI, or of the binary chunk."""

    uri: str | None = None


class BufferView(msgspec.Struct):
    """glTF buffer view: a range of bytes of a buffer."""

    buffer: Index
    byteLength: Index  # noqa: N815
    byteOffset: Index = 0  # noqa: N815
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None  # noqa: N815
    extensions: dict[str, Any] = {}


class SparsePart(msgspec.Struct):
    """Indices of the elements that a sparse accessor replaces, or values with which it does."""

    bufferView: Index  # noqa: N815
    componentType: Literal[5121, 5123, 5125] = 5121  # noqa: N815
    byteOffset: Index = 0  # noqa: N815


class Sparse(msgspec.Struct):
    """Sparse part of an accessor: number, indices and values of the elements that it replaces."""

    count: Index
    indices: SparsePart
    values: SparsePart


class Accessor(msgspec.Struct):
    """glTF accessor: type, number and location of the elements of an array."""

    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]  # noqa: N815
    count: Index
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Index | None = None  # noqa: N815
    byteOffset: Index = 0  # noqa: N815
    normalized: bool = False
    sparse: Sparse | None = None


class Primitive(msgspec.Struct):
    """glTF mesh primitive: accessors of its attributes and indices, topology and material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    mode: int = TRIANGLES
    material: Index | None = None
    targets: list[Any] = []
    extensions: dict[str, Any] = {}


class Mesh(msgspec.Struct):
    """glTF mesh: list of primitives, each with a material."""

    primitives: list[Primitive]


class Node(msgspec.Struct):
    """glTF node: mesh, children and transform."""

    mesh: Index | None = None
    skin: Index | None = None
    children: list[Index] = []
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: Three = (0.0, 0.0, 0.0)
    rotation: Four = (0.0, 0.0, 0.0, 1.0)
    scale: Three = (1.0, 1.0, 1.0)


class Skin(msgspec.Struct):
    """glTF skin: nodes that are joints, and the accessor of their inverse bind matrices (None: identities)."""

    joints: list[Index]
    inverseBindMatrices: Index | None = None  # noqa: N815


class GltfScene(msgspec.Struct):
    """glTF scene: its root nodes."""

    nodes: list[Index] = []


class Image(msgspec.Struct):
    """glTF image: a file, a data URI, or a buffer view."""

    uri: str | None = None
    bufferView: Index | None = None  # noqa: N815


class Sampler(msgspec.Struct):
    """glTF sampler: wrap modes along both axes."""

    wrapS: int = 10497  # noqa: N815
    wrapT: int = 10497  # noqa: N815


class Texture(msgspec.Struct):
    """glTF texture: image, sampler and extensions."""

    source: Index | None = None
    sampler: Index | None = None
    extensions: dict[str, Any] = {}


class Transform(msgspec.Struct):
    """Offset, rotation and scale of texture coordinates (KHR_texture_transform)."""

    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    texCoord: Index | None = None  # noqa: N815


class InfoExtensions(msgspec.Struct):
    """Extensions of a texture reference that are read."""

    transform: Transform | None = msgspec.field(name=TRANSFORM, default=None)


class TextureInfo(msgspec.Struct):
    """Reference to a texture: its index, texture coordinate set and extensions."""

    index: Index
    texCoord: Index = 0  # noqa: N815
    extensions: InfoExtensions | None = None
    scale: float = 1.0
    """Of a normal map: factor on the x and y of its normals."""


class Pbr(msgspec.Struct):
    """Metallic-roughness parameters and textures of a material."""

    baseColorFactor: Four = (1.0, 1.0, 1.0, 1.0)  # noqa: N815
    metallicFactor: float = 1.0  # noqa: N815
    roughnessFactor: float = 1.0  # noqa: N815
    baseColorTexture: TextureInfo | None = None  # noqa: N815
    metallicRoughnessTexture: TextureInfo | None = None  # noqa: N815


class Glossiness(msgspec.Struct):
    """Specular-glossiness parameters and textures of a material (KHR_materials_pbrSpecularGlossiness)."""

    diffuseFactor: Four = (1.0, 1.0, 1.0, 1.0)  # noqa: N815
    specularFactor: Three = (1.0, 1.0, 1.0)  # noqa: N815
    glossinessFactor: float = 1.0  # noqa: N815
    diffuseTexture: TextureInfo | None = None  # noqa: N815
    specularGlossinessTexture: TextureInfo | None = None  # noqa: N815


class Transmission(msgspec.Struct):
    """Fraction of the light that passes a surface, and its texture (KHR_materials_transmission)."""

    transmissionFactor: float = 0.0  # noqa: N815
    transmissionTexture: TextureInfo | None = None  # noqa: N815


class Ior(msgspec.Struct):
    """Index of refraction (KHR_materials_ior)."""

    ior: float = 1.5


class Volume(msgspec.Struct):
    """Thickness of a transparent body, in the units of its mesh, and what is not used: its texture and the colour that it absorbs
    (KHR_materials_volume)."""

    thicknessFactor: float = 0.0  # noqa: N815
    thicknessTexture: Any = None  # noqa: N815
    attenuationDistance: Any = None  # noqa: N815


class EmissiveStrength(msgspec.Struct):
    """Factor on the emission (KHR_materials_emissive_strength)."""

    emissiveStrength: float = 1.0  # noqa: N815


class Clearcoat(msgspec.Struct):
    """Factor and roughness of a clear coat, and their textures (KHR_materials_clearcoat)."""

    clearcoatFactor: float = 0.0  # noqa: N815
    clearcoatTexture: TextureInfo | None = None  # noqa: N815
    clearcoatRoughnessFactor: float = 0.0  # noqa: N815
    clearcoatRoughnessTexture: TextureInfo | None = None  # noqa: N815
    clearcoatNormalTexture: Any = None  # noqa: N815


class Anisotropy(msgspec.Struct):
    """Strength and direction of anisotropy, and their texture (KHR_materials_anisotropy)."""

    anisotropyStrength: float = 0.0  # noqa: N815
    anisotropyRotation: float = 0.0  # noqa: N815
    anisotropyTexture: TextureInfo | None = None  # noqa: N815


class MaterialExtensions(msgspec.Struct):
    """Extensions of a material that are read."""

    glossiness: Glossiness | None = msgspec.field(name=GLOSSINESS, default=None)
    transmission: Transmission | None = msgspec.field(name=TRANSMISSION, default=None)
    ior: Ior | None = msgspec.field(name=IOR, default=None)
    volume: Volume | None = msgspec.field(name=VOLUME, default=None)
    strength: EmissiveStrength = msgspec.field(name=EMISSION, default_factory=EmissiveStrength)
    clearcoat: Clearcoat = msgspec.field(name=CLEARCOAT, default_factory=Clearcoat)
    anisotropy: Anisotropy = msgspec.field(name=ANISOTROPY, default_factory=Anisotropy)


class GltfMaterial(msgspec.Struct):
    """glTF material: PBR parameters, normal map, emission, extensions; occlusion is that of the geometry."""

    pbrMetallicRoughness: Pbr | None = None  # noqa: N815
    extensions: MaterialExtensions | None = None
    normalTexture: TextureInfo | None = None  # noqa: N815
    emissiveTexture: TextureInfo | None = None  # noqa: N815
    emissiveFactor: Three = (0.0, 0.0, 0.0)  # noqa: N815
    alphaMode: str = "OPAQUE"  # noqa: N815
    alphaCutoff: float = 0.5  # noqa: N815


class Gltf(msgspec.Struct):
    """Schema of a glTF document's JSON: arrays of its elements, which refer to one another by index, and the default scene."""

    extensionsUsed: list[str] = []  # noqa: N815
    extensionsRequired: list[str] = []  # noqa: N815
    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []  # noqa: N815
    accessors: list[Accessor] = []
    images: list[Image] = []
    samplers: list[Sampler] = []
    textures: list[Texture] = []
    materials: list[GltfMaterial] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    skins: list[Skin] = []
    animations: list[Any] = []
    scenes: list[GltfScene] = []
    scene: Index = 0


def read_document(path: Path, notes: Notes, data: bytes | None = None) -> tuple[Gltf, list[bytes]]:
    """Read a .glb or .gltf file, or decode `data` in its place, and the buffers that it refers to. Raises CatalogError: the file is
    damaged, exceeds a limit, refers to a file outside of its folder, or needs an unknown extension."""
    data = read_file(path, MAX_MESH_FILE, CatalogError) if data is None else data
    if data[:4] == b"glTF" or path.suffix.lower() == ".glb":
        header, chunks = _split_chunks(data, path)
    else:
        header, chunks = data.removeprefix(b"\xef\xbb\xbf"), []
    where = f"{path}: its JSON chunk" if chunks else path
    asset = decode_json(header, dict[str, msgspec.Raw], where, CatalogError).get("asset", b"")
    if re.search(rb'"version"\s*:\s*"?1', asset):
        raise CatalogError(f"{path}: it is glTF 1.0, which is not readable; export it as glTF 2.0")
    gltf = decode_json(header, Gltf, where, CatalogError)
    _check_extensions(gltf, path, notes)
    return gltf, _read_buffers(gltf, chunks, path)


def _check_extensions(gltf: Gltf, path: Path, notes: Notes) -> None:
    """Refuse a file that requires what is not implemented, and note what is ignored."""
    needed = sorted(set(gltf.extensionsRequired) - _IMPLEMENTED)
    refused = [ascii(name)[1:-1][:80] for name in needed if not name.startswith(_DISPENSABLE)]
    if refused:
        advice = "export it with textures as PNG or JPEG" if any("texture" in name for name in refused) else "export it without it"
        advice = "export it without compression" if any(name in COMPRESSED for name in refused) else advice
        raise CatalogError(f"{path}: requires the extension {', '.join(refused[:8])}, which is not implemented; {advice}")
    notes.ignored += [ascii(name)[1:-1][:80] for name in sorted(set(gltf.extensionsUsed) | set(needed)) if name not in _IMPLEMENTED]
    notes.ignored += ["animations"] if gltf.animations else []


def _split_chunks(data: bytes, path: Path) -> tuple[bytes, list[bytes]]:
    """The JSON chunk and all binary chunks; chunks of other types are ignored, as glTF demands."""
    if data[:4] == b"glTF" and data[4:8] == b"\1\0\0\0":
        raise CatalogError(f"{path}: it is glTF 1.0, which is not readable; export it as glTF 2.0")
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


def item_at(items: list[_Item], index: int, what: str, path: Path) -> _Item:
    """Item of a list, or an error that names what is missing."""
    if index >= len(items):
        raise CatalogError(f"{path}: refers to {what} {index}, but there are {len(items)}; export it again")
    return items[index]


def _read_buffers(gltf: Gltf, chunks: list[bytes], path: Path) -> list[bytes]:
    """Content of all buffers: binary chunks, embedded ones, and files in the model's folder."""
    buffers, rest, total = [], list(reversed(chunks)), 0
    for buffer in gltf.buffers:
        buffers.append(read_uri(buffer.uri, MAX_MESH_FILE, path) if buffer.uri is not None else rest.pop() if rest else b"")
        total += len(buffers[-1])
        if total > 2 * MAX_MESH_FILE:
            raise CatalogError(f"{path}: its buffers take more than {2 * MAX_MESH_FILE} bytes; decimate the mesh")
    for view in gltf.bufferViews:
        if view.byteOffset + view.byteLength > len(item_at(buffers, view.buffer, "buffer", path)):
            if compressed := sorted(set(view.extensions) & set(COMPRESSED)):
                raise CatalogError(f"{path}: {compressed[0]} without uncompressed data; export it without compression")
            raise CatalogError(f"{path}: not readable as {path.suffix[1:].upper()} (a buffer is shorter than its views); it is cut short")
    return buffers


def read_uri(uri: str, limit: int, path: Path) -> bytes:
    """Content of a URI: embedded data, or a relative name, percent-encoded or not."""
    if not uri.startswith("data:"):
        name = uri if os.path.lexists(path.parent / uri) else unquote(uri)
        return read_referred(path.parent, name, path, limit)[1]
    kind, _, content = uri.partition(",")
    try:
        return base64.b64decode(content) if kind.endswith(";base64") else unquote_to_bytes(content)
    except (binascii.Error, ValueError):
        raise CatalogError(f"{path}: data that are not base64; export it again") from None


def node_matrix(node: Node) -> np.ndarray:
    """Local transform of a node (4, 4): its matrix, or translation, rotation and scale."""
    if node.matrix is not None:
        return np.asarray(node.matrix).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(node.rotation).as_matrix() * node.scale, node.translation
    return matrix
