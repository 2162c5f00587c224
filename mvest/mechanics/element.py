"""Element kernels of :mod:`mvest.mechanics.solid`.

``gradients (e, q, k, 3)`` are in the fibre frame; ``volumes (e, q)`` belong to the quadrature
points. An enhanced strain is ``direction (e, q, 6)`` times ``polynomials (q, m)`` times alpha.
"""

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.typing import FloatArray, IntArray

VOIGT = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""Component of a six-vector for each entry of a symmetric tensor."""


@nb.njit(cache=True)
def strains(
    x: FloatArray, elements: IntArray, gradients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Green-Lagrange strain ``(e, q, 6)`` and F ``(e, q, 3, 3)`` in the fibre frame."""
    n_e, n_q, n_a, _ = gradients.shape
    green = np.empty((n_e, n_q, 6))
    deformation = np.zeros((n_e, n_q, 3, 3))
    for e in range(n_e):
        for q in range(n_q):
            f = deformation[e, q]
            for a in range(n_a):
                node = elements[e, a]
                for i in range(3):
                    for m in range(3):
                        f[i, m] += x[node, i] * gradients[e, q, a, m]
            g = green[e, q]
            for m in range(3):
                g[m] = 0.5 * (f[0, m] ** 2 + f[1, m] ** 2 + f[2, m] ** 2 - 1.0)
            g[3] = f[0, 1] * f[0, 2] + f[1, 1] * f[1, 2] + f[2, 1] * f[2, 2]
            g[4] = f[0, 0] * f[0, 2] + f[1, 0] * f[1, 2] + f[2, 0] * f[2, 2]
            g[5] = f[0, 0] * f[0, 1] + f[1, 0] * f[1, 1] + f[2, 0] * f[2, 1]
    return green, deformation


@nb.njit(cache=True)
def strain_derivative(
    dx: FloatArray, elements: IntArray, gradients: FloatArray, deformation: FloatArray
) -> FloatArray:
    """Change of the strain ``(e, q, 6)`` for a move ``dx (n, 3)``."""
    n_e, n_q, n_a, _ = gradients.shape
    out = np.zeros((n_e, n_q, 6))
    df = np.empty((3, 3))
    for e in range(n_e):
        for q in range(n_q):
            f = deformation[e, q]
            df[:, :] = 0.0
            for a in range(n_a):
                node = elements[e, a]
                for i in range(3):
                    for m in range(3):
                        df[i, m] += dx[node, i] * gradients[e, q, a, m]
            g = out[e, q]
            for i in range(3):
                g[0] += f[i, 0] * df[i, 0]
                g[1] += f[i, 1] * df[i, 1]
                g[2] += f[i, 2] * df[i, 2]
                g[3] += f[i, 1] * df[i, 2] + df[i, 1] * f[i, 2]
                g[4] += f[i, 0] * df[i, 2] + df[i, 0] * f[i, 2]
                g[5] += f[i, 0] * df[i, 1] + df[i, 0] * f[i, 1]
    return out


@nb.njit(cache=True)
def enhanced_strain(
    green: FloatArray, direction: FloatArray, polynomials: FloatArray, alpha: FloatArray
) -> FloatArray:
    """Green-Lagrange strain ``(e, q, 6)`` with the enhanced part added."""
    out = np.empty_like(green)
    for e in range(green.shape[0]):
        for q in range(green.shape[1]):
            amplitude = 0.0
            for m in range(alpha.shape[1]):
                amplitude += polynomials[q, m] * alpha[e, m]
            for i in range(6):
                out[e, q, i] = green[e, q, i] + amplitude * direction[e, q, i]
    return out


@nb.njit(cache=True, error_model="numpy")
def volume_change(green: FloatArray, direction: FloatArray) -> FloatArray:
    """Change ``(e, q)`` of det C, over det C, by an enhanced strain of one.

    The direction D is of rank one, so det C is linear in the enhanced strain (matrix determinant
    lemma): ``det(C + 2 b D) = (1 + 2 b C^-1 : D) det C``.
    """
    out = np.empty(green.shape[:2])
    for e in range(len(green)):
        for q in range(green.shape[1]):
            g, d = green[e, q], direction[e, q]
            c0, c1, c2 = 1.0 + 2.0 * g[0], 1.0 + 2.0 * g[1], 1.0 + 2.0 * g[2]
            first = c1 * c2 - g[3] * g[3]
            fifth, last = g[3] * g[5] - c1 * g[4], g[3] * g[4] - c2 * g[5]
            det = c0 * first + g[4] * fifth + g[5] * last
            normal = first * d[0] + (c0 * c2 - g[4] * g[4]) * d[1] + (c0 * c1 - g[5] * g[5]) * d[2]
            shear = (g[4] * g[5] - c0 * g[3]) * d[3] + fifth * d[4] + last * d[5]
            out[e, q] = 2.0 * (normal + shear) / det
    return out


