"""How far a fit is from a known truth, in units of its own uncertainty."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .checks import broadcast, complex_array, one_of_types, real_array
from .degeneracy import nearest, orbit
from .orderings import Ordering
from .records import PERIODS, Fit, Parameters

__all__ = ["jones_chi_square", "standardised_errors"]


def jones_chi_square(fit: Fit, jones: Any) -> tuple[np.ndarray, np.ndarray]:
    r"""Squared distance of the fitted from the true Jones matrix, in units of the fit's covariance.

    Angles are not compared, for they jump at degenerate points; the eight elements of J (real and imaginary) do not
    depend on which of the equivalent parameter sets is reported. With :math:`G = dJ/d(\mathrm{parameters})`,

    .. math:: \chi^2 = \delta^T (P G C G^T P)^+ \delta, \quad \delta = P (J_{fit} - J_{true})

    where C is the fit's covariance. With a free gain the true matrix is scaled and turned onto the fitted one, and P
    takes out the directions that the gain covers (J and iJ; only iJ for a :class:`PhaseGain`), so a true matrix may
    carry any complex factor. Its expectation is the second value returned: the number of directions in which the fit
    claims an uncertainty, 5 where all parameters are free and none degenerate.

    Parameters
    ----------
    fit: pixel shape P. jones: complex ``(*P, 2, 2)``, the truth.

    Returns
    -------
    chi_square, degrees_of_freedom: shape P; NaN and 0 where the fit has no answer.

    Raises
    ------
    ValueError, TypeError: shapes and types.

    >>> import polinfer
    >>> truth = Parameters(0.3, 0.5, 1.2, 0.4, np.full(400, 0.2))
    >>> model = polinfer.Model()
    >>> states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    >>> result = polinfer.fit(model, polinfer.simulate(model, truth, states, sigma=0.01, rng=1))
    >>> chi_square, freedom = jones_chi_square(result, model.jones(truth))
    >>> bool(abs(chi_square.sum() / freedom.sum() - 1) < 5 * (2 / freedom.sum()) ** 0.5)
    True
    """
    one_of_types("fit", fit, (Fit,), "pass the result of fit().")
    truth = complex_array("jones", jones, trailing=(2, 2))
    shape = fit.status.shape
    if truth.shape[:-2] != shape:
        raise ValueError(f"jones has pixel shape {truth.shape[:-2]}, the fit {shape}; they must agree.")
    model = fit.model
    complete = model.complete(Parameters(*(np.asarray(x, float) for x in fit.parameters)))
    points = np.stack([np.broadcast_to(np.asarray(x, float), shape).ravel() for x in complete], axis=-1)
    known = np.isfinite(points).all(-1)

    safe = jnp.asarray(np.where(known[:, None], points, 0.1))
    fitted, slope = (np.asarray(x, float) for x in _elements(model.ordering, safe))
    true = truth.reshape(-1, 4).astype(complex)
    if model.known_gain.free_phase:
        matrix = fitted[:, :4] + 1j * fitted[:, 4:]
        overlap = (np.conj(true) * matrix).sum(-1)
        if model.known_gain.real_parameters == 1:
            factor = overlap / np.abs(overlap)
        else:
            factor = overlap / (np.abs(true) ** 2).sum(-1)
        true = true * factor[:, None]
    delta = np.concatenate([true.real, true.imag], -1) - fitted
    directions = np.zeros((len(points), 8, 0))
    if model.known_gain.free_phase:
        turned = np.concatenate([-fitted[:, 4:], fitted[:, :4]], -1)
        parts = [turned] if model.known_gain.real_parameters == 1 else [turned, fitted]
        directions = np.stack([part / np.linalg.norm(part, axis=-1, keepdims=True) for part in parts], -1)
    project = np.eye(8) - directions @ directions.swapaxes(-1, -2)
    slope, delta = project @ slope, (project @ delta[..., None])[..., 0]
    covariance = np.where(known[:, None, None], np.asarray(fit.covariance, float).reshape(-1, 5, 5), 0)
    known = known & np.isfinite(covariance).all((-1, -2))
    spread = slope @ np.where(known[:, None, None], covariance, 0) @ slope.swapaxes(-1, -2)
    values, vectors = np.linalg.eigh(spread)
    claimed = values > 1e-6 * values[:, -1:]
    along = np.einsum("nij,ni->nj", vectors, delta) ** 2
    chi_square = np.where(claimed, along / np.where(claimed, values, 1), 0).sum(-1)
    freedom = np.where(known, claimed.sum(-1), 0)
    return np.where(known, chi_square, np.nan).reshape(shape), freedom.reshape(shape)


def standardised_errors(fit: Fit, truth: Parameters) -> Parameters:
    r"""How far every fitted parameter is from the truth, in units of its own standard deviation.

    .. math:: z_k = (p_k - q_k) / \mathrm{std}_k

    with differences of angles wrapped, and q that one of the truth's eight equivalent sets that is nearest to the fit.
    For an ordinary pixel z is standard normal. It is not where a parameter is hardly determined (an angle cannot be
    further off than half its period): choose by the bound of the truth, :func:`polinfer.cramer_rao_bound`, and not by
    the error found.

    Parameters
    ----------
    fit: pixel shape P. truth: broadcasts to P, radians.

    Returns
    -------
    Parameters of shape P; NaN where the fit states no standard deviation, and for fixed parameters.

    Raises
    ------
    ValueError, TypeError: shapes and types.

    >>> import polinfer
    >>> truth = Parameters(0.3, 0.5, 1.2, 0.4, np.full(400, 0.2))
    >>> model = polinfer.Model()
    >>> states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    >>> result = polinfer.fit(model, polinfer.simulate(model, truth, states, sigma=0.01, rng=1))
    >>> z = standardised_errors(result, truth)
    >>> bool(abs(np.mean(z.retardance**2) - 1) < 5 * (2 / 400) ** 0.5)
    True
    """
    one_of_types("fit", fit, (Fit,), "pass the result of fit().")
    one_of_types("truth", truth, (Parameters,), "pass the five true parameters as Parameters(...).")
    shape = fit.status.shape
    true = Parameters(*(real_array(f"truth.{n}", x).astype(float) for n, x in zip(truth._fields, truth, strict=True)))
    if broadcast(fit=shape, **{f"truth.{n}": x.shape for n, x in zip(truth._fields, true, strict=True)}) != shape:
        raise ValueError(f"truth has more pixels than the fit, whose shape is {shape}; they must agree.")
    found = Parameters(*(np.asarray(x, float) for x in fit.parameters))
    near = nearest(orbit(Parameters(*(np.broadcast_to(x, shape) for x in true))), found)
    errors = []
    for value, own, period, std in zip(found, near, PERIODS, fit.std, strict=True):
        apart = value - own
        if np.isfinite(period):
            apart = apart - period * np.round(apart / period)
        known = np.isfinite(std) & (np.asarray(std) > 0)
        errors.append(np.where(known, apart / np.where(known, std, 1), np.nan))
    return Parameters(*errors)


@partial(jax.jit, static_argnums=0)
def _elements(ordering: Ordering, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Real and imaginary parts of J ``(pixels, 8)`` and their derivatives by the parameters ``(pixels, 8, 5)``."""

    def elements(vector: jax.Array) -> jax.Array:
        flat = ordering.jones(Parameters(*vector)).ravel()
        return jnp.concatenate([flat.real, flat.imag])

    return jax.vmap(elements)(points), jax.vmap(jax.jacfwd(elements))(points)
