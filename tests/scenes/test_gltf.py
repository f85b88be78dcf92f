"""glTF import: accessors, materials, texture coordinates, nodes, containers, and extensions that are not implemented."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.assets.meshes import MeshOptions
from synpick_warp.scenes.types import MAP_CENTER, OPAQUE, Glass
from tests.worlds.model_files import pack_glb, read_told, texels

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint16)
UV = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
COLORS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [200, 100, 50]]], np.uint8)
"""Texels of the image of a `Builder`."""
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Builder:
    """A glTF document of one tetrahedron, and its binary chunk."""

    def __init__(self, **material: Any) -> None:
        self.binary = b""
        self.content: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.content |= {"bufferViews": [], "accessors": []}
        self.primitive: dict[str, Any] = {"attributes": {}, "indices": self.add(FACES.reshape(-1, 1))}
        self.content["meshes"] = [{"primitives": [self.primitive]}]
        self.attribute("POSITION", CORNERS)
        if material:
            self.content["materials"] = [material]
            self.primitive["material"] = 0

    def view(self, data: bytes, **more: Any) -> int:
        self.content["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more})
        self.binary += data + bytes(-len(data) % 4)
        return len(self.content["bufferViews"]) - 1

    def add(self, rows: np.ndarray, *, stride: int = 0, **more: Any) -> int:
        """Add an accessor, each row in `stride` bytes."""
        data = rows.tobytes()
        if stride:
            data = b"".join(row.tobytes().ljust(stride, b"\xaa") for row in rows)
            more["bufferView"] = self.view(data, byteStride=stride)
        kind = {"componentType": KINDS[rows.dtype.str[1:]], "count": len(rows), "type": SHAPES[rows.shape[1]]}
        self.content["accessors"].append(kind | ({} if "bufferView" in more else {"bufferView": self.view(data)}) | more)
        return len(self.content["accessors"]) - 1

    def attribute(self, name: str, rows: np.ndarray, **more: Any) -> Builder:
        self.primitive["attributes"][name] = self.add(rows, **more)
        return self

    def with_(self, **content: Any) -> Builder:
        """Replace parts of the document."""
        self.content |= content
        return self

    def require(self, extension: str) -> Builder:
        return self.with_(extensionsUsed=[extension], extensionsRequired=[extension])

    def wrap(self, s: int, t: int) -> Builder:
        """Modes by which the texture repeats."""
        self.content["textures"][0]["sampler"] = 0
        return self.with_(samplers=[{"wrapS": s, "wrapT": t}])

    def image(self) -> Builder:
        """A texture of four colours."""
        file = io.BytesIO()
        Image.fromarray(COLORS).save(file, "png")
        return self.with_(images=[{"bufferView": self.view(file.getvalue()), "mimeType": "image/png"}], textures=[{"source": 0}])

    def beside(self, material: dict[str, Any], *scales: float) -> Builder:
        """Add a second part of this material. `scales`: of both parts; none: 1."""
        self.content["meshes"].append({"primitives": [{**self.primitive, "material": 1}]})
        self.content["materials"].append(material)
        nodes = [{"mesh": part, "scale": [scale] * 3} for part, scale in enumerate(scales or (1, 1))]
        return self.with_(nodes=nodes, scenes=[{"nodes": [0, 1]}])

    def glb(self) -> bytes:
        text = json.dumps(self.content | {"buffers": [{"byteLength": len(self.binary)}]}).encode()
        return pack_glb(text + b" " * (-len(text) % 4), self.binary)

    def read(self, folder: Path, **options: bool) -> tuple[Any, Any, list[str]]:
        return read_told(folder / "a.glb", self.glb(), MeshOptions(**options))


def pbr(**more: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": more}


TEXTURE = {"baseColorTexture": {"index": 0}}


def at_corners(mesh: Any, values: np.ndarray) -> np.ndarray:
    """Values (V, N) of the first vertex at each corner of the tetrahedron."""
    return np.stack([values[np.flatnonzero(np.abs(mesh.vertices - corner).max(axis=1) < 1e-4)[0]] for corner in CORNERS])


def flipped(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates whose v runs up, as meshes have them."""
    return np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])


# ---- colours ----

