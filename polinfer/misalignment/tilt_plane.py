"""A phase plane between the two arms, one for a frame, inferred with all of its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi

import numpy as np

from ..checks import integer, real_array, real_number
from ..storage import array
from .base import Misalignment

__all__ = ["Tilt", "TiltPlane"]

HIGHEST = 4


@dataclass(frozen=True)
class TiltPlane(Misalignment):
    """A relative phase of the arms that is a plane over the frame: ``phi = phi_0 + k_row v + k_column u``.

    v and u run from -1/2 to 1/2 from the first to the last edge of the frame's rows and columns (the last two axes of
    P; pixel r of R rows is at ``v = (r + 1/2) / R - 1/2``), so the coefficients are radians: phi_0, the *piston*, at
    the centre, and the *slopes*, the change of phi from edge to edge. The measured matrix is ``T^-1 J T`` with
    ``T = diag(1, e^{i phi})``. Leading axes of P are frames, each with a plane of its own.

    The prior: phi_0 uniform on (-pi/2, pi/2]; every other coefficient normal, mean 0, standard deviation ``scale``.
    The frame with ``phi + pi, -theta_eta, -theta_D`` has the same data, pixel by pixel: hence the range of phi_0, and
    slopes of pi for every pixel cannot be told from none. The piston is told from a circularity common to all pixels
    by the prior of the circularity and by the diattenuation.

    Parameters
    ----------
    scale: standard deviation of slopes before the data, radians from edge to edge, > 0.
    order: 1: a plane; up to 4: products ``P_a(2 v) P_b(2 u) / 2`` of Legendre polynomials of degree a + b <= order as
        well (weak curvature of the wave fronts), each coefficient with the same prior.

    >>> plane = TiltPlane()
    >>> plane.terms
    ((0, 0), (1, 0), (0, 1))
    >>> plane.phase(np.array([0.1, 0.0, 4.0]), (3, 4)).round(2).tolist()[0]
    [-1.4, -0.4, 0.6, 1.6]
    """

    scale: float = 20.0
    order: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", real_number("scale", self.scale, above=0))
        order = integer("order", self.order, low=1)
        if order > HIGHEST:
            raise ValueError(f"order must be at most {HIGHEST}, got {order}; higher ones would describe the sample.")
        object.__setattr__(self, "order", order)

    @property
    def terms(self) -> tuple[tuple[int, int], ...]:
        """Degrees (a, b) in rows and columns of the terms of the phase, in the order of the coefficients."""
        return tuple((n - b, b) for n in range(self.order + 1) for b in range(n + 1))

    def factors(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """What the terms of a frame are products of: ``(terms, rows)`` and ``(terms, columns)``."""
        rows, columns = (1, 1, *shape)[-2:]
        legendre = np.polynomial.legendre.legval
        found = []
        for size, axis in ((rows, 0), (columns, 1)):
            place = (2 * np.arange(size) + 1) / size - 1
            found.append(np.stack([legendre(place, np.eye(HIGHEST + 1)[term[axis]]) for term in self.terms]))
        found[0][1:] *= 0.5
        return found[0], found[1]

    def basis(self, shape: tuple[int, ...]) -> np.ndarray:
        """The terms at every pixel of one frame, ``(terms, rows, columns)``."""
        left, right = self.factors(shape)
        return left[:, :, None] * right[:, None, :]

    def phase(self, coefficients: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """phi of coefficients ``(*frames, terms)`` at the pixels of shape P, radians.

        Leading axes of the coefficients beyond the frames of P are kept in front, for draws.
        """
        coefficients = real_array("coefficients", coefficients, trailing=(len(self.terms),))
        left, right = self.factors(shape)
        values = (coefficients[..., None, :] * left.T) @ right  # (*frames, rows, columns)
        frames = max(len(shape) - 2, 0)
        lead = coefficients.shape[: coefficients.ndim - 1 - frames]
        return np.asarray(values.reshape(*lead, *shape))

    def log_prior(self, coefficients: np.ndarray) -> np.ndarray:
        """Log density of coefficients ``(*frames, terms)``, normalised."""
        slopes = np.asarray(coefficients, float)[..., 1:] / self.scale
        constant = log(pi) + slopes.shape[-1] * (log(self.scale) + 0.5 * log(2 * pi))
        return np.asarray(-0.5 * np.sum(slopes**2, axis=-1) - constant)


@dataclass(frozen=True, eq=False)
class Tilt:
    """The tilt that a fit found: :attr:`polinfer.Fit.tilt`.

    Where no plane stands out of the noise (``Status.TILT_UNIDENTIFIED``) the coefficients are 0, and as uncertain as
    before the data.

    Attributes
    ----------
    phase: the most probable phi at every pixel, shape P, radians, also where the pixel itself has no answer.
    phase_std: its standard deviation.
    coefficients: ``(*frames, terms)``: piston in (-pi/2, pi/2], slopes along rows and columns, radians from edge to
        edge, higher terms as :attr:`TiltPlane.terms` lists them.
    covariance: ``(*frames, terms, terms)``, of the coefficients, the pixels' parameters integrated out.
    probability: ``(*frames)``, share of this maximum in the posterior of the tilt. Low where noise makes as good
        planes.
    log_evidence: ``(*frames)``, what the tilt adds to the log evidence of the frame given the tilt (nats); negative:
        the price of the coefficients. It is part of :attr:`polinfer.Fit.log_evidence`, in equal shares of the pixels.
    response: ``(*P, 5)``, by how much the most probable parameters of a pixel change with phi, per radian.
    """

    phase: np.ndarray = array(("*P",), "rad")
    phase_std: np.ndarray = array(("*P",), "rad")
    coefficients: np.ndarray = array(("*P", "term"), "rad")
    covariance: np.ndarray = array(("*P", "term", "other_term"), "rad^2")
    probability: np.ndarray = array(("*P",), "1")
    log_evidence: np.ndarray = array(("*P",), "nat")
    response: np.ndarray = array(("*P", "parameter"), "1 per rad")
