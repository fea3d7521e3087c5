"""The records that the public verbs take and return."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from math import inf, pi
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import checks, storage
from .misalignment import Tilt
from .storage import array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .model import Model

__all__ = ["PERIODS", "RANGES", "Fit", "Measurement", "Parameters", "Status"]


class Parameters(NamedTuple):
    """The five polarisation parameters, each of pixel shape P.

    ``diattenuation`` D in [-1, 1]; ``diattenuation_angle`` theta_D and ``retardance_angle`` theta_eta in
    (-pi/2, pi/2], period pi; ``retardance`` eta and ``circularity`` xi in (-pi, pi]. Angles in radians. An axis at
    angle t points along (cos t, -sin t) in (horizontal, vertical) components.

    >>> Parameters(0.1, 0.0, 1.2, 0.4, 0.0).retardance
    1.2
    """

    diattenuation: Any
    diattenuation_angle: Any
    retardance: Any
    retardance_angle: Any
    circularity: Any


RANGES = Parameters((-1.0, 1.0), (-0.5 * pi, 0.5 * pi), (-pi, pi), (-0.5 * pi, 0.5 * pi), (-pi, pi))
PERIODS = Parameters(inf, pi, 2 * pi, pi, 2 * pi)


class Status(enum.IntFlag):
    """What is to be known about a pixel's result; flags combine with ``|``.

    ``MASKED`` excluded by the mask, ``NON_FINITE`` the response is not finite: the result is NaN. ``NOT_CONVERGED``
    the optimiser stopped before the maximum. ``BAD_FIT`` the residual is improbably large (chi-square tail
    probability below 1e-3): the model or sigma is wrong. ``AT_EDGE`` the maximum lies on a bound of the range, so a
    Gaussian describes it badly. ``UNIDENTIFIED_<PARAMETER>`` the data hardly constrain it: its standard deviation
    exceeds half of that of a uniform distribution over its range. ``TILT_UNIDENTIFIED`` the tilt of a frame cannot be
    told from the circularity.

    >>> Status.AT_EDGE | Status.BAD_FIT
    <Status.BAD_FIT|AT_EDGE: 24>
    >>> Status(0) is Status.OK
    True
    """

    OK = 0
    MASKED = 1
    NON_FINITE = 2
    NOT_CONVERGED = 4
    BAD_FIT = 8
    AT_EDGE = 16
    TILT_UNIDENTIFIED = 32
    UNIDENTIFIED_DIATTENUATION = 64
    UNIDENTIFIED_DIATTENUATION_ANGLE = 128
    UNIDENTIFIED_RETARDANCE = 256
    UNIDENTIFIED_RETARDANCE_ANGLE = 512
    UNIDENTIFIED_CIRCULARITY = 1024

    @classmethod
    def unidentified(cls, parameter: str) -> Status:
        """The flag of one parameter.

        >>> Status.unidentified("retardance")
        <Status.UNIDENTIFIED_RETARDANCE: 256>
        """
        return cls[f"UNIDENTIFIED_{parameter.upper()}"]


@dataclass(frozen=True, eq=False)
class Measurement:
    """Fields before and behind the sample: ``response = g J illumination + noise`` in every pixel.

    Arrays are checked, kept as NumPy arrays and not copied. Single precision stays single precision.

    Parameters
    ----------
    illumination: complex ``(*P, 2, n)``, field before the sample in each of n states; leading axes may be absent or 1.
    response: complex ``(*P, 2, n)``, field behind it, same unit. A value that is not finite makes its pixel
        ``Status.NON_FINITE`` if its weight is > 0.
    sigma: float, broadcasts to P: ``E|noise|^2 = sigma^2`` in each complex component, unit of the response, > 0.
        None: unknown.
    weight: float ``(*P, n)`` >= 0: the noise variance of state k is ``sigma^2 / weight_k``; 0 = state missing.
    mask: bool, broadcasts to P: True = use.
    seed: seed of the generator that made a simulated measurement, else None.

    Raises
    ------
    ValueError, TypeError: shapes that do not fit, values out of range, a mask without a True.

    >>> measurement = Measurement(np.eye(2), np.ones((3, 4, 2, 2)), sigma=0.1)
    >>> measurement.shape, measurement.states
    ((3, 4), 2)
    """

    illumination: np.ndarray = array(("*P", "polarisation", "state"), "1")
    response: np.ndarray = array(("*P", "polarisation", "state"), "1")
    sigma: np.ndarray | None = array(("*P",), "1", default=None)
    weight: np.ndarray | None = array(("*P", "state"), "1", default=None)
    mask: np.ndarray | None = array(("*P",), "1", default=None)
    seed: int | None = None

    def __post_init__(self) -> None:
        illumination = checks.complex_array("illumination", self.illumination, trailing=(2, None), finite=True)
        response = checks.complex_array("response", self.response, trailing=(2, None))
        if illumination.shape[-1] != response.shape[-1]:
            raise ValueError(
                f"illumination has {illumination.shape[-1]} states and response {response.shape[-1]}; the last axes "
                "must be equally long."
            )
        if response.shape[-1] == 0:
            raise ValueError("response must have at least one illumination state, got 0.")
        shapes = {"response": response.shape[:-2], "illumination": illumination.shape[:-2]}
        sigma, weight, mask = self.sigma, self.weight, self.mask
        if sigma is not None:
            sigma = checks.real_array("sigma", sigma, above=0, finite=True)
            shapes["sigma"] = sigma.shape
        if weight is not None:
            weight = checks.real_array("weight", weight, trailing=(response.shape[-1],), low=0, finite=True)
            shapes["weight"] = weight.shape[:-1]
        if mask is not None:
            mask = checks.boolean_array("mask", mask)
            if not mask.any():
                raise ValueError("mask has no True: there is no pixel to use; True means use.")
            shapes["mask"] = mask.shape
        checks.broadcast(**shapes)
        for name, value in zip(
            ("illumination", "response", "sigma", "weight", "mask"),
            (illumination, response, sigma, weight, mask),
            strict=True,
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def from_jones(cls, jones: Any, sigma: Any) -> Measurement:
        """A measurement of whole Jones matrices: the illumination is the identity, n = 2.

        Parameters
        ----------
        jones: complex ``(*P, 2, 2)``. sigma: float, broadcasts to P, > 0, in the unit of jones.

        >>> Measurement.from_jones(np.zeros((5, 2, 2)), 0.1).shape
        (5,)
        """
        response = checks.complex_array("jones", jones, trailing=(2, 2))
        return cls(np.eye(2, dtype=response.dtype), response, sigma)

    @property
    def shape(self) -> tuple[int, ...]:
        """Pixel shape P."""
        shapes = [self.response.shape[:-2], self.illumination.shape[:-2]]
        shapes += [a.shape for a in (self.sigma, self.mask) if a is not None]
        shapes += [] if self.weight is None else [self.weight.shape[:-1]]
        return np.broadcast_shapes(*shapes)

    @property
    def states(self) -> int:
        """Number n of illumination states."""
        return int(self.response.shape[-1])


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of :func:`polinfer.fit`: the most probable parameters of every pixel and a local Gaussian around them.

    Angles in radians, shape P. A pixel without an answer is NaN and flagged in ``status``.

    Attributes
    ----------
    parameters: maximum of the posterior density, the canonical one of the equivalent sets.
    std: standard deviations; 0 for fixed parameters, NaN for those that drop out of J.
    covariance: ``(*P, 5, 5)``, inverse of the negative Hessian of the log posterior at the maximum, in the order of
        :class:`Parameters`; rows of fixed and dropped parameters are 0.
    log_posterior: log likelihood plus log prior at the maximum, nuisances marginalised, normalised (nats).
    log_evidence: Laplace approximation, summed over all equivalent parameter sets (nats).
    tilt: :class:`polinfer.misalignment.Tilt`, the phase between the arms and its uncertainty, None if the model has no
        :class:`TiltPlane`. With one, parameters and log_posterior are given its most probable value; std and covariance
        take its uncertainty in, and log_evidence has its price, in equal shares of the pixels of a frame.
    sigma: noise used. gain: posterior mean of the complex gain at the maximum, None if the model has none.
    status: :class:`Status` bits. chi_square: ``2 |residual|^2 / sigma^2`` at the maximum, to be compared with
    degrees_of_freedom: real data less fitted parameters and gain, at least 0. Where sigma was inferred it is
        that of :attr:`sigma`, and says little; widths are then those of Student's distribution (scope "pixel").
    started_from_fit: whether an earlier fit was given as start.
    """

    model: Model
    parameters: Parameters = array(("*P",), "rad")
    std: Parameters = array(("*P",), "rad")
    covariance: np.ndarray = array(("*P", "row", "column"), "1, rad or rad^2")
    log_posterior: np.ndarray = array(("*P",), "nat")
    log_evidence: np.ndarray = array(("*P",), "nat")
    sigma: np.ndarray = array(("*P",), "1")
    gain: np.ndarray | None = array(("*P",), "1")
    status: np.ndarray = array(("*P",), "1")
    chi_square: np.ndarray = array(("*P",), "1")
    degrees_of_freedom: np.ndarray = array(("*P",), "1")
    started_from_fit: bool = False
    tilt: Tilt | None = None

    def interval(self, level: float) -> tuple[Parameters, Parameters]:
        """Central interval of the local Gaussian that holds probability ``level`` (0 < level < 1).

        For an angle it is the arc from low to high, which may cross the wrap; if it is wider than the period it is
        the whole circle around the maximum. D, and a bounded retardance, are cut at their bounds.
        """
        from scipy.special import ndtri

        level = checks.real_number("level", level, above=0, high=1)
        factor = float(ndtri(0.5 + 0.5 * level))
        lows, highs = [], []
        for name in Parameters._fields:
            centre, width = getattr(self.parameters, name), factor * getattr(self.std, name)
            bounds = self.model.bounds.get(name)
            if bounds is not None:
                lows.append(np.maximum(centre - width, bounds[0]).astype(centre.dtype))
                highs.append(np.minimum(centre + width, bounds[1]).astype(centre.dtype))
                continue
            period = getattr(PERIODS, name)
            width = np.minimum(width, 0.5 * period)
            for ends, value in ((lows, centre - width), (highs, centre + width)):
                ends.append((value - period * np.ceil(value / period - 0.5)).astype(centre.dtype))
        return Parameters(*lows), Parameters(*highs)

    def to_dataset(self) -> Any:
        """The fit as a labelled :class:`xarray.Dataset`: ``parameters.retardance``, ``std.retardance``, with units."""
        return storage.to_dataset(self)

    def plot(self, smooth: bool = False, pixel_size: float | None = None) -> Figure:
        """Maps of the parameters with their uncertainty below, see :func:`polinfer.plots.plot_fit`.

        ``smooth`` shows the equivalent parameters that :func:`polinfer.smooth_gauge` chooses, ``pixel_size`` (metres)
        adds a scale bar.
        """
        from .plots import plot_fit

        return plot_fit(self, smooth=smooth, pixel_size=pixel_size)
