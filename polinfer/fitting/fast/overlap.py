"""The two functions of J that the likelihood needs, and their derivatives.

With the statistics R and Y of a pixel and ``K = Y R^H``, ``S = R R^H``, the likelihood depends on J through the
overlap ``a = <J R, Y> = tr(J^H K)``, which is bilinear in u and q, ``a = u^T T q``, and through the energy
``m = |J R|^2 = tr(J S J^H)``, which is constant for balanced states (S proportional to the identity).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from .known import ZERO
from .point import Pair, Point, Vector, dot, polariser_vectors, retarder_vectors

__all__ = ["Derivatives", "Pauli", "coefficients", "energy", "imaginary", "overlap", "overlap_slopes", "pauli",
           "quadratic_forms", "turned"]  # fmt: skip

FREE_PAIRS = [(i, j) for i in range(5) for j in range(i, 5)]


class Pauli(NamedTuple):
    """``tr(A)``, ``tr(Z A)``, ``tr(X A)``, ``tr(Y A)`` of a matrix A, real and imaginary parts."""

    one: Pair
    z: Pair
    x: Pair
    y: Pair


class Derivatives(NamedTuple):
    """Value, gradient by the five angles and Hessian (upper triangle) of a scalar function."""

    value: Any
    gradient: list[Any]
    hessian: dict[tuple[int, int], Any]


def pauli(a: list[list[Pair]]) -> Pauli:
    """Pauli components of a matrix given by the parts of its elements."""
    (p, q), (r, s) = a
    return Pauli(
        (p[0] + s[0], p[1] + s[1]),
        (p[0] - s[0], p[1] - s[1]),
        (q[0] + r[0], q[1] + r[1]),
        (r[1] - q[1], q[0] - r[0]),
    )


def turned(k: Pauli, phase: Pair) -> Pauli:
    """The components times ``conj(phase)``."""
    c, s = phase
    return Pauli(*((re * c + im * s, im * c - re * s) for re, im in k))


def imaginary(k: Pauli) -> Pauli:
    """-i times the components: their real parts are the imaginary parts of those."""
    return Pauli(*((im, -re) for re, im in k))


def coefficients(retarder_first: bool, k: Pauli) -> list[Vector]:
    """T with ``Re tr(J^H K) = u^T T q``, three rows of four."""
    sign = 1 if retarder_first else -1
    (o, io), (z, iz), (x, ix), (y, iy) = k
    return [[o, iz, -ix, -iy], [z, io, sign * y, -sign * x], [-x, -sign * y, io, -sign * z]]


def _image(t: list[Vector], u: Vector) -> Vector:
    """``T^T u``."""
    return [dot([row[i] for row in t], u) for i in range(4)]


def overlap(t: list[Vector], point: Point, one: Any) -> Derivatives:
    """``u^T T q`` with its derivatives; dividing by ``one`` keeps XLA from computing an entry once for each use."""
    u, du = polariser_vectors(point)
    q, dq = retarder_vectors(point)
    g = [x / one for x in _image(t, u)]
    dg = {key: _image(t, vector) for key, vector in du.items()}
    dg |= {key: [x / one for x in dg[key]] for key in ((0,), (1,))}
    value = dot(g, q)
    gradient = [dot(dg[0,], q), dot(dg[1,], q), *(dot(g, dq[j,]) for j in (2, 3, 4))]
    hessian = {(0, 0): -value, (0, 1): dot(dg[0, 1], q), (1, 1): dot(dg[1, 1], q), (2, 2): -value}
    hessian |= {(i, j): dot(dg[i,], dq[j,]) for i in (0, 1) for j in (2, 3, 4)}
    hessian |= {key: dot(g, vector) for key, vector in dq.items() if len(key) == 2}
    return Derivatives(value, gradient, hessian)


def overlap_slopes(t: list[Vector], point: Point) -> tuple[Any, list[Any]]:
    """``u^T T q`` and its gradient alone."""
    u, du = polariser_vectors(point)
    q, dq = retarder_vectors(point)
    g = _image(t, u)
    gradient = [dot(_image(t, du[0,]), q), dot(_image(t, du[1,]), q), *(dot(g, dq[j,]) for j in (2, 3, 4))]
    return dot(g, q), gradient


def quadratic_forms(s: Pauli) -> tuple[list[Vector], list[Vector]]:
    """Matrices M of the z and x components ``q^T M q`` of the Stokes vector s turned by the retarder."""
    z, x, y = s.z[0], s.x[0], s.y[0]
    z_matrix = [[z, ZERO, y, -x], [ZERO, z, -x, -y], [y, -x, -z, ZERO], [-x, -y, ZERO, -z]]
    x_matrix = [[x, y, ZERO, z], [y, -x, -z, ZERO], [ZERO, -z, x, y], [z, ZERO, y, -x]]
    return z_matrix, x_matrix


def _turn(s: Pauli, q: Vector) -> tuple[Any, Any, list[Vector], list[Vector]]:
    """The components, and their matrices."""
    z_matrix, x_matrix = quadratic_forms(s)
    z_image, x_image = ([dot(row, q) for row in m] for m in (z_matrix, x_matrix))
    return dot(q, z_image), dot(q, x_image), z_matrix, x_matrix


def energy(retarder_first: bool, s: Pauli, point: Point) -> Derivatives:
    """``m = |J R|^2`` with its derivatives; ``s`` are the Pauli components of ``S = R R^H``.

    ``m = tr S + D (cos 2 theta_D s_z' - sin 2 theta_D s_x')`` with the Stokes vector s' of the light that meets the
    polariser: s itself, or s turned by the retarder.
    """
    (c, e), (x, y) = point.diattenuation, point.diattenuation_angle
    sine, cosine = 2 * e * c, c * c - e * e  # D and cos delta
    q, dq = retarder_vectors(point)
    if not retarder_first:
        along, across = x * s.z[0] - y * s.x[0], -y * s.z[0] - x * s.x[0]
        gradient = [2 * cosine * along, sine * across, ZERO, ZERO, ZERO]
        hessian = dict.fromkeys(FREE_PAIRS, ZERO)
        hessian |= {(0, 0): -4 * sine * along, (0, 1): 2 * cosine * across, (1, 1): -sine * along}
        return Derivatives(s.one[0] + sine * along, gradient, hessian)
    z, w, z_matrix, x_matrix = _turn(s, q)
    along, across = x * z - y * w, -y * z - x * w
    # the quadratic forms of the polariser's axis and of its derivative
    form = _combine(x, z_matrix, -y, x_matrix)
    slant = _combine(-y, z_matrix, -x, x_matrix)
    image, slanted = [dot(row, q) for row in form], [dot(row, q) for row in slant]
    first = {j: 2 * dot(image, dq[j,]) for j in (2, 3, 4)}
    gradient = [2 * cosine * along, sine * across, *(sine * first[j] for j in (2, 3, 4))]
    hessian = {(0, 0): -4 * sine * along, (0, 1): 2 * cosine * across, (1, 1): -sine * along}
    for j in (2, 3, 4):
        hessian[0, j] = 2 * cosine * first[j]
        hessian[1, j] = 2 * sine * dot(slanted, dq[j,])
        moved = [dot(row, dq[j,]) for row in form]
        for k in range(j, 5):
            bent = -dot(image, q) if (j, k) == (2, 2) else dot(image, dq[j, k])
            hessian[j, k] = 2 * sine * (bent + dot(moved, dq[k,]))
    return Derivatives(s.one[0] + sine * along, gradient, hessian)


def _combine(a: Any, left: list[Vector], b: Any, right: list[Vector]) -> list[Vector]:
    return [[a * p + b * q for p, q in zip(r, s, strict=True)] for r, s in zip(left, right, strict=True)]
