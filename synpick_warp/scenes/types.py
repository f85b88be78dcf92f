"""Data types of a scene: meshes, materials, objects, fixtures, environment maps, cameras. Plain NumPy, in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synpick_warp.configs.calibration.lens import LensMap
from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.system.linear_algebra import dot


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangle mesh with outward orientation."""

    vertices: np.ndarray
    """(V, 3) float32 [m]."""
    faces: np.ndarray
    """Vertex indices (F, 3) int32, counter-clockwise as seen from outside."""
    normals: np.ndarray
    """Unit vertex normals (V, 3) float32."""
    uv: np.ndarray
    """Texture coordinates (V, 2) float32; v points up (the image's top edge is v = 1); zeros without a texture."""


@dataclass(frozen=True)
class Glass:
    """Transmission of a material, as in KHR_materials_transmission, KHR_materials_ior and KHR_materials_volume of glTF."""

    transmission: float = 0.0
    """Fraction of the light that enters which passes through; 0: opaque."""
    ior: float = 1.5
    """Index of refraction, by which the light that passes is bent."""
    thickness: float = 0.0
    """Way of the light inside [m]; 0: thin-walled, light is not bent."""


@dataclass(frozen=True)
class Finish:
    """Clear coat and anisotropy of a material, as in KHR_materials_clearcoat and KHR_materials_anisotropy of glTF."""

    clearcoat: float = 0.0
    """Factor on the coat, 0 (none) to 1."""
    clearcoat_roughness: float = 0.0
    """Perceptual roughness of the coat, 0 to 1."""
    anisotropy: float = 0.0
    """Strength by which highlights are stretched, 0 to 1."""
    rotation: float = 0.0
    """Direction in which they are, from growing u towards growing v [rad]."""


OPAQUE = Glass()
PLAIN = Finish()
BLACK = (0.0, 0.0, 0.0)

MAP_CENTER = 128
"""Value of a map that is 0 of a normal's x or y."""


@dataclass(frozen=True, eq=False)
class Material:
    """PBR material in the metallic-roughness model (glTF 2.0)."""

    color: tuple[float, float, float]
    """Base colour factor, sRGB in 0..1; multiplies the texture in linear light."""
    texture: np.ndarray | None
    """Base colour texture (H, W, 3) uint8, sRGB, RGB order, top row first (v = 1); None: the factor alone."""
    metallic: float
    """Metallic factor, 0..1."""
    roughness: float
    """Perceptual roughness, 0..1."""
    maps: np.ndarray | None = field(default=None, hash=False)
    """Maps of the texture's size (H, W, 4) uint8, in place of metallic and roughness: x and y of the normal along growing u and v, where
    MAP_CENTER is 0 and 1 and 255 are -1 and 1; roughness and metallic, 0 to 255. None: no maps."""
    glass: Glass = field(default=OPAQUE, hash=False)
    """Transmission."""
    opacity: np.ndarray | None = field(default=None, hash=False)
    """Part of the transmission that a texel lacks (H, W) uint8, such as a label: 0 none, 255 all. None: nowhere."""
    emission: tuple[float, float, float] = field(default=BLACK, hash=False)
    """Emitted light, linear; 1 is the white of a picture, under any environment map."""
    glow: np.ndarray | None = field(default=None, hash=False)
    """Emission texture of the texture's size (H, W, 3) uint8, sRGB, a factor on `emission`. None: it is the same everywhere."""
    finish: Finish = field(default=PLAIN, hash=False)
    """Clear coat and anisotropy."""

    @property
    def map_names(self) -> frozenset[str]:
        """Values that vary over the texture beside colour."""
        names = () if self.maps is None else ("normal", "roughness", "metallic")
        more = ("opacity", self.opacity), ("glow", self.glow)
        return frozenset((*names, *(name for name, image in more if image is not None)))

    @property
    def transmission(self) -> float:
        """Fraction of the light that passes through, at most; metals are opaque."""
        return self.glass.transmission * (1.0 - self.metallic if self.maps is None else 1.0)


