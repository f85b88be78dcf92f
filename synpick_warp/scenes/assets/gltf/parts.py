"""glTF import: accessors, materials and nodes of a validated document, as one part for each instance of a primitive."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PillowImage

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets import appearance
from synpick_warp.scenes.assets.alpha_masks import CLAMP, MAX_TRIANGLES, MIRROR, mask_part
from synpick_warp.scenes.assets.asset_files import MAX_PARTS, MAX_ROWS, Notes, reading_as
from synpick_warp.scenes.assets.gltf import document as schema
from synpick_warp.scenes.assets.gltf.finish import brush_coordinates, read_finish
from synpick_warp.scenes.assets.mesh_parts import MeshPart, check_indices
from synpick_warp.scenes.types import BLACK, OPAQUE, Glass
from synpick_warp.system.linear_algebra import DECIMALS, cofactors, det, dot, matmul

# Factors may exceed 0..1 by rounding.
_FACTOR_TOLERANCE = 1e-3
_DIELECTRIC = 0.04
"""Reflectance of a dielectric at normal incidence (glTF 2.0, appendix B)."""
_MAX_IOR = 3.0
"""Largest index of refraction; diamond has 2.4."""
_MAX_THICKNESS = 1e4
"""Largest thickness, as that of coordinates."""
_MAX_STRENGTH = 1e4
"""Largest factor on emission, in units of the white of a picture."""
_RIGID = 1e-6
"""Relative difference up to which the joints of a skin move alike, as they do in the pose of binding."""


def read_gltf(path: Path, notes: Notes, data: bytes | None = None) -> list[MeshPart]:
    """Read a .glb or .gltf file: one part for each primitive of each node of the default scene. `data`: content to decode in place of the
    file's. Raises CatalogError: the file or one that it refers to cannot be used."""
    document, buffers = schema.read_document(path, notes, data)
    with reading_as(path.suffix[1:].upper(), path):  # Values may be valid one by one, and not fit together.
        return _Reader(path, document, buffers, notes).parts()


