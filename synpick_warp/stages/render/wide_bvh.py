"""Wide BVH construction: collapses Warp's binary BVHs to four children per node and quantizes their bounding boxes.

`kernels.render.visibility.wide_bvh` has the data layout and the ray queries.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.visibility.wide_bvh import LEAF, NODE_RECORDS, STACK_SIZE, WIDTH, WideBvh, read_binary_bvh_kernel
from synpick_warp.scenes.types import TriangleMesh

MARGIN = 1e-6
"""Padding of bounding boxes against float32 rounding in the slab test: this in metres, plus this times the mesh's largest coordinate."""
MAX_COORDINATE = 255
"""Largest quantized coordinate."""
MIN_EXPONENT = -20
"""Binary exponent of the smallest quantization step, 1 um."""
EXPONENT_BIAS = 127
"""Offset of a float32's stored exponent."""
ABSENT = -1
"""Child index of an empty slot."""


@dataclass(frozen=True, eq=False)
class BinaryBvh:
    """Binary BVH of a mesh: boxes [m] and children of each node; a leaf has a range of triangles in their place, as negative numbers."""

    lower: np.ndarray
    upper: np.ndarray
    """(node, 3) float64: box [m]."""
    children: np.ndarray
    """(node, 2) int32: child nodes. A leaf stores its range [begin, end) of `triangle` as (-1 - begin, -1 - end)."""
    triangle: np.ndarray
    """(triangle) int32: triangle indices in leaf order."""
    root: int

    @property
    def leaf(self) -> np.ndarray:
        """Mask of leaves (node) bool."""
        return self.children[:, 0] < 0


@dataclass(frozen=True, eq=False)
class BvhLevel:
    """One level of a wide BVH in breadth-first order: the children of each of its nodes."""

    child: np.ndarray
    """(node, WIDTH) int64: children, as nodes of the binary BVH, or ABSENT."""
    inner: np.ndarray
    """(node, WIDTH) bool: mask of children that are inner nodes. These are the nodes of the next level, in row-major order."""

    @property
    def leaf(self) -> np.ndarray:
        """Mask of children that are leaves (node, WIDTH) bool."""
        return (self.child != ABSENT) & ~self.inner


def build_wide_bvh(shapes: list[TriangleMesh], device: wp.Device) -> Any:
    """Build the struct `WideBvh` of meshes on `device`. Warp's CPU builder is used for all devices, so that they have the same trees."""
    nodes, triangles, roots = [], [], []
    node_count = triangle_count = 0
    for shape in shapes:
        binary, levels = build_levels(shape)
        leaves = np.concatenate([level.child[level.leaf] for level in levels])
        order = binary.triangle[-1 - binary.children[leaves, 0]]
        nodes.append(encode_nodes(binary, levels, node_count, triangle_count))
        triangles.append(encode_triangles(shape, order))
        roots.append(node_count)
        node_count += sum(len(level.child) for level in levels)
        triangle_count += len(order)
    result = WideBvh()
    result.node = wp.array(np.concatenate(nodes), dtype=wp.vec4ui, device=device)
    result.triangle = wp.array(np.concatenate(triangles), dtype=wp.vec4, device=device)
    result.root = wp.array(roots, dtype=wp.int32, device=device)
    return result


def build_levels(shape: TriangleMesh) -> tuple[BinaryBvh, list[BvhLevel]]:
    """Build the binary and the wide BVH of a mesh: by the surface area heuristic, or by medians if that tree is too deep for the stack.
    Raises CatalogError: even the balanced tree is too deep."""
    for constructor in ("sah", "median"):
        binary = build_binary_bvh(shape, constructor)
        leaves = binary.children[binary.leaf]
        if (leaves[:, 0] - leaves[:, 1] == 1).all():  # Every leaf is one triangle.
            levels = collapse(binary)
            if needed_stack(levels) <= int(STACK_SIZE):
                return binary, levels
    raise CatalogError(f"a mesh of {len(shape.faces):,} triangles has a BVH too deep for a stack of {int(STACK_SIZE)}")