LINEAR = np.array([60000, 20000, 3000]) / 65535


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("material", [{}, pbr(baseColorFactor=[0.5, 0.25, 1.0, 1.0])])
def test_vertex_colours_are_linear_and_multiply_the_factor(tmp_path, kind, alpha, material):
    largest = 1.0 if kind == "f4" else np.iinfo(kind).max
    rows = np.tile([*LINEAR, *((1.0,) if alpha else ())], (4, 1)) * largest
    rows = (rows if kind == "f4" else np.rint(rows)).astype(kind)
    # Rows of an attribute begin at multiples of four bytes.
    stride = -(-rows.shape[1] * rows.itemsize // 4) * 4
    _, finish, _ = Builder(**material).attribute("COLOR_0", rows, stride=stride, normalized=kind != "f4").read(tmp_path)
    expected = linear_to_srgb(LINEAR * ((0.5, 0.25, 1.0) if material else 1.0))
    assert finish.texture is None
    assert finish.color == pytest.approx(expected, abs=0.004 if kind != "u1" else 0.02)


def test_vertex_colours_multiply_the_texture(tmp_path):
    colors = np.array([[1, 1, 1], [0.5, 0.5, 0.5], [1, 0, 1], [0.2, 0.4, 0.6]], np.float32)
    builder = Builder(**pbr(**TEXTURE)).image().attribute("COLOR_0", colors)
    # In the middles of the four texels.
    mesh, finish, _ = builder.attribute("TEXCOORD_0", 0.25 + 0.5 * UV).read(tmp_path)
    skin = srgb_to_linear(COLORS.reshape(4, 3) / 255)
    assert np.abs(at_corners(mesh, texels(mesh, finish.texture)) - 255 * linear_to_srgb(skin * colors)).max() <= 1.0
    assert finish.color == (1.0, 1.0, 1.0)


def test_a_factor_beyond_one_is_cut_and_told(tmp_path):
    _, finish, said = Builder(**pbr(baseColorFactor=[1.5, 0.5, 0.5, 1.0])).read(tmp_path)
    assert finish.color == pytest.approx(linear_to_srgb([1.0, 0.5, 0.5]))
    assert said == ["baseColorFactor 1.5 0.5 0.5 is cut to 0..1"]


# ---- texture coordinates ----


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("coordinates", [0, 1])
def test_texture_coordinates_of_any_type_and_set(tmp_path, kind, coordinates):
    rows = UV if kind == "f4" else (UV * np.iinfo(kind).max).astype(kind)
    builder = Builder(**pbr(baseColorTexture={"index": 0, "texCoord": coordinates})).image()
    builder.attribute("TEXCOORD_0", np.full((4, 2), 0.3, np.float32))
    mesh, _, _ = builder.attribute(f"TEXCOORD_{coordinates}", rows, stride=4 if kind == "u1" else 0, normalized=kind != "f4").read(tmp_path)
    assert at_corners(mesh, mesh.uv) == pytest.approx(flipped(UV), abs=1e-6)


def test_a_texture_needs_coordinates(tmp_path):
    with pytest.raises(CatalogError, match=rf"^{tmp_path}/a\.glb: .*without texture coordinates; unwrap it"):
        Builder(**pbr(**TEXTURE)).image().read(tmp_path)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({"scale": [0.25, 0.5]}, UV * (0.25, 0.5)),
        ({"offset": [0.25, 0.5]}, np.add(UV, (0.25, 0.5))),
        # By 90 degrees, u runs up the image, against v.
        ({"rotation": np.pi / 2}, np.column_stack([UV[:, 1], -UV[:, 0]])),
        ({"rotation": np.pi / 2, "scale": [2, 3], "offset": [0.5, 0]}, np.column_stack([3 * UV[:, 1] + 0.5, -2 * UV[:, 0]])),
        ({"texCoord": 1}, 0.5 * UV),
    ],
)
def test_texture_transforms(tmp_path, transform, expected):
    info = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    builder = Builder(**pbr(baseColorTexture=info)).image().attribute("TEXCOORD_0", UV).attribute("TEXCOORD_1", 0.5 * UV)
    mesh, _, said = builder.require("KHR_texture_transform").read(tmp_path)
    assert at_corners(mesh, mesh.uv) == pytest.approx(flipped(expected), abs=1e-6)
    assert not said


