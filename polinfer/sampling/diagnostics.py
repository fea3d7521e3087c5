"""Have the chains forgotten where they began, and how many independent draws are they worth?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft

from .. import storage
from ..model import Model
from ..records import Parameters, Status
from ..storage import array
from ..threads import each
from .blocks import blocks, flat, rows
from .invariants import invariants

__all__ = ["Diagnostics", "diagnose", "effective_sample_size", "least_effective", "split_r_hat"]

LEAST = 4  # draws of a chain: its halves need a variance
CONSTANT = 1e-14  # spread over size of values that differ by rounding only
NO_DRAWS = int(Status.MASKED | Status.NON_FINITE)


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """Convergence of the chains of every pixel, judged by what does not depend on the equivalent set.

    ``names``: the k functions, see :func:`polinfer.sampling.invariants.invariants`; where they are inferred also
    ``gain.size`` = log |g|, ``gain.cos`` and ``gain.sin`` of twice the phase of g (g and -g go with the same retarder)
    and ``sigma`` = log sigma. ``r_hat`` and ``ess``: split R-hat and effective sample size of each, ``(*P, k)``, NaN
    where there are no draws. A function that only rounding changes says nothing (R-hat 1, all draws effective), unless
    all of a pixel do: then no chain has moved (R-hat infinite, one effective draw).

    >>> made = Diagnostics(np.array([[1.0, 1.2]]), np.array([[900.0, 30.0]]), ("polariser.size", "retarder.w"))
    >>> made.worst_r_hat.tolist(), made.worst_ess.tolist(), made.converged().tolist()
    ([1.2], [30.0], [False])
    """

    r_hat: np.ndarray = array(("*P", "invariant"), "1")
    ess: np.ndarray = array(("*P", "invariant"), "1")
    names: tuple[str, ...] = ()

    @property
    def worst_r_hat(self) -> np.ndarray:
        """Largest split R-hat of every pixel, shape P."""
        return np.asarray(np.max(self.r_hat, axis=-1))

    @property
    def worst_ess(self) -> np.ndarray:
        """Smallest effective sample size of every pixel, shape P."""
        return np.asarray(np.min(self.ess, axis=-1))

    def converged(self, r_hat: float = 1.02, ess: float = 400.0) -> np.ndarray:
        """Where all R-hat are at most ``r_hat`` and all sample sizes at least ``ess``; bool, shape P, False for NaN.

        With 4 chains of 1000 draws and an autocorrelation time of 3 draws, R-hat of converged chains exceeds 1.01 in
        1 of 1000 cases, 1.02 in less than 1 of a million; a map has many cases.
        """
        return np.asarray((self.worst_r_hat <= r_hat) & (self.worst_ess >= ess))

    def to_dataset(self) -> Any:
        """As a labelled :class:`xarray.Dataset`, the names as coordinates."""
        return storage.to_dataset(self).assign_coords(invariant=list(self.names))


def _halves(values: np.ndarray) -> np.ndarray:
    """Chains ``(..., chain, draw)`` cut in halves, ``(..., 2 chain, draw // 2)``; an odd one out is left out."""
    draws = values.shape[-1]
    half = draws // 2
    parts = np.stack([values[..., :half], values[..., draws - half :]], axis=-2)
    return parts.reshape(*values.shape[:-2], 2 * values.shape[-2], half)


def _assess(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split R-hat, effective sample size, and whether rounding alone makes the draws differ, of ``(..., chain, draw)``.

    The autocovariance is that of the halves on average, so one transform back is enough.
    """
    chains = _halves(values)
    number, length = chains.shape[-2:]
    means = chains.mean(axis=-1)
    centred = chains - means[..., None]
    size = scipy.fft.next_fast_len(2 * length, real=True)
    spectrum = scipy.fft.rfft(centred, size, axis=-1)
    power = np.mean(spectrum.real**2 + spectrum.imag**2, axis=-2)
    covariance = scipy.fft.irfft(power, size, axis=-1)[..., :length] / length
    between = np.var(means, axis=-1, ddof=1)
    total = covariance[..., 0] + between
    constant = total <= (CONSTANT * np.max(np.abs(values), axis=(-1, -2))) ** 2
    safe = np.where(constant, 1.0, total)
    within = covariance[..., 0] * length / (length - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        r_hat = np.where(constant, 1.0, np.sqrt(safe / np.where(constant, 1.0, within)))
    correlation = 1 - (within[..., None] - covariance) / safe[..., None]
    correlation[..., 0] = 1
    count = number * length
    time = np.maximum(_geyer(correlation), 1 / np.log10(count))
    return r_hat, np.where(constant, float(count), count / time), constant


def _geyer(correlation: np.ndarray) -> np.ndarray:
    """Autocorrelation time: sums of pairs, up to the first that is negative, none larger than the one before."""
    length = max((correlation.shape[-1] - 1) // 2, 1) * 2
    even = correlation[..., 0:length:2]
    pairs = even + correlation[..., 1:length:2]
    negative = pairs < 0
    # the last pair has too few products behind it to be believed
    negative[..., -1] = True
    negative[..., 0] = False
    before = np.cumsum(negative, axis=-1) == 0
    first = np.argmax(negative, axis=-1)[..., None]
    left = np.take_along_axis(even, first, axis=-1)[..., 0] if even.shape[-1] > 1 else 0.0
    pairs = np.minimum.accumulate(pairs, axis=-1)
    # half of a pair may still be positive: it lowers the variance of the sum
    return np.asarray(2 * np.sum(np.where(before, pairs, 0), axis=-1) - 1 + np.maximum(left, 0))


def _checked(values: Any) -> np.ndarray:
    draws = np.asarray(values, float)
    if draws.ndim < 2 or draws.shape[0] < 1 or draws.shape[1] < LEAST:
        raise ValueError(f"values must have shape (chain, draw, ...) with at least {LEAST} draws, got {draws.shape}.")
    return np.moveaxis(draws, (0, 1), (-2, -1))


def split_r_hat(values: Any) -> np.ndarray:
    """Split R-hat: the spread of all draws over that within halves of chains; 1 where they cannot be told apart.

    ``R = sqrt(((n - 1)/n W + B) / W)``, with the mean variance W of the 2m halves of n draws and the variance B of
    their means. It is not rank-normalised: that helps against heavy tails, and the functions it is meant for are
    bounded.

    Parameters
    ----------
    values: real ``(chain, draw, *P)``, at least 4 draws; ValueError else.

    Returns
    -------
    Shape P; 1 where all draws are the same, infinite where those of each half are.

    Source: Gelman et al., Bayesian Data Analysis, 3rd edition, 2013, section 11.4.

    >>> rng = np.random.default_rng(0)
    >>> float(split_r_hat(rng.normal(size=(4, 1000))).round(2))
    1.0
    >>> float(split_r_hat(rng.normal(size=(4, 1000)) + np.arange(4)[:, None])) > 1.5
    True
    """
    return _assess(_checked(values))[0]


def effective_sample_size(values: Any) -> np.ndarray:
    """How many independent draws have a mean as precise as that of the chains: ``m n / tau``.

    ``tau = -1 + 2 sum_k (rho_2k + rho_2k+1)``, the sum ended by Geyer's initial monotone sequence; the autocorrelation
    rho is that of the halves of all chains together and falls short of 1 where the halves disagree. At most
    ``m n log10(m n)``. Draws that are all the same count as independent. Where successive draws of a chain come from
    different walkers in turn, a memory of each walker for itself is not seen: thin until there is none.

    Parameters
    ----------
    values: real ``(chain, draw, *P)``, at least 4 draws; ValueError else.

    Returns
    -------
    Shape P.

    Source: Vehtari, Gelman, Simpson, Carpenter, Bürkner, "Rank-normalization, folding, and localization: an improved
    R-hat", Bayesian Analysis 16 (2021) 667, equations 10 to 13, here without the ranks.

    >>> independent = np.random.default_rng(0).normal(size=(4, 1000))
    >>> 3500 < float(effective_sample_size(independent)) < 4500
    True
    >>> 900 < float(effective_sample_size(np.repeat(independent[:, ::4], 4, axis=1))) < 1100
    True
    """
    return _assess(_checked(values))[1]


def _functions(
    model: Model, parameters: Parameters, gain: np.ndarray | None, sigma: np.ndarray | None
) -> dict[str, np.ndarray]:
    """What is judged; a size of 0 has no logarithm, and takes the least one."""
    tiny = np.finfo(float).tiny
    found = invariants(model, parameters)
    if gain is not None:
        size = np.abs(gain)
        if model.known_gain.real_parameters != 1:
            found["gain.size"] = np.log(np.maximum(size, tiny))
        turned = (gain / np.where(size > 0, size, 1)) ** 2
        found |= {"gain.cos": turned.real, "gain.sin": turned.imag}
    if sigma is not None:
        found["sigma"] = np.log(np.maximum(sigma, tiny))
    return found


def diagnose(
    model: Model, parameters: Parameters, gain: np.ndarray | None, sigma: np.ndarray | None, status: np.ndarray
) -> Diagnostics:
    """Diagnostics of draws ``(chain, draw, *P)`` of the pixels that have any, by ``status`` (P).

    >>> rng = np.random.default_rng(1)
    >>> draws = Parameters(*(0.5 + 0.1 * rng.normal(size=(5, 4, 250, 2))))
    >>> made = diagnose(Model(), draws, None, None, np.zeros(2, int))
    >>> made.r_hat.shape, made.converged().tolist()
    ((2, 7), [True, True])
    """
    status = np.asarray(status)
    good = np.flatnonzero((status & NO_DRAWS) == 0)
    number = int(np.prod(np.shape(parameters.diattenuation)[:2]))
    columns = [flat(x) for x in parameters]
    extra = [None if x is None else flat(x) for x in (gain, sigma)]
    none = np.zeros((1, 1, 1))
    names = tuple(_functions(model, Parameters(*[none] * 5), *(None if x is None else none for x in extra)))
    r_hat, ess = (np.full((status.size, len(names)), np.nan) for _ in range(2))
    parts = list(blocks(good, number))

    def judge(index: int) -> None:
        part = parts[index]
        values = Parameters(*(rows(x, part) for x in columns))
        stuck = np.ones(len(part), bool)
        found = _functions(model, values, *(None if x is None else rows(x, part) for x in extra))
        for k, name in enumerate(names):
            r_hat[part, k], ess[part, k], constant = _assess(found[name])
            stuck &= constant
        r_hat[part[stuck]], ess[part[stuck]] = np.inf, 1.0

    each(judge, range(len(parts)))
    shape = (*status.shape, len(names))
    return Diagnostics(r_hat.reshape(shape), ess.reshape(shape), names)


def least_effective(
    model: Model, parameters: Parameters, gain: np.ndarray | None, sigma: np.ndarray | None,
    wanted: Mapping[str, np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Smallest effective sample size of draws ``(chain, draw, pixel)``, of those functions and pixels only that matter.

    ``wanted``: names of the functions and for each a bool per pixel; infinite where none is wanted. Functions that the
    model keeps constant are passed over: only rounding changes them. In the draws' own precision.

    >>> rng = np.random.default_rng(1)
    >>> draws = Parameters(*(0.5 + 0.1 * rng.normal(size=(5, 4, 250, 2))))
    >>> found = least_effective(Model(), draws, None, None, {"retarder.w": np.array([True, False])})
    >>> bool(700 < found[0] < 1300), float(found[1])
    (True, inf)
    """
    count, draws = parameters.diattenuation.shape[-1], int(np.prod(parameters.diattenuation.shape[:2]))
    least = np.full(count, np.inf)
    parts = list(blocks(np.flatnonzero(np.any(list(wanted.values()), axis=0)), draws))

    def judge(index: int) -> None:
        part = parts[index]
        values = Parameters(*(rows(x, part, double=False) for x in parameters))
        found = _functions(model, values, *(None if x is None else rows(x, part, double=False) for x in (gain, sigma)))
        for name, needed in wanted.items():
            some = np.flatnonzero(needed[part])
            if len(some) and name in found:
                least[part[some]] = np.minimum(least[part[some]], _assess(found[name][some])[1])

    each(judge, range(len(parts)))
    return least
