"""The closed-form screen of the ordering: right without noise, free of bias with it."""

from dataclasses import replace

import numpy as np
import pytest

import polinfer
from polinfer import Measurement, Model, Parameters, PolariserFirst, RetarderFirst
from polinfer.comparison import ordering_screen

BALANCED = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
SKEW = np.array([[1, 0.9, 0.7], [0.1, 0.5j, 0.4 - 0.3j]])
ORDERINGS = (RetarderFirst(), PolariserFirst())


def truths(count, diattenuation, seed=1):
    x = np.random.default_rng(seed).uniform(-0.5, 0.5, (4, count)) * np.pi
    return Parameters(np.full(count, diattenuation), x[0], 2 * x[1], x[2], 2 * x[3])


@pytest.mark.parametrize("which", [0, 1])
def test_without_noise_the_statistics_are_those_of_the_matrices_and_one_is_zero(which):
    jones = 1.7j * np.asarray(ORDERINGS[which].jones(truths(50, 0.4)))
    found = ordering_screen(Measurement(SKEW, jones @ SKEW, sigma=1e-7))
    adjoint = jones.conj().swapaxes(-1, -2)
    np.testing.assert_allclose(
        found.statistic, [(jones @ adjoint)[:, 0, 1].imag, (adjoint @ jones)[:, 0, 1].imag], atol=1e-9
    )
    np.testing.assert_allclose(found.statistic[which], 0, atol=1e-9)
    assert np.abs(found.statistic[1 - which]).max() > 0.1
    assert found.verdict == found.models[which]


@pytest.mark.parametrize("states", [BALANCED, SKEW], ids=["balanced", "skew"])
@pytest.mark.parametrize("sigma", [0.02, 0.3])
@pytest.mark.parametrize("which", [0, 1])
def test_the_statistic_of_the_true_ordering_has_mean_zero_and_the_variance_that_is_stated(states, sigma, which):
    count = 20_000
    data = polinfer.simulate(Model(ORDERINGS[which]), truths(count, 0.3), states, sigma, rng=2)
    found = ordering_screen(data)
    own = found.statistic[which]
    assert abs(own.mean()) < 4.5 * own.std() / count**0.5
    assert abs(found.excess[which]) < 4.5 * found.excess_error[which]


def test_the_bias_that_is_subtracted_is_there():
    """Pure noise: the mean of Im (Jhat^H Jhat)_01 is 2 sigma^2 Im (S^-1)_01."""
    rng = np.random.default_rng(3)
    noise = 0.1 * (rng.normal(size=(2, 40_000, 2, 3)) / 2**0.5)
    response = noise[0] + 1j * noise[1]
    found = ordering_screen(Measurement(SKEW, response, sigma=0.1))
    estimate = response @ np.linalg.pinv(SKEW)
    raw = (estimate.conj().swapaxes(-1, -2) @ estimate)[:, 0, 1].imag
    bias = 2 * 0.1**2 * np.linalg.inv(SKEW @ SKEW.conj().T)[0, 1].imag
    np.testing.assert_allclose(raw - found.statistic[1], bias, rtol=1e-6)
    assert abs(bias) > 20 * raw.std() / len(raw) ** 0.5
    assert abs(raw.mean() - bias) < 4 * raw.std() / len(raw) ** 0.5
    np.testing.assert_allclose(found.z_score.std(axis=1), 1, atol=0.35)


@pytest.mark.parametrize("states", [BALANCED, SKEW], ids=["balanced", "skew"])
def test_without_diattenuation_few_scenes_get_a_verdict(states):
    verdicts = []
    for seed in range(100):
        data = polinfer.simulate(
            Model(fixed={"diattenuation": 0.0}), truths(300, 0.0, seed), states, 0.1, rng=seed + 999
        )
        verdicts.append(ordering_screen(data).verdict)
    assert np.mean(np.array(verdicts) != "undecided") <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def test_weights_masks_and_gains():
    data = polinfer.simulate(Model(), truths(40, 0.3), SKEW, 0.05, rng=4)
    mask = np.arange(40) > 4
    response = data.response.copy()
    response[7] = np.nan
    found = ordering_screen(replace(data, mask=mask, response=response))
    assert found.pixels == 34
    assert np.isnan(found.z_score[:, [0, 7]]).all()
    # a state of weight 2 is that state twice, each with weight 1
    twice = Measurement(SKEW[:, [0, 1, 2, 2]], data.response[..., [0, 1, 2, 2]], 0.05)
    heavy = Measurement(SKEW, data.response, 0.05, weight=np.array([1.0, 1.0, 2.0]))
    np.testing.assert_allclose(ordering_screen(twice).z_score, ordering_screen(heavy).z_score)
    gain = 3j * np.ones(40)
    turned = Measurement(SKEW, gain[:, None, None] * data.response, 3 * 0.05)
    np.testing.assert_allclose(ordering_screen(turned).z_score, ordering_screen(data).z_score)
    one = Measurement(SKEW[:, :1], data.response[..., :1], 0.05)
    assert ordering_screen(one).pixels == 0
    assert ordering_screen(one).verdict == "undecided"
    with pytest.raises(ValueError, match="sigma None"):
        ordering_screen(replace(data, sigma=None))
