"""GLB import: order of parts."""

from __future__ import annotations

import json
import struct

import numpy as np

from synpick_warp.scenes.assets.meshes import read_mesh


def test_the_parts_of_a_glb_mesh_have_one_order(tmp_path):
    """The reader gives the primitives of one mesh nodes of random names."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint16)
    positions = [corners * 0.1 + part for part in range(6)]
    binary = faces.tobytes() + b"".join(part.astype(np.float32).tobytes() for part in positions)
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 24}]
    views += [{"buffer": 0, "byteOffset": 24 + 48 * part, "byteLength": 48} for part in range(6)]
    accessors: list[dict[str, object]] = [{"bufferView": 0, "componentType": 5123, "count": 12, "type": "SCALAR"}]
    accessors += [{"bufferView": 1 + part, "componentType": 5126, "count": 4, "type": "VEC3"} for part in range(6)]
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "tool"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1 + part}, "indices": 0} for part in range(6)]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    (tmp_path / "tool.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    orders = {read_mesh(tmp_path / "tool.glb", 1.0)[0].vertices.tobytes() for _ in range(8)}
    assert len(orders) == 1