@nb.njit(cache=True, error_model="numpy")
def alpha_change(
    direction: FloatArray,
    polynomials: FloatArray,
    volumes: FloatArray,
    stress: FloatArray,
    tangent: FloatArray,
) -> FloatArray:
    """Step ``(e, m)`` of Newton's method for ``int M^T S dV = 0``."""
    n_q, n_m = polynomials.shape
    out = np.zeros((len(volumes), n_m))
    matrix = np.empty((n_m, n_m))
    for e in range(len(volumes)):
        matrix[:] = 0.0
        for q in range(n_q):
            d, force, stiffness = direction[e, q], 0.0, 0.0
            for i in range(6):
                force += d[i] * stress[e, q, i]
                row = 0.0
                for j in range(6):
                    row += tangent[e, q, i, j] * d[j]
                stiffness += d[i] * row
            for k in range(n_m):
                p = volumes[e, q] * polynomials[q, k]
                out[e, k] -= p * force
                for m in range(n_m):
                    matrix[k, m] += p * polynomials[q, m] * stiffness
        _solve_small(matrix, out[e].reshape(n_m, 1))
    return out


@nb.njit(cache=True, error_model="numpy")
def _solve_small(matrix: FloatArray, right: FloatArray) -> None:
    """Overwrite ``right (m, c)`` by the solution; the matrix ``(m, m)`` is overwritten too."""
    m = len(matrix)
    for k in range(m):
        pivot = k
        for r in range(k + 1, m):
            if abs(matrix[r, k]) > abs(matrix[pivot, k]):
                pivot = r
        if pivot != k:
            for c in range(m):
                matrix[k, c], matrix[pivot, c] = matrix[pivot, c], matrix[k, c]
            for c in range(right.shape[1]):
                right[k, c], right[pivot, c] = right[pivot, c], right[k, c]
        for r in range(k + 1, m):
            factor = matrix[r, k] / matrix[k, k]
            for c in range(k + 1, m):
                matrix[r, c] -= factor * matrix[k, c]
            for c in range(right.shape[1]):
                right[r, c] -= factor * right[k, c]
    for k in range(m - 1, -1, -1):
        for c in range(right.shape[1]):
            for r in range(k + 1, m):
                right[k, c] -= matrix[k, r] * right[r, c]
            right[k, c] /= matrix[k, k]


@nb.njit(cache=True)
def internal_forces(
    gradients: FloatArray, volumes: FloatArray, deformation: FloatArray, stress: FloatArray
) -> FloatArray:
    """Nodal forces ``(e, k, 3)`` of stresses ``(e, q, 6)``."""
    n_e, n_q, n_a, _ = gradients.shape
    out = np.zeros((n_e, n_a, 3))
    fs = np.empty((3, 3))
    for e in range(n_e):
        for q in range(n_q):
            f, s, w = deformation[e, q], stress[e, q], volumes[e, q]
            for i in range(3):
                fs[i, 0] = w * (f[i, 0] * s[0] + f[i, 1] * s[5] + f[i, 2] * s[4])
                fs[i, 1] = w * (f[i, 0] * s[5] + f[i, 1] * s[1] + f[i, 2] * s[3])
                fs[i, 2] = w * (f[i, 0] * s[4] + f[i, 1] * s[3] + f[i, 2] * s[2])
            for a in range(n_a):
                g = gradients[e, q, a]
                for i in range(3):
                    out[e, a, i] += fs[i, 0] * g[0] + fs[i, 1] * g[1] + fs[i, 2] * g[2]
    return out


@nb.njit(cache=True, error_model="numpy")
def _moduli(
    f: FloatArray,
    stress: FloatArray,
    tangent: FloatArray,
    w: float,
    half: FloatArray,
    a: FloatArray,
) -> None:
    """``w dP/dF`` as ``a (9, 9)``, rows and columns ``3 i + J``, of one quadrature point."""
    for i in range(3):
        for j in range(3):
            r0, r1, r2 = tangent[VOIGT[0, j]], tangent[VOIGT[1, j]], tangent[VOIGT[2, j]]
            f0, f1, f2 = w * f[i, 0], w * f[i, 1], w * f[i, 2]
            for v in range(6):
                half[3 * i + j, v] = f0 * r0[v] + f1 * r1[v] + f2 * r2[v]
    for r in range(9):
        h = half[r]
        for k in range(3):
            f0, f1, f2 = f[k, 0], f[k, 1], f[k, 2]
            a[r, 3 * k] = f0 * h[0] + f1 * h[5] + f2 * h[4]
            a[r, 3 * k + 1] = f0 * h[5] + f1 * h[1] + f2 * h[3]
            a[r, 3 * k + 2] = f0 * h[4] + f1 * h[3] + f2 * h[2]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                a[3 * i + j, 3 * i + k] += w * stress[VOIGT[j, k]]


