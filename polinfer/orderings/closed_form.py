"""The two elements of a Jones matrix in closed form, shared by both orderings (NumPy), element by element."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Elements", "Symmetric", "diattenuator_of", "elements", "retarder_of"]


class Elements(NamedTuple):
    """A matrix ``[[a, b], [c, d]]``: each entry is its real and its imaginary part, two real arrays."""

    a: tuple[np.ndarray, np.ndarray]
    b: tuple[np.ndarray, np.ndarray]
    c: tuple[np.ndarray, np.ndarray]
    d: tuple[np.ndarray, np.ndarray]

    @property
    def transposed(self) -> Elements:
        """``[[a, c], [b, d]]``."""
        return Elements(self.a, self.c, self.b, self.d)


class Symmetric(NamedTuple):
    """A real matrix ``[[first, off], [off, last]]``."""

    first: np.ndarray
    off: np.ndarray
    last: np.ndarray

    def times(self, m: Elements) -> Elements:
        """The product with a matrix on its right."""
        rows = ((self.first, self.off), (self.off, self.last))
        columns = ((m.a, m.c), (m.b, m.d))
        return Elements(
            *(tuple(x * p + y * q for p, q in zip(*pair, strict=True)) for x, y in rows for pair in columns)
        )


def elements(jones: np.ndarray) -> Elements:
    """The entries of matrices ``(..., 2, 2)``, each contiguous, in double precision."""
    flat = np.ascontiguousarray(jones)
    parts = flat.view(flat.real.dtype).reshape(*flat.shape[:-2], 8)
    return Elements(*np.moveaxis(parts, -1, 0).astype(float, order="C").reshape(4, 2, *flat.shape[:-2]))


def diattenuator_of(m: Elements) -> tuple[np.ndarray, np.ndarray, Symmetric]:
    """Diattenuation (>= 0), its angle and the polariser from ``m m^H``.

    For a polariser ``A^2 / (tr A^2 / 2) = 1 + D [[cos 2t, -sin 2t], [-sin 2t, -cos 2t]]``. A zero matrix gives D = 0.
    """
    upper, lower = (x[0] * x[0] + x[1] * x[1] + y[0] * y[0] + y[1] * y[1] for x, y in ((m.a, m.b), (m.c, m.d)))
    trace = upper + lower
    scale = 1 / np.where(trace > 0, trace, 1.0)
    cosine = (upper - lower) * scale
    sine = -2 * (m.a[0] * m.c[0] + m.a[1] * m.c[1] + m.b[0] * m.d[0] + m.b[1] * m.d[1]) * scale
    value = np.minimum(_length(cosine, sine), 1.0)
    mean = 0.5 * (np.sqrt(1 + value) + np.sqrt(1 - value))
    along, across = 0.5 * cosine / mean, 0.5 * sine / mean
    return value, 0.5 * np.arctan2(sine, cosine), Symmetric(mean + along, -across, mean - along)


def retarder_of(m: Elements) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Retardance in [0, pi], its angle in [0, pi/2] and circularity of the retarder nearest to ``e^{i a} m``.

    The complex quaternion of the matrix is turned by half the phase of its square, which makes its real part as long
    as it can be; that part is the unit quaternion
    ``(cos eta/2, sin eta/2 cos 2t, sin eta/2 sin 2t cos xi, sin eta/2 sin 2t sin xi)``.
    """
    (a, ia), (b, ib), (c, ic), (d, id_) = m
    real = [a + d, ia - id_, -(ib + ic), c - b]
    rest = [ia + id_, d - a, b + c, ic - ib]
    pairs = list(zip(real, rest, strict=True))
    cosine, sine = _half_angle(sum(x * x - y * y for x, y in pairs), 2 * sum(x * y for x, y in pairs))
    turned = [cosine * x + sine * y for x, y in pairs]
    sign = np.where(turned[0] < 0, -1.0, 1.0)
    q = [sign * x for x in turned]
    across = _length(q[2], q[3])
    return 2 * np.arctan2(_length(q[1], across), q[0]), 0.5 * np.arctan2(across, q[1]), np.arctan2(q[3], q[2])


def _length(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sqrt(x * x + y * y)


def _half_angle(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of half the angle of (x, y), 0 if there is none; without cancellation."""
    size = _length(x, y)
    large = np.sqrt(0.5 + 0.5 * np.abs(x) / np.where(size > 0, size, 1.0))
    small = 0.5 * np.abs(y) / np.where(size > 0, size * large, 1.0)
    ahead = (x >= 0) | (size == 0)
    large = np.where(size > 0, large, 1.0)
    return np.where(ahead, large, small), np.copysign(np.where(ahead, small, large), y)