def test_a_mirrored_texture_repeats_mirrored(tmp_path):
    mesh, finish, _ = Builder(**pbr(**TEXTURE)).image().attribute("TEXCOORD_0", 2.0 * UV).wrap(33648, 33648).read(tmp_path)
    assert at_corners(mesh, mesh.uv) == pytest.approx(np.column_stack([UV[:, 0], 0.5 - UV[:, 1]]))
    rows = np.array([[255, 0], [0, 200]])
    mirrored = np.block([[rows[::-1], rows[::-1, ::-1]], [rows, rows[:, ::-1]]])
    assert np.array_equal(finish.texture[..., 0], mirrored)


@pytest.mark.parametrize("wrap", [(33071, 33071), (33071, 10497), (10497, 33071), (33071, 33648)])
def test_a_clamped_texture_has_its_border_beyond(tmp_path, wrap):
    mesh, finish, said = Builder(**pbr(**TEXTURE)).image().attribute("TEXCOORD_0", 3.0 * UV - 1.25).wrap(*wrap).read(tmp_path)
    assert not said
    height, width = finish.texture.shape[:2]
    uv = at_corners(mesh, mesh.uv)
    texel = finish.texture[np.floor((1.0 - uv[:, 1]) * height).astype(int) % height, np.floor(uv[:, 0] * width).astype(int) % width]
    # In glTF v runs down. -1.25 and 1.75 are clamped to 0 and 1, repeat at 0.75, and mirrored lie at 0.75 and 0.25.
    index = [{33071: (0, 1), 10497: (1, 1), 33648: (1, 0)}[mode] for mode in wrap]
    assert texel.tolist() == [COLORS[index[1][int(v)], index[0][int(u)]].tolist() for u, v in UV]


def test_an_image_that_is_missing_is_replaced_by_a_colour(tmp_path):
    for factor, color in (([1, 1, 1, 1], (0.7,) * 3), ([1, 0, 0, 1], (1.0, 0.0, 0.0))):
        builder = Builder(**pbr(baseColorFactor=factor, metallicRoughnessTexture={"index": 0}, **TEXTURE))
        builder.with_(images=[{"uri": "gone.png"}], textures=[{"source": 0}])
        with pytest.raises(CatalogError, match=r"refers to 'gone\.png'"):
            builder.read(tmp_path)
        _, finish, said = builder.read(tmp_path, substitute=True)
        assert said == ["the image 'gone.png' is missing, a plain colour is used"]
        assert (finish.texture, finish.metallic, finish.roughness) == (None, None, None)
        assert finish.color == pytest.approx(color)


# ---- geometry ----


@pytest.mark.parametrize(("kind", "normalized"), [("i2", True), ("i1", True), ("u2", True), ("i2", False), ("u1", False)])
def test_quantized_positions_and_normals(tmp_path, kind, normalized):
    largest = np.iinfo(kind).max if normalized else 100
    builder = Builder().require("KHR_mesh_quantization").with_(nodes=[{"mesh": 0, "scale": [0.1] * 3 if normalized else [0.001] * 3}])
    builder.attribute("POSITION", (CORNERS * largest).astype(kind), stride=8 if "2" in kind else 4, normalized=normalized)
    normals = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1]])
    mesh, _, said = builder.attribute("NORMAL", (127 * normals).astype("i1"), stride=4, normalized=True).read(tmp_path)
    assert mesh.vertices == pytest.approx(0.1 * CORNERS, abs=1e-6)
    assert mesh.normals == pytest.approx(normals)
    assert not said


def test_sparse_values_replace_others_or_zeros(tmp_path):
    for base in (True, False):
        builder = Builder()
        sparse = {"count": 2, "indices": {"bufferView": builder.view(np.array([1, 3], "u1").tobytes()), "componentType": 5121}}
        sparse["values"] = {"bufferView": builder.view(np.array([[5, 0, 0], [0, 0, 7]], "f4").tobytes())}
        accessor = builder.content["accessors"][builder.primitive["attributes"]["POSITION"]]
        accessor["sparse"] = sparse
        if not base:
            del accessor["bufferView"]
            builder.primitive["indices"] = builder.add(np.array([[0], [1], [3]], "u1"))
        mesh, _, _ = builder.read(tmp_path)
        assert mesh.vertices.max(axis=0) == pytest.approx((5, 1 if base else 0, 7))


