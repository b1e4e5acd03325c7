"""Small matrices: solve, rotate, eigenvectors."""

import numpy as np

from depthpose.pose.compiled.choice import compiled


@compiled
def solve(H, b, x):
    """Solve a symmetric system, of which the lower half is read; ``H`` is used up.

    By elimination with pivots, as rounding may make a positive matrix indefinite.
    """
    n = len(b)
    for i in range(n):
        x[i] = b[i]
        for j in range(i):
            H[j, i] = H[i, j]
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(H[i, k]) > abs(H[pivot, k]):
                pivot = i
        if pivot != k:
            x[k], x[pivot] = x[pivot], x[k]
            for j in range(k, n):
                H[k, j], H[pivot, j] = H[pivot, j], H[k, j]
        for i in range(k + 1, n):
            share = H[i, k] / H[k, k]
            x[i] -= share * x[k]
            for j in range(k + 1, n):
                H[i, j] -= share * H[k, j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= H[i, j] * x[j]
        x[i] /= H[i, i]


@compiled
def damp(H, least):
    """Keep unknowns that nothing determines where they are."""
    size = least
    for k in range(len(H)):
        size = max(size, H[k, k])
    for k in range(len(H)):
        H[k, k] += 1e-9 * size


@compiled
def rotation(x, y, z, R):
    """Write the rotation by a rotation vector [rad]: Rodrigues' formula."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        s, c = 1 - square / 6, 0.5 - square / 24
    else:
        s, c = np.sin(angle) / angle, (1 - np.cos(angle)) / square
    R[0, 0], R[1, 1], R[2, 2] = (
        1 - c * (y * y + z * z),
        1 - c * (x * x + z * z),
        1 - c * (x * x + y * y),
    )
    R[0, 1], R[1, 0] = c * x * y - s * z, c * x * y + s * z
    R[0, 2], R[2, 0] = c * x * z + s * y, c * x * z - s * y
    R[1, 2], R[2, 1] = c * y * z - s * x, c * y * z + s * x


@compiled
def _rotate(A, V, p, q):
    """Make one entry of a symmetric matrix zero (Jacobi), and turn its axes along."""
    if A[p, q] == 0.0:
        return
    theta = (A[q, q] - A[p, p]) / (2 * A[p, q])
    t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1))
    c = 1 / np.sqrt(t * t + 1)
    s = t * c
    for k in range(3):
        a, b = A[k, p], A[k, q]
        A[k, p], A[k, q] = c * a - s * b, s * a + c * b
    for k in range(3):
        a, b = A[p, k], A[q, k]
        A[p, k], A[q, k] = c * a - s * b, s * a + c * b
    for k in range(3):
        a, b = V[k, p], V[k, q]
        V[k, p], V[k, q] = c * a - s * b, s * a + c * b


@compiled
def jacobi(A, V):
    """Turn a symmetric 3x3 matrix into its eigenvalues, on the diagonal, and the vectors in V."""
    V[:] = 0.0
    V[0, 0] = V[1, 1] = V[2, 2] = 1.0
    for _ in range(8):
        _rotate(A, V, 0, 1)
        _rotate(A, V, 0, 2)
        _rotate(A, V, 1, 2)