class HullSize(NamedTuple):
    """Volume and diameter of the convex hull of a point set; both are 0 for coplanar points."""

    volume: float
    """[m³]"""
    diameter: float
    """Maximum distance between two points [m]."""


@dataclass(frozen=True, eq=False)
class RawObject:
    """Object as read from a file or made procedurally, before collision shape and mass properties are computed."""

    obj_id: int
    """BOP's obj_id: class of the object."""
    name: str
    mesh: TriangleMesh
    hull: HullSize
    material: Material
    mass: float | None
    """[kg]; None: by objects.density."""
    concave: bool
    """Use a convex decomposition instead of the hull as collision shape."""
    symmetries_discrete: tuple[tuple[float, ...], ...]
    """Rigid transforms under which the object looks the same: row-major 4 x 4 matrices as in BOP, but in metres."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    """(unit axis, point on it [m])."""
    source: Path | None
    """The PLY file of a BOP model folder; None: embedded, or from another format."""


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """Vertices and faces of a convex polyhedron, as part of a collision shape, in the object's frame."""

    vertices: np.ndarray
    """(V, 3) float32 [m]."""
    faces: np.ndarray
    """Vertex indices (F, 3) int32, counter-clockwise as seen from outside."""


Shape = tuple[ConvexPiece, ...]
"""Collision shape: one hull, or the pieces of a convex decomposition."""


@dataclass(frozen=True, eq=False)
class CatalogEntry:
    """Object of a catalog: that of `RawObject`, whose fields it shares, with collision shape and mass properties."""

    obj_id: int
    name: str
    mesh: TriangleMesh
    material: Material
    pieces: Shape
    volume: float
    """Volume of the collision shape [m³]; counts against arrangement.volume."""
    radius: float
    """Radius of the bounding sphere about the object's origin [m]."""
    mass: float
    """[kg]"""
    center_of_mass: np.ndarray
    """Centre of mass in the object's frame (3) float64 [m]."""
    inertia: np.ndarray
    """Inertia tensor about the centre of mass, in the object's axes (3, 3) float64 [kg·m²]."""
    diameter: float
    """Largest distance between two vertices [m]."""
    symmetries_discrete: tuple[tuple[float, ...], ...]
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    source: Path | None
    suctionable: tuple[float, float] | None = field(default=None, hash=False)
    """Area on which a suction cup seals [m²], and its fraction of the surface; None: not measured."""


@dataclass(frozen=True, eq=False)
class Prop:
    """Part of the cell that is neither bin, gripper nor object, and has no label."""

    name: str
    fixture: "Fixture"
    pose: tuple[float, ...]
    """x, y, z [m] and quaternion x, y, z, w: to the world, or to the frame of the gripper's shaft."""
    follows: bool
    pieces: Shape = ()
    """Collision shapes in its own frame."""


FIRST_DISTRACTOR = -2
"""obj_id of the first distractor; others count down. Where there is no object at all it is -1."""


@dataclass(frozen=True, eq=False)
class Catalog:
    """Objects of a data set, ordered by obj_id, and objects without labels. A catalog index is an index into `bodies`."""

    entries: tuple[CatalogEntry, ...]
    distractors: tuple[CatalogEntry, ...] = field(default=(), hash=False)
    """Objects without labels; their obj_ids are -2, -3 and so on."""
    props: tuple[Prop, ...] = field(default=(), hash=False)
    """What stands around them."""

    @property
    def bodies(self) -> tuple[CatalogEntry, ...]:
        """All objects: those with labels, then the distractors."""
        return self.entries + self.distractors

    @property
    def object_ids(self) -> np.ndarray:
        """obj_id of all bodies, then of props as if they were distractors (body) int32."""
        return np.array([body.obj_id for body in self.bodies] + [FIRST_DISTRACTOR] * len(self.props), np.int32)

    def __len__(self) -> int:
        return len(self.entries)