@pytest.mark.parametrize(("mode", "corners"), [(4, [0, 1, 2, 2, 1, 3]), (5, [0, 1, 2, 3]), (6, [1, 3, 2, 0])])
def test_lists_strips_and_fans_of_triangles(tmp_path, mode, corners):
    builder = Builder()
    builder.primitive |= {"mode": mode, "indices": builder.add(np.array(corners, "u1")[:, None])}
    mesh, _, _ = builder.read(tmp_path)
    faces = [[int(np.argwhere((mesh.vertices[index] == CORNERS).all(axis=1))[0, 0]) for index in face] for face in mesh.faces]
    assert {tuple(sorted(face)) for face in faces} == {(0, 1, 2), (1, 2, 3)}
    # Neighbours that face the same side run along their common edge in opposite directions.
    edges = [(face[corner], face[corner - 1]) for face in faces for corner in range(3)]
    assert len(set(edges)) == len(edges)


def test_transforms_of_nodes_are_chained(tmp_path):
    moved = {"children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]}
    turned = {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}
    mesh, _, _ = Builder().with_(nodes=[moved, turned, {"mesh": 0, "name": "not in the scene"}]).read(tmp_path)
    expected = np.column_stack([-CORNERS[:, 1], CORNERS[:, 0], CORNERS[:, 2]])
    assert mesh.vertices[:4] == pytest.approx(2 * expected + (1, 2, 3), abs=1e-6)


BOUND = np.array([[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
"""Transform of a joint in the pose of binding."""
BEND = np.array([[2, 0], [2, 0], [1, 1], [0, 3]], np.float32)
"""Weights of two joints that are not normalized."""


@pytest.mark.parametrize(
    ("joints", "inverse", "weights", "expected"),
    [
        ([{}], None, None, CORNERS),
        ([{}], None, np.zeros((4, 1), np.float32), CORNERS),
        # In the pose of binding, beside a joint that is not used.
        ([{"translation": [1, 2, 3], "scale": [2, 2, 2]}] * 2, BOUND, np.ones((4, 1), np.float32), CORNERS),
        ([{"scale": [3, 3, 3]}], None, np.ones((4, 1), np.float32), 3 * CORNERS),
        ([{}, {"translation": [2, 0, 0]}], None, BEND, CORNERS + np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]])),
    ],
    ids=["no joints", "no weights", "bound", "scaled", "bent"],
)
def test_joints_move_a_mesh_with_a_skin_and_its_node_does_not(tmp_path, joints, inverse, weights, expected):
    """glTF 2.0, section 3.7.3.3."""
    builder = Builder()
    skin: dict[str, Any] = {"joints": [2 + index for index in range(len(joints))]}
    if inverse is not None:
        skin["inverseBindMatrices"] = builder.add(np.tile(np.linalg.inv(inverse).T.reshape(16), (len(joints), 1)).astype(np.float32))
    if weights is not None:
        used = weights.shape[1]
        builder.attribute("JOINTS_0", np.tile(np.r_[np.arange(used), np.zeros(4 - used)], (4, 1)).astype(np.uint8))
        builder.attribute("WEIGHTS_0", np.pad(weights, ((0, 0), (0, 4 - used))))
    # A parent of the mesh, the mesh, and joints outside of the scene.
    builder.with_(nodes=[{"children": [1], "scale": [7, 7, 7]}, {"mesh": 0, "skin": 0, "translation": [0, 9, 0]}, *joints], skins=[skin])
    mesh, _, said = builder.read(tmp_path)
    assert np.unique(mesh.vertices.round(4), axis=0) == pytest.approx(np.unique(expected, axis=0), abs=1e-4)
    assert not said


def test_parts_have_one_order(tmp_path):
    builder = Builder()
    parts = [builder.primitive["attributes"]["POSITION"], *(builder.add(CORNERS * 0.1 + part) for part in range(1, 6))]
    builder.content["meshes"] = [{"primitives": [{"attributes": {"POSITION": part}, "indices": 0} for part in parts]}]
    assert len({builder.read(tmp_path)[0].vertices.tobytes() for _ in range(8)}) == 1


# ---- containers and extensions ----


@pytest.mark.parametrize("uri", ["the buffer.bin", "the%20buffer.bin", ""])
def test_gltf_files_with_buffers_outside_and_inside(tmp_path, uri):
    builder = Builder(**pbr(**TEXTURE)).image().attribute("TEXCOORD_0", UV)
    (tmp_path / "the buffer.bin").write_bytes(builder.binary)
    where = uri or "data:application/octet-stream;base64," + base64.b64encode(builder.binary).decode()
    text = json.dumps(builder.content | {"buffers": [{"byteLength": len(builder.binary), "uri": where}]})
    mesh, finish, _ = read_told(tmp_path / "a.gltf", text.encode("utf-8" if uri else "utf-8-sig"))
    expected, skin, _ = builder.read(tmp_path)
    assert np.array_equal(mesh.vertices, expected.vertices)
    assert finish.texture is not None
    assert np.array_equal(finish.texture, skin.texture)


@pytest.mark.parametrize(
    ("extension", "advice"),
    [
        ("KHR_draco_mesh_compression", "export it without compression"),
        ("EXT_meshopt_compression", "export it without compression"),
        ("KHR_texture_basisu", "textures as PNG or JPEG"),
        ("VENDOR_thing", "export it without it"),
    ],
)
def test_required_extensions_that_are_not_implemented_are_named(tmp_path, extension, advice):
    with pytest.raises(CatalogError, match=rf"requires the extension {extension}, which is not implemented; .*{advice}"):
        Builder().require(extension).read(tmp_path)


def test_what_is_ignored_is_one_line(tmp_path):
    builder = Builder(occlusionTexture={"index": 0}, alphaMode="BLEND").require("KHR_materials_sheen")
    _, finish, said = builder.with_(animations=[{}]).read(tmp_path)
    assert said == ["ignored: KHR_materials_sheen, animations, transparency"]
    assert (finish.metallic, finish.roughness) == (1.0, 1.0)


def glass(alpha: float = 1.0, mode: str = "OPAQUE", **extensions: Any) -> Builder:
    named = {f"KHR_materials_{name}": value for name, value in extensions.items()}
    return Builder(**pbr(baseColorFactor=[1, 1, 1, alpha], metallicFactor=0), alphaMode=mode, extensions=named)


def test_transmission_is_that_of_extensions_and_of_blending(tmp_path):
    """A thickness is a length of the mesh: it is scaled with its node."""
    builder = glass(transmission={"transmissionFactor": 0.75}, ior={"ior": 1.4}, volume={"thicknessFactor": 0.01})
    builder.with_(nodes=[{"mesh": 0, "scale": [2, 2, 2]}], extensionsUsed=["KHR_materials_transmission", "KHR_materials_ior"])
    _, finish, said = builder.read(tmp_path)
    assert (finish.glass.transmission, finish.glass.ior, finish.glass.thickness) == pytest.approx((0.75, 1.4, 0.02))
    assert not said
    assert glass(0.25, "BLEND").read(tmp_path)[1].glass == Glass(0.75)
    assert glass(0.25).read(tmp_path)[1].glass == OPAQUE
    assert glass(0.5, "BLEND", transmission={"transmissionFactor": 0.5}).read(tmp_path)[1].glass == Glass(0.75)


def test_what_transmission_leaves_out_is_said(tmp_path):
    textured = {"transmissionFactor": 1.0, "transmissionTexture": {"index": 0}}
    _, finish, said = glass(transmission=textured, volume={"thicknessTexture": {"index": 0}}).image().read(tmp_path)
    assert finish.glass.transmission == pytest.approx(COLORS[..., 0].mean() / 255)
    assert said == ["ignored: the texture of transmission but for its mean, absorption, or the texture of thickness"]
    assert glass(ior={"ior": 1.3}).read(tmp_path)[2] == ["ignored: KHR_materials_ior"]
    assert glass(1.0, "BLEND").read(tmp_path)[2] == ["ignored: transparency"]


def test_parts_keep_their_transmission(tmp_path):
    """An opaque part, such as a label, has the opacity that the clearest one lacks; it may be a metal beside glass."""
    mesh, finish, said = glass(0.5, "BLEND", transmission={"transmissionFactor": 0.5}).beside({}).read(tmp_path)
    assert not said
    made = finish.complete(0.0, 0.5)
    assert (made.glass.transmission, made.transmission) == (0.75, 0.75)
    assert made.texture.shape[2] == 3
    assert set(np.unique(made.opacity)) == {0, 255}
    assert np.bincount(texels(mesh, made.opacity) // 255).tolist() == [len(mesh.uv) // 2] * 2


@pytest.mark.parametrize(
    ("builder", "said"),
    [
        (glass(transmission={"transmissionFactor": 1.5}), "transmissionFactor is 1.5; allowed: 0 to 1; correct the material"),
        (glass(-0.5, "BLEND"), "baseColorFactor's alpha is -0.5; allowed: 0 to 1; correct"),
        (glass(ior={"ior": 0.5}), "ior is 0.5; allowed: 1 to 3; correct"),
        (glass(volume={"thicknessFactor": -1}), "thicknessFactor is -1; allowed: 0 to 10000; correct"),
        (glass(ior={"ior": float("nan")}), "JSON is malformed"),
    ],
)
def test_transmission_that_cannot_be_is_refused(tmp_path, builder, said):
    with pytest.raises(CatalogError, match=said):
        builder.read(tmp_path)


def test_normal_and_roughness_maps_are_read_beside_the_base_colour(tmp_path):
    """Of COLORS: red's x is 1 and its other components are not, so that it is steep; green is roughness, blue metallic."""
    both = {"metallicRoughnessTexture": {"index": 0}, "metallicFactor": 0.5}
    builder = Builder(**pbr(**both), normalTexture={"index": 0, "scale": 0.5}).image().attribute("TEXCOORD_0", UV)
    _, finish, said = builder.read(tmp_path)
    assert not said
    assert finish.texture.shape == (4, 4, 7)
    for row, column in ((0, 0), (1, 1)):
        # The corners keep their colours as the image is enlarged to the least size.
        texel, color = finish.texture[-row, -column].astype(float), COLORS[row, column].astype(float)
        normal = (color / 127.5 - 1.0) * (0.5, 0.5, 1.0)
        normal[2] = max(normal[2], 1e-6)
        assert np.allclose(texel[3:5], MAP_CENTER + 127 * normal[:2] / np.linalg.norm(normal), atol=1.0)
        assert np.allclose(texel[5:], (color[1], color[2] / 2), atol=1.0)
    # Equal by the standard: a transform that changes nothing.
    same = {"index": 0, "extensions": {"KHR_texture_transform": {}}}
    _, finish, said = Builder(**pbr(**TEXTURE), normalTexture=same).image().attribute("TEXCOORD_0", UV).read(tmp_path)
    assert (said, finish.texture.shape) == ([], (4, 4, 7))
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}
    _, finish, said = Builder(**pbr(**TEXTURE), normalTexture=moved).image().attribute("TEXCOORD_0", UV).read(tmp_path)
    assert said == ["ignored: normalTexture with other texture coordinates"]
    assert finish.texture.shape == (2, 2, 3)


@pytest.mark.parametrize(
    ("material", "named"),
    [
        ({"normalTexture": {"index": 5}}, "normalTexture, which cannot be read"),
        ({"normalTexture": {"index": 0}}, "maps without texture coordinates"),
    ],
)
def test_maps_that_cannot_be_used_are_left_out_with_a_line(tmp_path, material, named):
    _, finish, said = Builder(**pbr(roughnessFactor=0.3), **material).image().read(tmp_path)
    assert (said, finish.texture, finish.roughness) == ([f"ignored: {named}"], None, 0.3)


def test_images_that_are_large_only_together_are_one_line(tmp_path):
    builder = Builder(**pbr(baseColorTexture={"index": 0}), normalTexture={"index": 1}).attribute("TEXCOORD_0", UV)
    images = []
    for size in ((9000, 1), (1, 9000)):
        file = io.BytesIO()
        Image.new("RGB", size).save(file, "png")
        images.append({"bufferView": builder.view(file.getvalue()), "mimeType": "image/png"})
    builder.with_(images=images, textures=[{"source": 0}, {"source": 1}])
    with pytest.raises(CatalogError, match=r"a texture with maps of 9000 x 9000 pixels"):
        builder.read(tmp_path)


SKINNED = {"nodes": [{"mesh": 0, "skin": 0}]}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"asset": {"version": "1.0"}, "accessors": {}}, "glTF 1.0"),
        ({"scene": 7}, "refers to scene 7"),
        ({"nodes": [{"mesh": 0, "rotation": [0, 0, 0, 0]}]}, "not readable as GLB"),
        (SKINNED | {"skins": [{"joints": [5]}]}, "refers to node 5"),
        (SKINNED, "refers to skin 0"),
        (SKINNED | {"skins": [{"joints": [0]}]}, "a skin whose joints and weights do not fit"),
    ],
)
def test_documents_that_cannot_be_read_are_one_line(tmp_path, change, said):
    builder = Builder().attribute("JOINTS_0", np.full((4, 4), 3, np.uint8)).attribute("WEIGHTS_0", np.ones((4, 4), np.float32))
    with pytest.raises(CatalogError, match=said):
        builder.with_(**change).read(tmp_path)