@nb.njit(cache=True, error_model="numpy")
def add_tangents(
    gradients: FloatArray,
    volumes: FloatArray,
    deformation: FloatArray,
    stress: FloatArray,
    tangent: FloatArray,
    direction: FloatArray,
    polynomials: FloatArray,
    positions: NDArray[np.int32],
    blocks: FloatArray,
) -> None:
    """Add ``K_ab = sum_q w g_a (dP/dF) g_b``, condensed by the enhanced strains."""
    n_e, n_q, n_a, _ = gradients.shape
    n_m = polynomials.shape[1]
    half, a = np.empty((9, 6)), np.empty((9, 9))
    # Components come first and nodes last, so that the innermost loops run along the nodes: the
    # block of nodes a and b is k[a, :, :, b].
    g, g_t = np.empty((3 * n_q, n_a)), np.empty((n_a, 3 * n_q))
    t, k = np.empty((3 * n_q, 9 * n_a)), np.empty((n_a, 9 * n_a))
    row, d_d, p_d = np.empty((3, n_a)), np.empty(6), np.empty((3, 3))
    k_am, k_mm = np.empty((n_m, 3 * n_a)), np.empty((n_m, n_m))
    for e in range(n_e):
        k_am[:] = 0.0
        k_mm[:] = 0.0
        for q in range(n_q):
            f, w = deformation[e, q], volumes[e, q]
            for j in range(3):
                for b in range(n_a):
                    g[3 * q + j, b] = g_t[b, 3 * q + j] = gradients[e, q, b, j]
            g0, g1, g2 = g[3 * q], g[3 * q + 1], g[3 * q + 2]
            _moduli(f, stress[e, q], tangent[e, q], w, half, a)
            for j in range(3):
                for i in range(3):
                    for c in range(3):
                        a0, a1, a2 = a[3 * i + j, 3 * c : 3 * c + 3]
                        at = (3 * i + c) * n_a
                        for b in range(n_a):
                            t[3 * q + j, at + b] = a0 * g0[b] + a1 * g1[b] + a2 * g2[b]
            if n_m > 0:
                stiffness, d = 0.0, direction[e, q]
                for i in range(6):
                    d_d[i] = 0.0
                    for j in range(6):
                        d_d[i] += w * tangent[e, q, i, j] * d[j]
                    stiffness += d[i] * d_d[i]
                for i in range(3):
                    for j in range(3):
                        p_d[i, j] = (
                            f[i, 0] * d_d[VOIGT[0, j]]
                            + f[i, 1] * d_d[VOIGT[1, j]]
                            + f[i, 2] * d_d[VOIGT[2, j]]
                        )
                    for b in range(n_a):
                        row[i, b] = p_d[i, 0] * g0[b] + p_d[i, 1] * g1[b] + p_d[i, 2] * g2[b]
                for m in range(n_m):
                    p = polynomials[q, m]
                    for c in range(n_m):
                        k_mm[m, c] += p * polynomials[q, c] * stiffness
                    for i in range(3):
                        for b in range(n_a):
                            k_am[m, i * n_a + b] += p * row[i, b]
        if n_q == 1:  # a call would take longer than the product
            for b in range(n_a):
                for c in range(9 * n_a):
                    k[b, c] = g_t[b, 0] * t[0, c] + g_t[b, 1] * t[1, c] + g_t[b, 2] * t[2, c]
        else:
            np.dot(g_t, t, k)
        if n_m > 0:
            change = k_am.copy()
            _solve_small(k_mm, change)
            for m in range(n_m):
                for i in range(3):
                    for b in range(n_a):
                        factor = k_am[m, i * n_a + b]
                        for c in range(3 * n_a):
                            k[b, 3 * i * n_a + c] -= factor * change[m, c]
        for b in range(n_a):
            for c in range(n_a):
                if positions[e, b, c] < 0:
                    continue
                block = blocks[positions[e, b, c]]
                for i in range(3):
                    for j in range(3):
                        block[i, j] += k[b, (3 * i + j) * n_a + c]