class _Reader:
    """Decodes one document; materials and images are decoded once, so that parts share them."""

    def __init__(self, path: Path, gltf: schema.Gltf, buffers: list[bytes], notes: Notes) -> None:
        self.path, self.gltf, self.buffers, self.notes = path, gltf, buffers, notes
        self.images = appearance.ImageCache(self.path)
        self.files: dict[int, bytes] = {}
        self.room = MAX_TRIANGLES
        self.tiles: dict[tuple[int, bool, bool], np.ndarray] = {}
        self.mapped_textures: dict[tuple[Any, ...], np.ndarray | None] = {}
        self.materials: dict[int, tuple[appearance.FileMaterial, schema.TextureInfo | None]] = {}

    def parts(self) -> list[MeshPart]:
        """Mesh parts of the default scene, depth first; without scenes, of all nodes.

        A node's transform holds for its mesh unless it has a skin; then those of the skin's joints hold alone (glTF 2.0, section 3.7.3.3).
        """
        nodes, scenes = self.gltf.nodes, self.gltf.scenes
        children = {child for node in nodes for child in node.children}
        roots = [number for number in range(len(nodes)) if number not in children]
        drawn = self.placed(schema.item_at(scenes, self.gltf.scene, "scene", self.path).nodes if scenes else roots)
        # Joints may lie outside of the scene.
        placed = self.placed(roots) if self.gltf.skins else drawn
        parts: list[MeshPart] = []
        rows, made, filled = 0, dict[tuple[int, bool], MeshPart](), (schema.TRIANGLES, schema.STRIP, schema.FAN)
        meshes = ((number, nodes[number].mesh) for number in drawn)
        given = [(number, schema.item_at(self.gltf.meshes, mesh, "mesh", self.path)) for number, mesh in meshes if mesh is not None]
        found = [(number, each) for number, mesh in given for each in mesh.primitives if each.mode in filled]
        self.room = MAX_TRIANGLES // max(1, sum(self.stated(each).alphaMode == "MASK" for _, each in found))
        for number, each in found:
            skin = nodes[number].skin
            key = id(each), skin is None
            part = made[key] = made.get(key) or self.part(each, skin is None)
            rows += max(len(part.vertices), len(part.faces))
            if rows > MAX_ROWS or len(parts) >= MAX_PARTS:
                raise CatalogError(f"{self.path}: more than {MAX_ROWS} vertices or {MAX_PARTS} parts; decimate the mesh")
            if skin is not None:
                part = self.skinned(part, each, schema.item_at(self.gltf.skins, skin, "skin", self.path), placed)
            parts.append(part if skin is not None else _transform(part, drawn[number]))
        return parts

    def stated(self, primitive: schema.Primitive) -> schema.GltfMaterial:
        """Material of a primitive as the document has it; the default one where it has none, or none of that number."""
        index, materials = primitive.material, self.gltf.materials
        return materials[index] if index is not None and index < len(materials) else schema.GltfMaterial()

    def placed(self, roots: list[int]) -> dict[int, np.ndarray]:
        """Transforms (4, 4) of nodes and all below them to the scene, by number, depth first."""
        stack = [(root, np.eye(4)) for root in reversed(dict.fromkeys(roots))]
        placed: dict[int, np.ndarray] = {}
        while stack:
            number, parent = stack.pop()
            if number in placed:
                raise CatalogError(f"{self.path}: node {number} has two parents, or is a root and a child; export it again")
            if len(placed) == MAX_PARTS:
                raise CatalogError(f"{self.path}: more than {MAX_PARTS} nodes; merge the meshes' parts")
            node = schema.item_at(self.gltf.nodes, number, "node", self.path)
            placed[number] = matmul(parent, schema.node_matrix(node))
            stack += [(child, placed[number]) for child in reversed(dict.fromkeys(node.children))]
        return placed

    def skinned(self, part: MeshPart, primitive: schema.Primitive, skin: schema.Skin, placed: dict[int, np.ndarray]) -> MeshPart:
        """Linear blend skinning in the pose of the file: vertices by the weighted mean of the transforms of their joints."""
        count, names = len(part.vertices), primitive.attributes
        for joint in skin.joints:
            schema.item_at(self.gltf.nodes, joint, "node", self.path)
        sets = [number for number in range(len(names)) if f"JOINTS_{number}" in names and f"WEIGHTS_{number}" in names]
        if not sets:
            return part
        joints, weights = (
            np.concatenate([self.values(names[f"{name}_{number}"], name, (4,)) for number in sets], axis=1)
            for name in ("JOINTS", "WEIGHTS")
        )
        if len(joints) != count or len(weights) != count or joints.max(initial=0) >= len(skin.joints):
            raise CatalogError(f"{self.path}: a skin whose joints and weights do not fit its vertices; export it again")
        matrices = np.stack([placed[joint] for joint in skin.joints])
        if skin.inverseBindMatrices is not None:
            inverse = self.values(skin.inverseBindMatrices, "inverseBindMatrices", (16,))
            if len(inverse) < len(matrices):
                raise CatalogError(f"{self.path}: {len(inverse)} inverse bind matrices for {len(matrices)} joints; export it again")
            matrices = matmul(matrices, inverse[: len(matrices)].reshape(-1, 4, 4).transpose(0, 2, 1))
        if np.ptp(matrices, axis=0).max() <= _RIGID * np.abs(matrices).max():
            return _transform(part, matrices[0])
        total = weights.sum(axis=1)
        weights[total <= 0.0, 0] = 1.0
        blend = np.einsum("vj,vjab->vab", weights / np.where(total > 0.0, total, 1.0)[:, None], matrices[joints.astype(np.int64)])
        if part.normals is not None:
            self.notes.ignored.append("normals of a mesh that its skin bends")
        moved = np.einsum("vab,vb->va", blend[:, :3, :3], part.vertices) + blend[:, :3, 3]
        return replace(part, vertices=moved, normals=None)

    def part(self, primitive: schema.Primitive, rigid: bool) -> MeshPart:
        """Geometry and material of a primitive as a mesh part; without what its alpha mask removes, if it is `rigid`."""
        attributes = primitive.attributes
        if "POSITION" not in attributes:
            raise CatalogError(f"{self.path}: a mesh has no positions; export it again")
        vertices = self.values(attributes["POSITION"], "POSITION", (3,))
        count = len(vertices)
        corners = np.arange(count)
        if primitive.indices is not None:
            corners = self.values(primitive.indices, "indices", (1,))[:, 0].astype(np.int64)
        normals = self.attribute(attributes.get("NORMAL"), "NORMAL", (3,), count)
        colors = self.attribute(attributes.get("COLOR_0"), "COLOR_0", (3, 4), count)
        material, info = (appearance.NO_MATERIAL, None) if primitive.material is None else self.material(primitive.material)
        uv = None
        if info is not None:
            coordinates = (
                info.texCoord if info.extensions is None or info.extensions.transform is None else info.extensions.transform.texCoord
            )
            name = f"TEXCOORD_{info.texCoord if coordinates is None else coordinates}"
            uv = self.attribute(attributes.get(name), name, (2,), count)
            if uv is None and material.is_white_with_maps:
                self.notes.ignored.append("maps without texture coordinates")
                material = replace(material, texture=None)
            elif uv is None:
                raise CatalogError(f"{self.path}: has a texture, but vertices without texture coordinates; unwrap it or remove the texture")
            else:
                uv = _transform_uv(uv, info)
        if uv is None and material.finish.anisotropy > 0.0:
            uv = brush_coordinates(vertices, self.attribute(attributes.get("TEXCOORD_0"), "TEXCOORD_0", (2,), count))
        if primitive.targets:
            self.notes.ignored.append("morph targets")
        if colors is not None:
            material = replace(material, color=appearance.WHITE) if primitive.material is None else material
            colors = appearance.linear_to_srgb(colors[:, :3])
        part = MeshPart(vertices, _triangles(corners, primitive.mode), normals, uv, colors, material)
        given = self.stated(primitive)
        part = self.masked(part, given, rigid) if given.alphaMode == "MASK" else part
        if info is None or part.uv is None:
            return part
        material, uv = self.wrapped(part.material, part.uv, info)
        return replace(part, material=material, uv=uv)

    def masked(self, part: MeshPart, material: schema.GltfMaterial, rigid: bool) -> MeshPart:
        """Part without what the alpha mask of its material removes."""
        pbr, gloss = material.pbrMetallicRoughness or schema.Pbr(), material.extensions and material.extensions.glossiness
        factor, info = (gloss.diffuseFactor[3], gloss.diffuseTexture) if gloss else (pbr.baseColorFactor[3], pbr.baseColorTexture)
        if info is None or part.uv is None or self.texture(info) is None:
            return part if factor >= material.alphaCutoff else replace(part, faces=part.faces[:0])
        check_indices(part.faces, len(part.vertices), self.path)
        data, modes, threshold = self.files[self.source(info)], self.coordinates(info)[-2:], 255.0 * material.alphaCutoff
        threshold /= max(factor, _FACTOR_TOLERANCE)
        return mask_part(part, data, threshold, (modes[0], modes[1]), self.room if rigid else 0, self.notes)

    def attribute(self, index: int | None, name: str, widths: tuple[int, ...], count: int) -> np.ndarray | None:
        """Values of an attribute that may be absent, one row for each of `count` vertices."""
        if index is None:
            return None
        values = self.values(index, name, widths)
        if len(values) != count:
            raise CatalogError(f"{self.path}: {name} has {len(values)} values for {count} vertices; export it again")
        return values

    def values(self, index: int, name: str, widths: tuple[int, ...]) -> np.ndarray:
        """Decode an accessor (glTF 2.0, section 3.6.2): strided, sparse, normalized; (count, width) float64.

        Integers in colours and normals are normalized in any case, and those in texture coordinates unless KHR_mesh_quantization is used.
        """
        accessor = schema.item_at(self.gltf.accessors, index, "accessor", self.path)
        if schema.WIDTHS[accessor.type] not in widths:
            allowed = " or ".join(kind for kind, width in schema.WIDTHS.items() if width in widths and kind[:3] != "MAT")
            raise CatalogError(f"{self.path}: {name} is of type {accessor.type}; needed: {allowed}; export it again")
        values = self.raw(accessor, name)
        always = name in ("NORMAL", "COLOR_0") or (name[0] == "T" and schema.QUANTIZATION not in self.gltf.extensionsUsed)
        kind = values.dtype
        values = values.astype(np.float64)
        if kind.kind == "f" or name == "indices" or not (accessor.normalized or always):
            return values
        return np.maximum(values / np.iinfo(kind).max, -1.0)

    def raw(self, accessor: schema.Accessor, name: str) -> np.ndarray:
        """Stored numbers of an accessor (count, width), with its sparse values in their places."""
        kind, width, sparse = np.dtype(schema.COMPONENTS[accessor.componentType]), schema.WIDTHS[accessor.type], accessor.sparse
        if accessor.bufferView is None and sparse is None and accessor.count:
            used = ", ".join(sorted(set(self.gltf.extensionsUsed) & set(schema.COMPRESSED))) or "compressed geometry"
            raise CatalogError(f"{self.path}: {name} without data, as in files with {used}; export it without compression")
        if accessor.count > 3 * MAX_ROWS:  # Corners of as many triangles.
            raise CatalogError(f"{self.path}: {name} has {accessor.count} values, more than {MAX_ROWS} triangles have; decimate the mesh")
        values = np.zeros((accessor.count, width), kind)
        if accessor.bufferView is not None:
            values = self.rows(accessor.bufferView, accessor.byteOffset, accessor.count, width, kind)
        if sparse is not None:
            index_kind = np.dtype(schema.COMPONENTS[sparse.indices.componentType])
            places = self.rows(sparse.indices.bufferView, sparse.indices.byteOffset, sparse.count, 1, index_kind)
            if places.size and places.max() >= accessor.count:
                raise CatalogError(f"{self.path}: a sparse accessor refers to row {places.max()} of {accessor.count}; export it again")
            values = values.copy()
            values[places[:, 0]] = self.rows(sparse.values.bufferView, sparse.values.byteOffset, sparse.count, width, kind)
        return values

    def rows(self, view_index: int, offset: int, count: int, width: int, kind: np.dtype) -> np.ndarray:
        """Rows of a buffer view, a view of its bytes."""
        view: schema.BufferView = schema.item_at(self.gltf.bufferViews, view_index, "buffer view", self.path)
        size = kind.itemsize * width
        stride = view.byteStride or size
        if count and offset + stride * (count - 1) + size > view.byteLength:
            raise CatalogError(f"{self.path}: an accessor is longer than its buffer view; export it again")
        if not count:
            return np.zeros((0, width), kind)
        return np.ndarray((count, width), kind, self.buffers[view.buffer], view.byteOffset + offset, (stride, kind.itemsize))

    def material(self, index: int) -> tuple[appearance.FileMaterial, schema.TextureInfo | None]:
        """Material of a primitive, and the reference to its base colour texture (None: it has none)."""
        if index not in self.materials:
            material = schema.item_at(self.gltf.materials, index, "material", self.path)
            gloss = material.extensions.glossiness if material.extensions else None
            pbr = material.pbrMetallicRoughness or schema.Pbr()
            found, info = self.gloss(gloss) if gloss else self.pbr(pbr)
            finish = read_finish(material.extensions or schema.MaterialExtensions(), self.texture, self.notes, self.path)
            found = replace(found, glass=self.glass(material), emission=self.emission(material), finish=finish)
            self.materials[index] = self.mapped(found, info, material, schema.Pbr() if gloss else pbr)
        return self.materials[index]

    def mapped(
        self, material: appearance.FileMaterial, info: schema.TextureInfo | None, given: schema.GltfMaterial, pbr: schema.Pbr
    ) -> tuple[appearance.FileMaterial, schema.TextureInfo | None]:
        """Add the maps of normals, roughness and metallic, and emission that have the coordinates of the base colour `info`; without
        one, those of the first map. Returns the reference to the texture whose coordinates hold."""
        maps: dict[str, np.ndarray] = {}
        key: list[Any] = [id(material.texture), material.metallic, material.roughness]
        glow, emission = given.emissiveTexture if any(material.emission) else None, material.emission
        # A texture that cannot be used leaves no emission.
        material = replace(material, emission=BLACK) if glow else material
        textures = (("normalTexture", given.normalTexture), ("metallicRoughnessTexture", pbr.metallicRoughnessTexture))
        for name, each in (*textures, ("emissiveTexture", glow)):
            if each is None:
                continue
            if material.metallic is None or material.roughness is None:
                self.notes.ignored += [f"{name} beside a missing metallicRoughnessTexture"] if each is glow else []
                continue
            if info is not None and self.coordinates(info) != self.coordinates(each):
                self.notes.ignored.append(f"{name} with other texture coordinates")
                continue
            try:
                image = self.texture(each)
            except CatalogError:
                self.notes.ignored.append(f"{name}, which cannot be read")
                continue
            if image is None:
                continue
            info = info or each
            key += [name, id(image), each.scale, pbr.roughnessFactor, pbr.metallicFactor]
            if each is glow:
                maps["glow"], material = image, replace(material, emission=emission)
            elif each is given.normalTexture:
                maps["normal"] = appearance.encode_normals(image, each.scale)
            else:
                # glTF 2.0, section 3.9.2: green is roughness, blue is metalness.
                maps["roughness"], maps["metallic"] = (
                    np.rint(image[..., channel : channel + 1] * min(max(factor, 0.0), 1.0)).astype(np.uint8)
                    for channel, factor in ((1, pbr.roughnessFactor), (2, pbr.metallicFactor))
                )
        if not maps:
            return material, info
        if tuple(key) not in self.mapped_textures:
            try:
                self.mapped_textures[tuple(key)] = material.add_maps(**maps).texture
            except CatalogError as error:
                raise CatalogError(f"{self.path}: {error}") from None
        return replace(material, texture=self.mapped_textures[tuple(key)], has_glow="glow" in maps), info

    def coordinates(self, info: schema.TextureInfo) -> tuple[Any, ...]:
        """By what a texture's coordinates follow from a vertex: their set, transform and wrap modes."""
        texture = self.gltf.textures[info.index] if info.index < len(self.gltf.textures) else schema.Texture()
        default = texture.sampler is None or texture.sampler >= len(self.gltf.samplers)
        sampler = schema.Sampler() if default else self.gltf.samplers[texture.sampler or 0]
        transform = (info.extensions and info.extensions.transform) or schema.Transform()
        coordinates = info.texCoord if transform.texCoord is None else transform.texCoord
        return coordinates, transform.offset, transform.rotation, transform.scale, sampler.wrapS, sampler.wrapT

    def emission(self, material: schema.GltfMaterial) -> tuple[float, float, float]:
        """Emission of a material, but for its texture: emissiveFactor times KHR_materials_emissive_strength."""
        strength = (material.extensions or schema.MaterialExtensions()).strength.emissiveStrength
        bounded = [("emissiveFactor", each, 1.0) for each in material.emissiveFactor]
        for name, value, high in (("emissiveStrength", strength, _MAX_STRENGTH), *bounded):
            if not -_FACTOR_TOLERANCE <= value <= high + _FACTOR_TOLERANCE:
                raise CatalogError(f"{self.path}: {name} is {value:g}; allowed: 0 to {high:.0f}; correct the material")
        red, green, blue = (max(strength * each, 0.0) for each in material.emissiveFactor)
        return red, green, blue

    def glass(self, material: schema.GltfMaterial) -> Glass:
        """Transmission of a material: KHR_materials_transmission, else 1 - alpha in alphaMode BLEND. A transmission texture counts by its
        mean, an alpha texture is ignored."""
        extensions, alpha = material.extensions or schema.MaterialExtensions(), 1.0
        given, volume = extensions.transmission or schema.Transmission(), extensions.volume or schema.Volume()
        if material.alphaMode == "BLEND" and material.pbrMetallicRoughness:
            alpha = material.pbrMetallicRoughness.baseColorFactor[3]
        ior = (extensions.ior or schema.Ior()).ior
        for name, value, low, high in (
            ("transmissionFactor", given.transmissionFactor, -_FACTOR_TOLERANCE, 1.0 + _FACTOR_TOLERANCE),
            ("baseColorFactor's alpha", alpha, -_FACTOR_TOLERANCE, 1.0 + _FACTOR_TOLERANCE),
            ("ior", ior, 1.0, _MAX_IOR),
            ("thicknessFactor", volume.thicknessFactor, 0.0, _MAX_THICKNESS),
        ):
            if not low <= value <= high:
                raise CatalogError(f"{self.path}: {name} is {value:g}; allowed: {max(low, 0.0):g} to {high:.0f}; correct the material")
        factor = given.transmissionFactor
        if given.transmissionTexture is not None:
            self.notes.ignored.append("the texture of transmission but for its mean")
            image = self.texture(given.transmissionTexture)
            factor *= 1.0 if image is None else float(image[..., 0].mean() / 255.0)
        transmission = float(np.clip(1.0 - (1.0 - factor) * alpha, 0.0, 1.0))
        if transmission == 0.0:
            unused = (schema.IOR, extensions.ior), (schema.VOLUME, extensions.volume)
            self.notes.ignored += [name for name, extension in unused if extension is not None]
        elif volume.thicknessTexture is not None or volume.attenuationDistance is not None:
            self.notes.ignored.append("absorption, or the texture of thickness")
        if material.alphaMode == "BLEND" and alpha == 1.0:
            self.notes.ignored.append("transparency")
        return Glass(transmission, ior, volume.thicknessFactor) if transmission > 0.0 else OPAQUE

    def pbr(self, pbr: schema.Pbr) -> tuple[appearance.FileMaterial, schema.TextureInfo | None]:
        """Convert a metallic-roughness material: (material, base colour texture); of the metallic-roughness texture, the mean."""
        for name, value in (("metallicFactor", pbr.metallicFactor), ("roughnessFactor", pbr.roughnessFactor)):
            if not -_FACTOR_TOLERANCE <= value <= 1.0 + _FACTOR_TOLERANCE:
                raise CatalogError(f"{self.path}: {name} is {value:g}; allowed: 0 to 1; correct the material")
        metallic, roughness = pbr.metallicFactor, pbr.roughnessFactor
        if pbr.metallicRoughnessTexture is not None:
            # The mean stands for the map where that cannot be used, see `mapped`.
            image = self.texture(pbr.metallicRoughnessTexture)
            mean = np.zeros(3) if image is None else image.reshape(-1, 3).mean(axis=0) / 255.0
            metallic, roughness = metallic * float(mean[2]), roughness * float(mean[1])
            if image is None:
                metallic = roughness = None
        return self.base(pbr.baseColorFactor[:3], pbr.baseColorTexture, metallic, roughness, "baseColorFactor")

    def gloss(self, gloss: schema.Glossiness) -> tuple[appearance.FileMaterial, schema.TextureInfo | None]:
        """Convert specular-glossiness by its means: a metal has its specular colour, all else its diffuse colour."""
        specular, alpha = np.asarray(gloss.specularFactor), 1.0
        if gloss.specularGlossinessTexture is not None:
            image = self.texture(gloss.specularGlossinessTexture)
            if image is not None:
                specular = specular * appearance.srgb_to_linear(image.reshape(-1, 3).mean(axis=0) / 255.0)
                alpha = _mean_alpha(self.files[self.source(gloss.specularGlossinessTexture)])
        roughness = float(np.clip(1.0 - gloss.glossinessFactor * alpha, 0.0, 1.0))
        diffuse = np.asarray(gloss.diffuseFactor[:3])
        image = None if gloss.diffuseTexture is None else self.texture(gloss.diffuseTexture)
        if image is not None:
            diffuse = diffuse * appearance.srgb_to_linear(image.reshape(-1, 3).mean(axis=0) / 255.0)
        # The quadratic equation of KHR_materials_pbrSpecularGlossiness, appendix "Best practices".
        bright, shiny = (float(np.sqrt(dot(color**2, np.array((0.299, 0.587, 0.114))))) for color in (diffuse, specular))
        linear = bright * (1.0 - float(specular.max())) / (1.0 - _DIELECTRIC) + shiny - 2.0 * _DIELECTRIC
        root = np.sqrt(max(linear**2 - 4.0 * _DIELECTRIC * (_DIELECTRIC - shiny), 0.0))
        metallic = 0.0 if shiny < _DIELECTRIC else float(np.clip((root - linear) / (2.0 * _DIELECTRIC), 0.0, 1.0))
        if metallic > 0.5:
            return self.base(specular, gloss.specularGlossinessTexture, metallic, roughness, schema.GLOSSINESS)
        return self.base(gloss.diffuseFactor[:3], gloss.diffuseTexture, metallic, roughness, schema.GLOSSINESS)

    def base(
        self, factor: object, info: schema.TextureInfo | None, metallic: float | None, roughness: float | None, name: str
    ) -> tuple[appearance.FileMaterial, schema.TextureInfo | None]:
        """Material of a linear base colour factor and a texture, and the reference to the texture unless its image is missing."""
        linear = np.asarray(factor, dtype=np.float64)
        if linear.min() < -_FACTOR_TOLERANCE or linear.max() > 1.0 + _FACTOR_TOLERANCE:
            self.notes.said.append(f"{name} {' '.join(f'{value:g}' for value in linear)} is cut to 0..1")
        texture, color = None if info is None else self.texture(info), appearance.as_color(appearance.linear_to_srgb(linear))
        missing = info is not None and texture is None
        return appearance.FileMaterial(
            appearance.plain_color(color) if missing else color, texture, metallic, roughness
        ), None if missing else info

    def source(self, info: schema.TextureInfo) -> int:
        """Index of the image of a texture; raises CatalogError for image formats that cannot be read."""
        texture = schema.item_at(self.gltf.textures, info.index, "texture", self.path)
        webp = texture.extensions.get(schema.WEBP)
        source = webp.get("source") if isinstance(webp, dict) else texture.source
        if not isinstance(source, int) or source < 0:
            known = f" ({', '.join(sorted(texture.extensions))[:80]})" if texture.extensions else ""
            raise CatalogError(f"{self.path}: texture {info.index} is of a format that cannot be read{ascii(known)[1:-1]}; use PNG or JPEG")
        return source

    def texture(self, info: schema.TextureInfo) -> np.ndarray | None:
        """Decode the image of a texture (H, W, 3) uint8; None: it is missing, and replaced by a colour."""
        source = self.source(info)
        if source not in self.files:
            image = schema.item_at(self.gltf.images, source, "image", self.path)
            if image.uri is not None:
                uri = image.uri
                data = self.notes.image(lambda: schema.read_uri(uri, appearance.MAX_TEXTURE_FILE, self.path))
                if data is None:
                    return None
            else:
                index = len(self.gltf.bufferViews) if image.bufferView is None else image.bufferView
                view = schema.item_at(self.gltf.bufferViews, index, "buffer view", self.path)
                data = self.buffers[view.buffer][view.byteOffset : view.byteOffset + view.byteLength]
            self.files[source] = data
        return self.images.decode(source, self.files[source], f"{self.path}: image {source}")

    def wrapped(
        self, material: appearance.FileMaterial, uv: np.ndarray, info: schema.TextureInfo
    ) -> tuple[appearance.FileMaterial, np.ndarray]:
        """Material and coordinates with a sampler's wrap modes applied where coordinates leave 0..1: mirrored repetition as an image twice
        the size that repeats, clamping as a margin around the image."""
        texture = self.gltf.textures[info.index]
        if texture.sampler is None or material.texture is None or not len(uv) or (uv.min() >= -1e-3 and uv.max() <= 1.0 + 1e-3):
            return material, uv
        sampler = schema.item_at(self.gltf.samplers, texture.sampler, "sampler", self.path)
        mirror = sampler.wrapS == MIRROR, sampler.wrapT == MIRROR
        if any(mirror):
            material, uv = self.mirrored(material, uv, (id(material.texture), *mirror))
        clamp = sampler.wrapS == CLAMP, sampler.wrapT == CLAMP
        if any(clamp):
            image, uv = appearance.clamp_texture(material.texture, uv, clamp, self.notes.ignored)
            material = replace(material, texture=image)
        return material, uv

    def mirrored(
        self, material: appearance.FileMaterial, uv: np.ndarray, key: tuple[int, bool, bool]
    ) -> tuple[appearance.FileMaterial, np.ndarray]:
        """Extend an image by its mirror image to the right, upwards, or both; `key`: its identity and the two."""
        mirror = key[1:]
        if key not in self.tiles:
            image = material.texture
            assert image is not None
            image = np.concatenate([image, image[:, ::-1]], axis=1) if mirror[0] else image
            # The upper half of the image, v in 1..2 before scaling, is the mirrored one.
            self.tiles[key] = np.concatenate([image[::-1], image], axis=0) if mirror[1] else image
        return replace(material, texture=self.tiles[key]), uv / np.where(mirror, 2.0, 1.0)


