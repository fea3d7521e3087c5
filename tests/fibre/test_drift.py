"""Drift is followed as well as its references allow, and says how well."""

import numpy as np
import pytest

from fibre import Bundle, Drift, Fibrelets, load, save, track_drift

BUNDLE = Bundle.hexagonal(radius=20e-6, rng=0)
FIBRELETS = Fibrelets(BUNDLE.centres, BUNDLE.mode_radius)
COUNT = BUNDLE.cores
RATES = (2e-4, 1e5)  # rad^2/s: 0.11 rad a minute; (rad/m)^2/s: 2.4e3 rad/m a minute, 0.05 rad over the facet


class Walk:
    """Random walks of piston and tilt at all times, and noisy references at some of them."""

    def __init__(self, seed, references=12, interval=60.0, noise=0.05, rates=RATES, lit=15e-6):
        rng = np.random.default_rng(seed)
        self.times = np.arange(references) * interval
        self.between = self.times[:-1] + interval * rng.uniform(0, 1, references - 1)
        every = np.sort(np.concatenate([self.times, self.between]))
        steps = np.sqrt(np.diff(every, prepend=0.0))[:, None]
        walk = np.cumsum(steps * rng.standard_normal((len(every), 3)) * np.sqrt([rates[0], rates[1], rates[1]]), axis=0)
        self.state = walk[np.searchsorted(every, self.times)]
        self.state_between = walk[np.searchsorted(every, self.between)]
        shape = np.exp(-(BUNDLE.centres**2).sum(1) / lit**2)
        self.template = shape * np.exp(2j * np.pi * rng.random((2, COUNT)))
        self.variance = np.full((references, 2, COUNT), noise**2)
        unit = rng.standard_normal((references, 2, COUNT, 2)) @ np.array([1, 1j]) / 2**0.5
        self.fields = self.turned(self.template, self.state) + noise * unit

    @staticmethod
    def turned(field, state):
        """A field (2, m) moved to every state (n, 3)."""
        return field * np.exp(1j * (state[:, :1] + state[:, 1:] @ BUNDLE.centres.T))[:, None]

    def fisher(self):
        """Covariance (n, 3, 3) of each reference's state about the middle, plain NumPy."""
        design = np.concatenate([np.ones((COUNT, 1)), BUNDLE.centres], axis=1)
        result = []
        for variance in self.variance:
            weight = 2 * (np.abs(self.template) ** 2 / variance).sum(0)
            result.append(np.linalg.inv((design * weight[:, None]).T @ design))
        return np.array(result)

    def oracle(self, rates=RATES):
        """Covariance (t, 3, 3) between the references of a dense Gaussian process that knows rates and noise."""
        n, covariance = len(self.times), self.fisher()
        result = np.empty((len(self.between), 3, 3))
        for k, rate in enumerate([rates[0], rates[1], rates[1]]):
            # Brownian covariance, from a start of which nothing is known
            start = 1e6 * max(rate * np.ptp(self.times), covariance[:, k, k].max())
            own = rate * np.minimum.outer(self.times, self.times) + start
            across = rate * np.minimum.outer(self.between, self.times) + start
            here = rate * self.between + start
            gain = np.linalg.solve(own + np.diag(covariance[:, k, k]), across.T)
            result[:, k, k] = here - np.sum(across.T * gain, axis=0)
        assert n == len(covariance)
        return np.diagonal(result, axis1=1, axis2=2)


def residual(walk, drift, times, state):
    """Error (t, 3) of piston and tilt about the middle, modulo the common one that references cannot tell."""
    piston, tilt, _ = drift.at(times)
    found = np.concatenate([(piston - tilt @ drift.centre)[:, None], tilt], axis=1)
    at_references = np.concatenate([(drift.piston - drift.tilt @ drift.centre)[:, None], drift.tilt], axis=1)
    common = np.average(at_references - walk.state, axis=0)
    return found - state - common


def test_between_references_the_error_is_that_of_an_oracle():
    squares, bound = [], []
    for seed in range(40):
        walk = Walk(seed)
        drift = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
        squares.append(residual(walk, drift, walk.between, walk.state_between) ** 2)
        bound.append(walk.oracle())
    ratio = np.sqrt(np.mean(squares, axis=(0, 1)) / np.mean(bound, axis=(0, 1)))
    assert np.all(ratio < 1.2)
    assert np.all(ratio > 0.85)  # 440 times of each: 3 % of scatter


def test_the_stated_uncertainty_is_the_error():
    z = []
    for seed in range(40):
        walk = Walk(100 + seed)
        drift = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
        _, _, covariance = drift.at(walk.between)
        error = residual(walk, drift, walk.between, walk.state_between)
        z.append(error[:, 1:] / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, 1:]))
    assert abs(np.sqrt(np.mean(np.square(z))) - 1) < 0.1  # 880 numbers, in which rates are shared by 22


