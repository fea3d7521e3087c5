"""Smoothed importance weights and leave-one-out densities, against closed forms and arviz."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import genpareto

from polinfer import ComplexGain, Measurement, Model, Parameters
from polinfer.comparison import leave_one_out
from polinfer.comparison.pareto import fit_generalised_pareto, smoothed_log_weights


@pytest.mark.parametrize("k", [-0.3, 0.0, 0.4, 0.9])
def test_a_generalised_pareto_distribution_is_recovered(k):
    """The estimate is drawn to 0.5 with the weight of ten draws, which is taken back here."""
    n = 20_000
    excess = genpareto.ppf((np.arange(n) + 0.5) / n, k, scale=3.0)
    found, scale = fit_generalised_pareto(np.stack([excess, 7 * excess]))
    np.testing.assert_allclose((found * (n + 10) - 5) / n, k, atol=0.01)
    np.testing.assert_allclose(scale, [3.0, 21.0], rtol=0.02)


def test_smoothing_agrees_with_arviz():
    arviz = pytest.importorskip("arviz")
    ratios = np.random.default_rng(1).standard_t(3, (4, 2, 1000))
    ratios[..., 0] += 8  # one heavy weight
    weights, k = smoothed_log_weights(ratios)
    for index in np.ndindex(4, 2):
        expected, shape = arviz.psislw(ratios[index], 1.0)
        np.testing.assert_allclose(k[index], shape, rtol=1e-6)
        np.testing.assert_allclose(weights[index], np.asarray(expected), atol=1e-6)


def test_weights_sum_to_one_keep_their_order_and_equal_ratios_stay_equal():
    ratios = np.random.default_rng(2).normal(0, 2, (3, 500))
    ratios[2] = 5.0
    weights, k = smoothed_log_weights(ratios)
    np.testing.assert_allclose(np.exp(weights).sum(axis=-1), 1)
    np.testing.assert_allclose(weights[2], -np.log(500))
    assert k[2] == -np.inf
    assert np.all(np.diff(np.take_along_axis(weights[:2], np.argsort(ratios[:2]), -1)) >= -1e-12)


def conjugate(states, sigma, draws, rng, weight=None):
    """Draws of a gain that is all there is to know, and the densities that leave one state out, in closed form."""
    pixels, n = 20, states.shape[1]
    scale = 0.7
    truth = scale * (rng.normal(size=pixels) + 1j * rng.normal(size=pixels)) / 2**0.5
    noise = sigma * (rng.normal(size=(pixels, 2, n)) + 1j * rng.normal(size=(pixels, 2, n))) / 2**0.5
    response = truth[:, None, None] * states + noise
    data = Measurement(states, response, sigma, weight=weight)
    w = np.ones(n) if weight is None else weight

    def posterior(kept):
        precision = np.sum(w[kept] * np.sum(np.abs(states[:, kept]) ** 2, axis=0)) / sigma**2 + 1 / scale**2
        mean = np.sum(w[kept] * np.sum(states[:, kept].conj() * response[..., kept], axis=-2), axis=-1) / sigma**2
        return mean / precision, 1 / precision

    mean, variance = posterior(np.arange(n))
    gain = mean + np.sqrt(variance / 2) * (
        rng.normal(size=(4, draws, pixels)) + 1j * rng.normal(size=(4, draws, pixels))
    )
    expected = np.zeros((pixels, n))
    for k in np.flatnonzero(w):
        mean, variance = posterior(np.delete(np.arange(n), k))
        u = states[:, k]
        cover = sigma**2 / w[k] * np.eye(2) + variance * np.outer(u, u.conj())
        rest = response[..., k] - mean[:, None] * u
        square = np.einsum("pi,ij,pj->p", rest.conj(), np.linalg.inv(cover), rest).real
        expected[:, k] = -square - np.log(np.pi**2 * np.linalg.det(cover).real)
    zero = np.zeros((4, draws, pixels))
    fixed = {"diattenuation": 0.0, "retardance": 0.0}
    model = Model(gain=ComplexGain(scale), fixed=fixed)
    return SimpleNamespace(
        model=model, measurement=data, parameters=Parameters(*[zero] * 5), gain=gain, sigma=None, tilt=None
    ), expected


def test_leave_one_out_is_the_predictive_density_of_each_state():
    rng = np.random.default_rng(3)
    states = rng.normal(size=(2, 5)) + 1j * rng.normal(size=(2, 5))
    weight = np.array([1.0, 0.5, 0.0, 2.0, 1.0])
    draws, expected = conjugate(states, 0.5, 8000, rng, weight)
    found = leave_one_out(draws)
    off = np.abs(found.state - expected)
    assert np.all(off[found.pareto_k < 0.5] < 0.06)
    assert np.all(off[found.pareto_k < 0.7] < 0.2)
    assert np.mean(found.pareto_k < 0.7) > 0.9
    np.testing.assert_allclose(found.log_density, found.state.sum(axis=-1))
    np.testing.assert_array_equal(found.trusted, np.all(found.pareto_k <= 0.7, axis=-1))
    assert np.all(found.state[:, 2] == 0)  # the missing one


def test_leave_one_out_needs_the_draws_of_what_is_inferred():
    draws, _ = conjugate(np.eye(2, dtype=complex), 0.5, 100, np.random.default_rng(4))
    draws.gain = None
    with pytest.raises(ValueError, match="no gain"):
        leave_one_out(draws)
