"""The statistics of a block of pixels, element by element."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from .overlap import Pauli, pauli
from .point import Pair

__all__ = ["Data", "prepare", "times", "times_adjoint"]

Matrix = list[list[Pair]]


class Data(NamedTuple):
    """Of every pixel: R and Y by elements, what follows from them, and the scalars of the statistics.

    ``product`` are the Pauli components of ``K = Y R^H``, ``power`` those of ``S = R R^H``, ``jones`` those of the
    least-squares matrix ``K S^-1`` up to a positive factor; ``strength`` is ``|Y|``, the signal-to-noise ratio.
    ``one`` is 1, which XLA does not know: it computes a cheap expression anew for each of its uses, a division not.
    """

    illumination: Matrix
    response: Matrix
    residual: Any
    constant: Any
    product: Pauli
    power: Pauli
    jones: Pauli
    strength: Any
    one: Any


def _conjugate(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0] + a[1] * b[1], a[1] * b[0] - a[0] * b[1]


def _sum(a: Pair, b: Pair) -> Pair:
    return a[0] + b[0], a[1] + b[1]


def _times(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def times(a: Matrix, b: Matrix) -> Matrix:
    """``a b``."""
    return [[_sum(_times(a[i][0], b[0][j]), _times(a[i][1], b[1][j])) for j in (0, 1)] for i in (0, 1)]


def times_adjoint(a: Matrix, b: Matrix) -> Matrix:
    """``a b^H``."""
    return [[_sum(_conjugate(a[i][0], b[j][0]), _conjugate(a[i][1], b[j][1])) for j in (0, 1)] for i in (0, 1)]


def prepare(balanced: bool, illumination: Matrix, response: Matrix, residual: Any, constant: Any, one: Any) -> Data:
    """What the climb needs of R, Y and the rest; ``balanced`` says that S is proportional to the identity."""
    product = times_adjoint(response, illumination)
    power = times_adjoint(illumination, illumination)
    strength = jnp.sqrt(sum(re * re + im * im for row in response for re, im in row))
    if balanced:
        jones = product
    else:
        # K adj(S): the inverse times the determinant, which is positive
        (a, b), (_, d) = power
        adjugate = [[(d[0], 0 * d[0]), (-b[0], -b[1])], [(-b[0], b[1]), (a[0], 0 * a[0])]]
        jones = times_adjoint(product, adjugate)
    return Data(
        illumination,
        response,
        residual,
        constant,
        _kept(one, pauli(product)),
        pauli(power),
        _kept(one, pauli(jones)),
        strength,
        one,
    )


def _kept(one: Any, k: Pauli) -> Pauli:
    return Pauli(*((re / one, im / one) for re, im in k))