def test_the_rates_are_found_within_their_scatter():
    found = [track_drift(w.fields, w.times, FIBRELETS, w.variance).rates for w in (Walk(s, 40) for s in range(8))]
    # 39 steps: a relative error of sqrt(2 / 39) in each walk, over eight walks
    np.testing.assert_allclose(np.mean(found, axis=0), RATES, rtol=3 * np.sqrt(2 / 39 / 8))


def test_a_tilt_of_many_cycles_is_found_at_once():
    walk = Walk(3, references=3, noise=0.02, rates=(0.0, 0.0))
    state = np.array([[0, 0, 0], [0.5, 3.1e5, -2.2e5], [-1.0, -4e5, 1e5]])  # up to two cycles over the facet
    fields = walk.fields * np.exp(1j * (state[:, :1] + state[:, 1:] @ BUNDLE.centres.T))[:, None]
    drift = track_drift(fields, walk.times, FIBRELETS, walk.variance)
    found = drift.tilt - drift.tilt[0]
    np.testing.assert_allclose(found, state[:, 1:], atol=2e3)


def test_corrected_fields_are_the_undrifted_ones():
    walk = Walk(5, noise=0.01)
    drift = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
    rng = np.random.default_rng(0)
    sample = rng.standard_normal((2, COUNT)) + 1j * rng.standard_normal((2, COUNT))
    drifted = walk.turned(sample, walk.state_between)
    corrected = drift.correct(drifted, walk.between, FIBRELETS)
    common = np.angle(np.einsum("cpm,pm->m", corrected, sample.conj()))
    left = corrected * np.exp(-1j * common) / sample
    phase_error = np.angle(left)[:, 0]
    stated = drift.phase_variance(walk.between, FIBRELETS)
    assert np.sqrt(np.mean(phase_error**2)) < 1.3 * np.sqrt(np.mean(stated))
    before = np.angle(drifted / sample)
    assert np.sqrt(np.mean(phase_error**2)) < 0.3 * np.sqrt(np.mean((before - before.mean(0)) ** 2))


def test_unusable_fibrelets_may_hold_anything():
    walk = Walk(6)
    fields, variance = walk.fields.copy(), walk.variance.copy()
    fields[:, :, ::5], variance[:, :, ::5] = 100, np.inf
    found = track_drift(fields, walk.times, FIBRELETS, variance)
    usual = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
    np.testing.assert_allclose(found.tilt - found.tilt[0], usual.tilt - usual.tilt[0], atol=2e3)


def test_without_variances_the_noise_is_what_the_template_leaves():
    walk = Walk(7)
    found = track_drift(walk.fields, walk.times, FIBRELETS)
    told = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
    np.testing.assert_allclose(found.covariance, told.covariance, rtol=0.1, atol=1e-6 * told.covariance.max())


def test_a_single_reference_moves_nothing():
    walk = Walk(8, references=2)
    drift = track_drift(walk.fields[:1], walk.times[:1], FIBRELETS, walk.variance[:1])
    np.testing.assert_allclose(drift.correct(walk.fields, walk.times, FIBRELETS), walk.fields)
    assert drift.rates.tolist() == [0, 0]


def test_a_drift_is_saved_and_loaded(tmp_path):
    walk = Walk(9)
    drift = track_drift(walk.fields, walk.times, FIBRELETS, walk.variance)
    again = load(save(drift, tmp_path / "drift.nc"))
    np.testing.assert_array_equal(again.at([17.0])[2], drift.at([17.0])[2])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"times": [0.0, 0.0]}, "times must ascend"),
        ({"variance": np.ones((2, 2, 3))}, "variance must have the shape of fields"),
        ({"fields": np.zeros((2, 2, COUNT))}, "fields hold no light"),
        ({"rates": (-1.0, 0.0)}, "rates"),
    ],
)
def test_bad_input_is_named(change, words):
    walk = Walk(1, references=2)
    given = {"fields": walk.fields, "times": walk.times, "fibrelets": FIBRELETS, "variance": walk.variance} | change
    with pytest.raises(ValueError, match=words):
        track_drift(**given)


def test_a_lone_reference_needs_its_noise():
    walk = Walk(1, references=2)
    with pytest.raises(ValueError, match="variance must be given for a single reference"):
        track_drift(walk.fields[:1], walk.times[:1], FIBRELETS)
    with pytest.raises(ValueError, match="rates must be >= 0"):
        Drift(np.zeros(1), np.zeros(1), np.zeros((1, 2)), np.zeros((1, 3, 3)), np.array([-1.0, 0]), np.zeros(2))
