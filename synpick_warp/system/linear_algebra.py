"""Linear algebra with the same bits on every processor.

BLAS and LAPACK, behind NumPy's `@`, `linalg` and norms of whole arrays, choose their kernels by the processor, and these round differently.
Here sums have a fixed order: `einsum` without `optimize` calls no BLAS. NumPy's and the C library's transcendental functions differ by SIMD
level, too; where their results decide, they are rounded first (DECIMALS).
"""

import math
from typing import Any

import numpy as np

DECIMALS = 12
"""Decimal places of transcendental functions that decide or are written: far from both their own errors and any tolerance here."""
ORTHONORMAL = 1e-3
"""Tolerance of R Rᵀ = 1 for a rotation that is read; files have at least six digits."""
_NEWTON = 8
"""Steps of Newton's iteration; it converges quadratically, of what is a rotation up to a tenth in four."""
_SWEEPS = 60
"""Most sweeps of Jacobi's method; it converges quadratically, in fewer than ten."""


def dot(a: np.ndarray, b: np.ndarray) -> Any:
    """Inner product over the last axis (..., n); of a matrix (m, n) and a vector (n) the product (m)."""
    return np.einsum("...i,...i->...", a, b)


def matmul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matrix product of stacks of matrices (..., m, n) and (..., n, k)."""
    return np.einsum("...ij,...jk->...ik", a, np.ascontiguousarray(b))


def norm(vector: np.ndarray) -> Any:
    """Euclidean norm over the last axis."""
    return np.sqrt(np.einsum("...i,...i->...", vector, vector))


def det(matrix: np.ndarray) -> Any:
    """Determinant of 3 x 3 matrices (..., 3, 3): the triple product of their rows."""
    return dot(matrix[..., 0, :], np.cross(matrix[..., 1, :], matrix[..., 2, :]))


def cofactors(matrix: np.ndarray) -> np.ndarray:
    """Cofactors of 3 x 3 matrices (..., 3, 3): transposed, the inverse times the determinant."""
    return np.stack([np.cross(matrix[..., row - 2, :], matrix[..., row - 1, :]) for row in range(3)], axis=-2)


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether a matrix (3, 3) is a rotation: its rows are unit vectors perpendicular to each other, up to ORTHONORMAL, and right-handed."""
    return np.allclose(matmul(matrix, matrix.T), np.eye(3), rtol=0.0, atol=ORTHONORMAL) and bool(det(matrix) > 0.0)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) closest to matrices near them: the polar factor, by Newton's iteration (Higham, 1986)."""
    for _ in range(_NEWTON):
        matrix = (matrix + cofactors(matrix) / det(matrix)[..., None, None]) / 2.0
    return matrix


def solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution (n) of a linear system (n, n), by Gaussian elimination with partial pivoting."""
    rows = np.column_stack([matrix, right])
    for at in range(len(rows)):
        pivot = at + int(np.abs(rows[at:, at]).argmax())
        rows[[at, pivot]] = rows[[pivot, at]]
        rows[at] /= rows[at, at]
        others = np.arange(len(rows)) != at
        rows[others] -= rows[others, at, None] * rows[at]
    return rows[:, -1]


def eigh(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues in ascending order and eigenvectors in columns of a symmetric matrix, by Jacobi's method (Golub and Van Loan, 8.5)."""
    # In Python's numbers: of 3 x 3 matrices a product by NumPy takes five times as long.
    rows, vectors = np.array(matrix, np.float64).tolist(), np.eye(len(matrix)).tolist()
    pairs = [(p, q) for p in range(len(rows)) for q in range(p + 1, len(rows))]
    for _ in range(_SWEEPS):
        # Entries that no longer change the diagonal count as zero.
        large = [(p, q) for p, q in pairs if abs(rows[p][q]) > math.ulp(1.0) * math.sqrt(abs(rows[p][p] * rows[q][q]))]
        if not large:
            break
        for p, q in large:
            if rows[p][q] == 0.0:
                continue
            slope = (rows[q][q] - rows[p][p]) / (2.0 * rows[p][q])
            tangent = (1.0 if slope >= 0.0 else -1.0) / (abs(slope) + math.sqrt(slope * slope + 1.0))
            sine = tangent * (cosine := 1.0 / math.sqrt(tangent * tangent + 1.0))
            for row in (*rows, *vectors):
                row[p], row[q] = row[p] * cosine - row[q] * sine, row[p] * sine + row[q] * cosine
            turned = [(a * cosine - b * sine, a * sine + b * cosine) for a, b in zip(rows[p], rows[q], strict=True)]
            rows[p], rows[q] = map(list, zip(*turned, strict=True))
            rows[p][q] = rows[q][p] = 0.0
    order = np.argsort(np.diag(rows), kind="stable")
    return np.diag(rows)[order], np.array(vectors)[:, order]


def lstsq(matrix: np.ndarray, right: np.ndarray, rcond: float) -> np.ndarray:
    """Least-squares solution of least norm (n) of a linear system (m, n), without singular values below `rcond` of the largest."""
    squares, vectors = eigh(matmul(matrix.T, matrix))
    share = dot(vectors.T, dot(matrix.T, right))
    return dot(vectors, np.where(squares > rcond**2 * squares[-1], share / np.maximum(squares, np.finfo(float).tiny), 0.0))


def rotation(axis: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) about unit axes (..., 3) by an angle [rad] (Rodrigues), whose sine and cosine are rounded."""
    wave = np.round([np.cos(angle), np.sin(angle)], DECIMALS)
    cosine, sine = wave / np.sqrt(wave[0] ** 2 + wave[1] ** 2)
    cross = np.cross(np.eye(3), axis[..., None, :])
    return cosine * np.eye(3) + sine * cross + (1.0 - cosine) * axis[..., :, None] * axis[..., None, :]


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """Quaternion (4), x, y, z, w, of a rotation matrix (3, 3): the largest row of its outer product with itself (Shepperd, 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    rows = [1 + a - e - i, b + d, c + g, h - f], [b + d, 1 - a + e - i, f + h, c - g]
    rows += [c + g, f + h, 1 - a - e + i, d - b], [h - f, c - g, d - b, 1 + a + e + i]
    largest = np.array(rows[max(range(4), key=lambda index: rows[index][index])])
    return largest / norm(largest)
