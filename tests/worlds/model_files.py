"""Model files made by hand: a tetrahedron as PLY and OBJ, pictures, and any mesh."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from synpick_warp.configs.schema import Bake, Config, ObjectRow, Objects
from synpick_warp.scenes.assets.meshes import MeshOptions, read_mesh
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog

CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
"""A tetrahedron."""
OBJ = "mtllib a.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "vt 0 0\nvt 1 0\nvt 1 1\nusemtl skin\n"
OBJ += "f 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
"""The tetrahedron with texture coordinates, in the material `skin` of a.mtl."""
LITRES = (1.142, 2.310, 0.661, 0.357, 0.699, 0.187, 0.352, 0.179, 0.420, 0.265, 3.125)
LITRES += (1.067, 0.749, 0.525, 1.292, 1.605, 0.129, 0.033, 0.377, 0.601, 0.197)
REAL_HULLS = dict(enumerate(LITRES, start=1))
"""Litres of the convex hulls of the real objects by obj_id, as the README of the real data gives them: what an arrangement's volume
budget counts."""


def ascii_ply(vertices, faces=FACES, columns=("x", "y", "z"), comment="", face_tail=None) -> str:
    """PLY as text; `face_tail`: what follows after the corners of each face, its texture coordinates."""
    rows = [" ".join(str(value) for value in row) for row in vertices]
    tails = face_tail or [""] * len(faces)
    rows += [f"{len(face)} {' '.join(map(str, face))} {tail}".strip() for face, tail in zip(faces, tails, strict=True)]
    header = _header("ascii", len(vertices), len(faces), columns, comment)
    header += ["property list uchar float texcoord"] if face_tail else []
    return "\n".join([*header, "end_header", *rows]) + "\n"


def binary_ply(vertices, faces=FACES, columns=("x", "y", "z"), comment="") -> bytes:
    """PLY in binary."""
    body = np.asarray(vertices, "<f4").tobytes() + b"".join(struct.pack("<B3i", 3, *face) for face in faces)
    return "\n".join([*_header("binary_little_endian", len(vertices), len(faces), columns, comment), "end_header\n"]).encode() + body


def _header(kind: str, vertices: int, faces: int, columns, comment: str) -> list[str]:
    lines = ["ply", f"format {kind} 1.0", *filter(None, [comment]), f"element vertex {vertices}"]
    lines += [f"property {'uchar' if name in ('red', 'green', 'blue') else 'float'} {name}" for name in columns]
    return [*lines, f"element face {faces}", "property list uchar int vertex_indices"]


def exported(mesh: trimesh.Trimesh | trimesh.Scene, kind: str = "ply") -> bytes:
    """Model file of any kind."""
    data: Any = mesh.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


def glb(*meshes: trimesh.Trimesh) -> bytes:
    """GLB file of meshes."""
    return exported(trimesh.Scene(list(meshes)), "glb")


def pack_glb(text: bytes, binary: bytes) -> bytes:
    """GLB file of a JSON and a binary chunk."""
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unpack_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a GLB file."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def pack_png(
    width: int, height: int, *between: tuple[bytes, bytes], depth: int = 8, kind: int = 0, rest: tuple[int, ...] = (0, 0, 0)
) -> bytes:
    """PNG file of chunks (kind, data) between the header and the end."""
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, *rest)), *between, (b"IEND", b""))
    packed = [struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def picture(path: Path, color=(200, 10, 30), size=(4, 2)) -> Path:
    """Write an image of one colour."""
    Image.new("RGB", size, color).save(path)
    return path


def step_cylinder(radius: float, height: float, unit: str = ".MILLI.") -> str:
    """STEP file (AP214) of a cylinder about z, from z = 0 up; `unit`: prefix of the metre, $ for none."""
    return Path(__file__).with_name("cylinder.step").read_text().format(radius=radius, height=height, unit=unit)


def heard(lines: list[str]) -> Callable[[str], None]:
    """Collect lines of progress, but for those on masses that are guessed, which most models here have."""
    return lambda line: None if " is a guess; " in line else lines.append(line)


def load_models(folder: Path, cache: Path, *rows: ObjectRow, **objects: Any) -> tuple[Catalog, list[str]]:
    """Catalog of a model folder under these settings, and what is told of it, as `heard`."""
    lines: list[str] = []
    config = Config(bake=Bake(models=str(folder)), objects=Objects(**objects), object_rows=rows)
    return load_catalog(config, cache / "cache", heard(lines)), lines


def box(*sides: float, kind: str = "ply") -> bytes:
    """Model file of a box."""
    return exported(trimesh.creation.box(sides), kind)


def put(path: Path, content: str | bytes) -> Path:
    """Write a file, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(path: Path, content: str | bytes, options: MeshOptions | None = None, scale: float = 1.0) -> tuple[Any, Any]:
    """Write a model file, and read it: mesh and finish."""
    return read_mesh(put(path, content), scale, options or MeshOptions())[:2]


def read_told(path: Path, content: str | bytes | None = None, options: MeshOptions | None = None) -> tuple[Any, Any, list[str]]:
    """Write a model file, if its content is given, and read it: mesh, finish, and what is told of it, without its path."""
    if content is not None:
        put(path, content)
    lines: list[str] = []
    mesh, finish, _ = read_mesh(path, 1.0, options or MeshOptions(), lines.append)
    return mesh, finish, [line.removeprefix(f"{path}: ") for line in lines]


def texels(mesh: Any, texture: np.ndarray) -> np.ndarray:
    """Texel (V, 3) at the texture coordinates of each vertex; beyond the borders, the one there."""
    height, width = texture.shape[:2]
    rows, columns = ((1.0 - mesh.uv[:, 1]) * height).astype(int), (mesh.uv[:, 0] * width).astype(int)
    return texture[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