def _mean_alpha(data: bytes) -> float:
    """Mean of an image's alpha channel, 1 without one; the image has been decoded before."""
    with PillowImage.open(io.BytesIO(data)) as image:
        return float(np.asarray(image.convert("RGBA"))[..., 3].mean() / 255.0)


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Triangles (F, 3) of a list, strip or fan of corners."""
    if mode == schema.TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    first = np.arange(len(corners) - 2)
    if mode == schema.FAN:
        return np.stack([corners[1:-1], corners[2:], np.broadcast_to(corners[0], len(first))], axis=1)
    assert mode == schema.STRIP
    odd = first % 2
    return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1)


def _transform_uv(uv: np.ndarray, info: schema.TextureInfo) -> np.ndarray:
    """Texture coordinates after KHR_texture_transform, with v turned up."""
    transform = info.extensions.transform if info.extensions else None
    if transform is not None:
        cosine, sine = np.round([np.cos(transform.rotation), np.sin(transform.rotation)], DECIMALS)
        uv = matmul(uv * transform.scale, np.array([[cosine, -sine], [sine, cosine]])) + transform.offset
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)


def _transform(part: MeshPart, transform: np.ndarray) -> MeshPart:
    """Transform a part by a 4 x 4 matrix; a reflection flips the triangles' orientation."""
    vertices = matmul(part.vertices, transform[:3, :3].T) + transform[:3, 3]
    determinant = det(transform[:3, :3])
    normals = None if part.normals is None or determinant == 0.0 else matmul(part.normals, cofactors(transform[:3, :3]).T / determinant)
    faces = part.faces if determinant > 0.0 else part.faces[:, ::-1]
    glass = replace(part.material.glass, thickness=part.material.glass.thickness * float(np.cbrt(abs(determinant))))
    return replace(part, vertices=vertices, faces=faces, normals=normals, material=replace(part.material, glass=glass))