def build_binary_bvh(shape: TriangleMesh, constructor: str) -> BinaryBvh:
    """Warp's BVH of a mesh, built on the CPU."""
    points = wp.array(shape.vertices, dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(points, wp.array(shape.faces.reshape(-1), dtype=wp.int32, device="cpu"), bvh_constructor=constructor, bvh_leaf_size=1)
    faces = len(shape.faces)
    lower, upper = (wp.zeros(2 * faces, dtype=wp.vec3, device="cpu") for _ in range(2))
    children, triangle, root = (wp.zeros(n, dtype=kind, device="cpu") for n, kind in ((2 * faces, wp.vec2i), (faces, int), (1, int)))
    wp.launch(read_binary_bvh_kernel, dim=2 * faces, inputs=[mesh.id], outputs=[lower, upper, children, triangle, root], device="cpu")
    low, high = (array.numpy().astype(np.float64) for array in (lower, upper))
    return BinaryBvh(low, high, children.numpy().copy(), triangle.numpy().copy(), int(root.numpy()[0]))


def collapse(binary: BinaryBvh) -> list[BvhLevel]:
    """Collapse a binary BVH into a wide one, level by level: a node's inner child of largest surface area is replaced by its own two
    children, until there are WIDTH (Wald, Benthin and Boulos, 2008)."""
    edges = binary.upper - binary.lower
    area = edges[:, 0] * edges[:, 1] + edges[:, 1] * edges[:, 2] + edges[:, 2] * edges[:, 0]
    weight = np.append(np.where(binary.leaf, -1.0, area), -1.0)  # The last entry is that of ABSENT.
    levels: list[BvhLevel] = []
    nodes = np.array([binary.root])
    while len(nodes):
        child = np.full((len(nodes), int(WIDTH)), ABSENT, np.int64)
        child[:, 0] = nodes
        rows = np.arange(len(nodes))
        for slot in range(1, int(WIDTH)):
            largest = weight[child].argmax(axis=1)
            opened = child[rows, largest]
            opens = weight[opened] >= 0.0
            child[rows[opens], slot] = binary.children[opened[opens], 1]
            child[rows[opens], largest[opens]] = binary.children[opened[opens], 0]
        levels.append(BvhLevel(child, weight[child] >= 0.0))
        nodes = child[levels[-1].inner]
    return levels


def needed_stack(levels: list[BvhLevel]) -> int:
    """Worst-case depth of the traversal stack. Absent children count, because rounding lets rays from afar enter inverted boxes."""
    below = np.zeros(0, np.int64)
    for level in reversed(levels):
        more = np.zeros(level.child.shape, np.int64)
        more[level.inner] = below - 1
        below = int(WIDTH) + more.max(axis=1)
    return int(below[0])


def encode_nodes(binary: BinaryBvh, levels: list[BvhLevel], first_node: int, first_triangle: int) -> np.ndarray:
    """Records of nodes (4 node, 4) uint32, as `WideBvh.node`; `first_node` and `first_triangle` are added to all indices."""
    child, inner, leaf = (np.concatenate([getattr(level, name) for level in levels]) for name in ("child", "inner", "leaf"))
    origin, exponent, low, high = quantize_boxes(binary, child)
    reference = np.full(child.shape, int(LEAF) + first_triangle)
    reference[inner] = first_node + 1 + np.arange(inner.sum())
    reference[leaf] += np.arange(leaf.sum())
    words = np.zeros((len(child), 4 * int(NODE_RECORDS)), np.uint32)
    words[:, :3] = origin.view(np.uint32)
    words[:, 3] = ((exponent + EXPONENT_BIAS) << [0, 8, 16]).sum(axis=1)
    words[:, 4:10] = np.ascontiguousarray(np.concatenate([low, high], axis=2).transpose(0, 2, 1)).view("<u4")[..., 0]
    words[:, 10:14] = reference
    return words.reshape(-1, 4)


def quantize_boxes(binary: BinaryBvh, child: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Quantize the boxes of children (node, WIDTH), enlarged by MARGIN. Returns corner of each node's box (node, 3) float32 [m], binary
    exponents of the steps (node, 3), lower and upper corners of the children's boxes (node, WIDTH, 3) uint8 [steps from the node's corner];
    those of absent children are inverted."""
    absent = (child == ABSENT)[..., None]
    margin = MARGIN * (1.0 + np.abs(np.stack([binary.lower, binary.upper])).max(initial=0.0))
    low = np.where(absent, np.inf, binary.lower[child] - margin)
    high = np.where(absent, -np.inf, binary.upper[child] + margin)
    origin = np.nextafter(low.min(axis=1).astype(np.float32), np.float32(-np.inf))
    extent = high.max(axis=1) - origin
    exponent = np.maximum(np.ceil(np.log2(extent / MAX_COORDINATE)), MIN_EXPONENT).astype(np.int64)
    exponent += extent > MAX_COORDINATE * np.exp2(exponent)  # The logarithm is rounded.
    step = np.exp2(exponent)[:, None]
    low = np.where(absent, MAX_COORDINATE, np.floor((low - origin[:, None]) / step))
    high = np.where(absent, 0, np.ceil((high - origin[:, None]) / step))
    return origin, exponent, low.astype(np.uint8), high.astype(np.uint8)


def encode_triangles(shape: TriangleMesh, order: np.ndarray) -> np.ndarray:
    """Records of triangles (3 triangle, 4) float32, as `WideBvh.triangle`, in `order`."""
    records = np.zeros((len(order), 3, 4), np.float32)
    records[..., :3] = shape.vertices[shape.faces[order]]
    records[:, 0, 3] = order.astype(np.uint32).view(np.float32)
    return records.reshape(-1, 4)
