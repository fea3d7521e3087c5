"""Distances from a truth are standard normal where the fit's uncertainty is right, and not where it is wrong."""

from dataclasses import replace

import numpy as np
import pytest

import polinfer
from polinfer import ComplexGain, Model, Parameters
from polinfer.degeneracy import orbit
from polinfer.validation import standardised_errors

STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)
TRUTH = Parameters(0.4, 1.5, 2.0, -1.4, np.full((20, 50), 0.6))  # axes near the end of their range
COUNT = 1000


@pytest.fixture(scope="module", params=[Model(), Model(gain=ComplexGain(1.0))], ids=["unit", "complex"])
def fit(request):
    gain = None if request.param == Model() else np.full((20, 50), 0.8 * np.exp(1j))
    return polinfer.fit(request.param, polinfer.simulate(request.param, TRUTH, STATES, 0.01, rng=3, gain=gain))


def test_they_are_standard_normal(fit):
    for z in standardised_errors(fit, TRUTH):
        assert z.shape == (20, 50)
        assert abs(z.mean()) < 5 / COUNT**0.5
        assert abs((z**2).mean() - 1) < 5 * (2 / COUNT) ** 0.5


@pytest.mark.parametrize("copy", range(8))
def test_equivalent_truths_are_one_truth(fit, copy):
    other = Parameters(*(x[copy] for x in orbit(TRUTH)))
    for z, same in zip(standardised_errors(fit, other), standardised_errors(fit, TRUTH), strict=True):
        np.testing.assert_allclose(z, same, atol=1e-9)


def test_wrong_uncertainty_shows_and_none_is_nan(fit):
    narrow = replace(fit, std=Parameters(*(0.5 * np.asarray(x) for x in fit.std)))
    for z, twice in zip(standardised_errors(fit, TRUTH), standardised_errors(narrow, TRUTH), strict=True):
        np.testing.assert_allclose(twice, 2 * z)
    none = replace(fit, std=Parameters(*(np.where(np.arange(50) == 7, bad, x) for bad, x in
                                         zip((0, np.nan, np.inf, 0, np.nan), fit.std, strict=True))))  # fmt: skip
    for z in standardised_errors(none, TRUTH):
        assert np.isnan(z[:, 7]).all()
        assert np.isfinite(np.delete(z, 7, axis=1)).all()


def test_what_does_not_fit_together_is_named(fit):
    with pytest.raises(TypeError, match="fit must be"):
        standardised_errors(TRUTH, TRUTH)
    with pytest.raises(TypeError, match="truth must be"):
        standardised_errors(fit, TRUTH.retardance)
    with pytest.raises(ValueError, match="truth"):
        standardised_errors(fit, TRUTH._replace(retardance=np.zeros((3, 20, 50))))
    with pytest.raises(ValueError, match="truth"):
        standardised_errors(fit, TRUTH._replace(retardance=np.zeros((20, 49))))