@dataclass(frozen=True)
class Interior:
    """Empty convex interior of a mesh, in its own frame: no triangle reaches into it, and it is open at the top.

    floor <= z <= top, |x| <= half[0] + z growth[0], |y| <= half[1] + z growth[1], |x| + |y| <= half[2] + z growth[2].
    """

    half: tuple[float, float, float]
    """[m]"""
    growth: tuple[float, float, float]
    """[m/m]"""
    floor: float
    """Least z [m]."""
    top: float
    """No vertex of the mesh is higher [m]."""


@dataclass(frozen=True, eq=False)
class Fixture:
    """Mesh and material of a visible part of the scene that is not an object: tote, gripper shaft, suction cup."""

    mesh: TriangleMesh
    material: Material
    interior: Interior | None = None
    """Empty interior of the fixture, if it is a container."""


@dataclass(frozen=True, eq=False)
class Sun:
    """Directional light that an sIBL set names: unit direction towards the sun in the map's frame, and RGB irradiance."""

    direction: np.ndarray
    """Unit direction (3) float64 towards the sun, in the map's frame."""
    irradiance: np.ndarray
    """Irradiance on a surface that faces the sun: linear RGB (3) float64, in the map's units; not black."""


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """HDR environment map, equirectangular: row 0 looks up (+z); azimuth atan2(y, x) is at u = azimuth / 2π + 0.5 of the width."""

    name: str
    radiance: np.ndarray
    """Radiance, linear RGB (H, 2H, 3) float32, finite, not negative."""
    sun: Sun | None = None
    """Replaces the map's bright place at its direction, which cameras clip."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera: image size, intrinsic matrix K, world-to-camera rotation and translation [m]. OpenCV's axes (x right, y down, z
    forward); the centre of pixel (row, column) is (column + 0.5, row + 0.5)."""

    width: int
    height: int
    matrix: np.ndarray
    """Intrinsic matrix K (3, 3) float64 [px]."""
    rotation: np.ndarray
    """World-to-camera rotation (3, 3) float64."""
    translation: np.ndarray
    """World-to-camera translation (3) float64 [m]."""
    name: str = ""
    lens: LensMap | None = None
    """Distortion of the lens; None: a pinhole."""
    fixed_to: str = WORLD
    """What carries the camera; rotation and translation lead from its frame, in place of the world's."""
    shutter: tuple[float, float] = (0.0, 0.0)
    """Exposure and readout time [s]."""

    @classmethod
    def at(cls, matrix: Sequence[Sequence[float]] | np.ndarray, resolution: tuple[int, int], pose: Any) -> "Camera":
        """Pinhole camera of an intrinsic matrix (3, 3) [px], with width and height [px], by its pose in the world (4, 4) [m]."""
        pose = np.asarray(pose, float).reshape(4, 4)
        rotation = pose[:3, :3].T
        return cls(*resolution, np.asarray(matrix, float).reshape(3, 3), rotation, -dot(rotation, pose[:3, 3]))

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.width, self.height

    @property
    def center(self) -> np.ndarray:
        """Optical centre (3) in the frame that the camera is fixed to [m]."""
        return -dot(self.rotation.T, self.translation)

    @property
    def distortion(self) -> dict[str, Any]:
        """Model and OpenCV's coefficients of the lens, as keys of BOP's files; none of a pinhole."""
        return {} if self.lens is None else {"cam_dist_model": self.lens.lens.model, "cam_dist": list(self.lens.lens.coefficients)}

    @property
    def sensor(self) -> dict[str, Any]:
        """`distortion`, and exposure and readout time if it has either, as keys of BOP's files."""
        return self.distortion | (dict(zip(("exposure_time", "readout_time"), self.shutter, strict=True)) if any(self.shutter) else {})
