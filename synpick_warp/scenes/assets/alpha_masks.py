"""Alpha masks: what a texture's alpha channel removes is cut out of the triangles, so that every stage sees the holes.

Longest edges are bisected until a triangle lies in texels of one kind or is about as small as a texel; then it is clipped along the line
where the bilinear alpha is the threshold (marching triangles). Vertices that triangles share stay shared; a whole triangle may have middles
of its neighbours on its edges.
"""

import io
from dataclasses import replace

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from synpick_warp.scenes.assets.appearance import EXR_MAGIC, resize
from synpick_warp.scenes.assets.asset_files import Notes
from synpick_warp.scenes.assets.mesh_parts import MeshPart

MAX_TRIANGLES = 2**17
"""Maximum number of triangles that cutting adds to a model; beyond it, masks are halved in resolution."""
MAX_TEXELS = 2**25
"""Largest number of texels of a mask, in all the repetitions that a part shows."""
CLIP_EDGE = 1.5
"""Longest edge of a triangle that is clipped [texels]."""
MIN_SHARE = 1e-3
"""Least distance of a cut from the ends of its edge, in edge lengths, so that no triangle is without area."""
CLAMP, MIRROR = 33071, 33648
"""Wrap modes of glTF; all others repeat."""
_TURNS = np.array([(0, 1, 2), (1, 2, 0), (2, 0, 1)])


def mask_part(part: MeshPart, data: bytes, threshold: float, modes: tuple[int, int], most: int, notes: Notes) -> MeshPart:
    """Apply the alpha mask of an image file to a part, by `cut_mask`, and note what is ignored. `most`: 0: the part cannot be cut."""
    if not data.startswith(EXR_MAGIC):  # Of OpenEXR, no alpha is read.
        with Image.open(io.BytesIO(data)) as image:
            alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() >= threshold:
            return part
        if most and (cut := cut_mask(part, alpha, threshold, modes, most)) is not None:
            if cut.colors is None or (cut.colors == cut.colors[:1]).all():
                return cut
            # They would be baked with the few texels of small triangles.
            notes.ignored.append("vertex colours of a part with an alpha mask")
            return replace(cut, colors=None)
    notes.ignored.append("transparency")
    return part


def cut_mask(part: MeshPart, alpha: np.ndarray, threshold: float, modes: tuple[int, int], most: int = MAX_TRIANGLES) -> MeshPart | None:
    """Cut away what the alpha test discards (alpha < `threshold`, 0 to 255); None: the texture repeats too often. `part`: with texture
    coordinates. `alpha`: alpha channel of its texture (H, W) uint8. `modes`: glTF wrap modes along columns and rows. `most`: largest number
    of triangles to add."""
    assert part.uv is not None
    used = np.unique(part.faces)
    if len(used) == 0:
        return part
    given = {name: values for name in ("vertices", "normals", "colors", "uv") if (values := getattr(part, name)) is not None}
    table, cut = np.concatenate(list(given.values()), axis=1).astype(np.float64), None
    while cut is None:
        height, width = alpha.shape
        # Columns and rows from the centre of the upper left texel.
        at = part.uv * (width, -height) + (-0.5, height - 0.5)
        low, high = np.floor(at[used].min(axis=0)) - 1.0, np.floor(at[used].max(axis=0)) + 3.0
        if not (high - low).prod() <= MAX_TEXELS:  # Or not a number, which the check of all parts names.
            return None
        plane = alpha
        for axis, (first, last, mode) in enumerate(zip(low[::-1], high[::-1], modes[::-1], strict=True)):
            plane = np.concatenate([plane, np.flip(plane, axis)], axis=axis) if mode == MIRROR else plane
            plane = plane.take(np.arange(first, last, dtype=int), axis=axis, mode="clip" if mode == CLAMP else "wrap")
        cut = _cut(np.concatenate([table, at - low], axis=1), part.faces, plane.astype(np.float64) - threshold, most + len(part.faces))
        alpha = resize(alpha[..., None], (max(width // 2, 1), max(height // 2, 1)), Image.Resampling.BOX)[..., 0]
    ends = np.cumsum([values.shape[1] for values in given.values()])
    pieces = dict(zip(given, np.split(cut[0], ends, axis=1), strict=False))
    return replace(part, faces=cut[1], **pieces)


def _cut(rows: np.ndarray, faces: np.ndarray, field: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Cut off where `field` is negative; the last two columns of `rows` are texel column and row. None: more triangles than `most`."""
    sums = np.pad((field < 0.0).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    kept = [np.zeros((0, 3), np.int64)]
    while len(faces):
        at = rows[faces][..., -2:]
        # Texels that bilinear look-ups in the triangle's box read.
        (left, top), (right, bottom) = np.floor(at.min(axis=1)).astype(int).T, np.floor(at.max(axis=1)).astype(int).T + 2
        below = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        kept.append(faces[below == 0])
        mixed = (below > 0) & (below < (right - left) * (bottom - top))
        faces, at = faces[mixed], at[mixed]
        lengths = np.linalg.norm(np.roll(at, -1, axis=1) - at, axis=2)
        small = lengths.max(axis=1, initial=0.0) <= CLIP_EDGE
        rows, clipped = _clip(rows, faces[small], field)
        kept.append(clipped)
        rows, faces = _bisect(rows, faces[~small], lengths[~small].argmax(axis=1))
        if sum(map(len, kept)) + len(faces) > most:
            return None
    return rows, np.concatenate(kept)


def _bisect(rows: np.ndarray, faces: np.ndarray, longest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split triangles at the middle of the edge that begins at the corner `longest`."""
    a, b, c = np.take_along_axis(faces, _TURNS[longest], axis=1).T
    rows, middle = _points(rows, a, b, np.full(len(rows), 1.0))
    return rows, np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _points(rows: np.ndarray, a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add a vertex on each edge (a, b), one for all triangles that share it, and return its indices; equal `weight`s: the midpoint."""
    edges, index = np.unique(np.minimum(a, b) * np.int64(len(rows)) + np.maximum(a, b), return_inverse=True)
    first, second = np.divmod(edges, len(rows))
    share = weight[first] / (weight[first] + weight[second])
    share = share.clip(MIN_SHARE, 1.0 - MIN_SHARE)[:, None]
    return np.concatenate([rows, rows[first] * (1.0 - share) + rows[second] * share]), len(rows) + index.reshape(-1)


def _clip(rows: np.ndarray, faces: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clip triangles where the field, linear along their edges, is negative."""
    value = np.zeros(len(rows))
    used = np.unique(faces)
    value[used] = map_coordinates(field, rows[used, :-3:-1].T, order=1)
    inside = value[faces] >= 0.0
    whole, mixed = faces[inside.all(axis=1)], np.isin(inside.sum(axis=1), (1, 2))
    faces, inside = faces[mixed], inside[mixed]
    # Rotate the corners so that the one on the other side of the threshold comes first.
    alone = inside.sum(axis=1) == 1
    odd = np.where(alone, inside.argmax(axis=1), inside.argmin(axis=1))
    a, b, c = np.take_along_axis(faces, _TURNS[odd], axis=1).T
    rows, points = _points(rows, np.concatenate([a, a]), np.concatenate([b, c]), np.abs(value))
    near, far = points.reshape(2, -1)
    corners = np.stack([a, near, far], axis=1)[alone], np.stack([near, b, c], axis=1)[~alone], np.stack([near, c, far], axis=1)[~alone]
    return rows, np.concatenate([whole, *corners])
