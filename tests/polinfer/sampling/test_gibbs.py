"""Draws of the Gibbs sampler against weighted draws from the prior, which share nothing with it but the density."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from polinfer import (
    AxialVonMises,
    ComplexGain,
    Ensemble,
    Gibbs,
    InferredNoise,
    Measurement,
    Model,
    Ordering,
    Parameters,
    PhaseGain,
    PolariserFirst,
    RetarderFirst,
    Status,
    TruncatedNormal,
    VonMises,
    Window,
    fit,
    sample,
    simulate,
)  # fmt: skip
from polinfer.sampling import verb
from polinfer.sampling.gibbs import engine, kernel
from polinfer.sampling.gibbs.plan import plan
from polinfer.sampling.invariants import invariants

from ..scenes import BALANCED, UNBALANCED

COPIES, PRIOR_DRAWS = 48, 1_000_000
PRIORS = {
    "diattenuation": TruncatedNormal(0.3, 0.4, -1, 1),
    "retardance": VonMises(1.0, 2.0),
    "retardance_angle": AxialVonMises(0.3, 1.5),
    "circularity": VonMises(0.4, 1.5),
}
# every kind of conditional at least once; more combinations: python -m benchmarks calibration
CASES = {
    "unit gain": (Model(), BALANCED, 0.5),
    "second harmonics": (Model(), UNBALANCED, 0.6),
    "complex gain": (Model(PolariserFirst(), gain=ComplexGain(0.8)), BALANCED, 0.4),
    "priors, phase": (Model(priors=PRIORS, gain=PhaseGain()), UNBALANCED, 0.6),
    "sigma of every pixel": (Model(noise=InferredNoise(2.0, 0.3, "pixel")), BALANCED, 0.4),
    "one state": (Model(priors=PRIORS), np.array([[1.0], [0.4j]]), 0.5),
}


def prior_draws(model: Model, count: int, rng: np.random.Generator) -> Parameters:
    return Parameters(*(model.priors[name].sample(rng, (count,)) for name in Parameters._fields))


# each takes half a minute, most of it to compile
SLOW = {"unit gain", "sigma of every pixel", "one state", "second harmonics", "priors, phase"}


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in CASES])
def test_means_of_invariants_and_the_log_evidence(name):
    model, states, sigma = CASES[name]
    rng = np.random.default_rng(11)
    truth = Parameters(*(np.full(COPIES, x[0]) for x in prior_draws(Model(), 1, rng)))
    one = simulate(Model(model.ordering), Parameters(*(x[:1] for x in truth)), states, sigma, rng=3)
    known = model.noise.sigma(one) is not None if not isinstance(model.noise, InferredNoise) else False
    # the same data in every pixel: independent runs
    data = Measurement(states, np.repeat(one.response, COPIES, axis=0), sigma if known else None)
    draws = sample(model, data, draws=500, rng=5)
    assert not np.any(draws.status & int(Status.NOT_CONVERGED))
    ours = np.stack([np.asarray(x) for x in invariants(model, draws.parameters).values()]).mean(axis=(1, 2))
    points = prior_draws(model, PRIOR_DRAWS, rng)
    small = Measurement(states, one.response, sigma if known else None)
    log_weight = np.asarray(model.log_likelihood(points, small), float)
    weight = np.exp(log_weight - log_weight.max())
    if known:
        assert np.all(draws.log_evidence_error < 0.05)
        off = draws.log_evidence - np.log(weight.mean()) - log_weight.max()
        error = np.hypot(off.std(ddof=1) / COPIES**0.5, weight.std() / weight.mean() / PRIOR_DRAWS**0.5)
        assert abs(off.mean()) < 4.5 * error
        # the stated errors are the scatter
        assert 0.6 < off.std() / np.sqrt(np.mean(draws.log_evidence_error**2)) < 1.6
    else:
        assert np.isnan(draws.log_evidence).all()
    weight /= weight.sum()
    values = np.stack([np.asarray(x) for x in invariants(model, points).values()])
    mean = values @ weight
    error = np.sqrt((values - mean[:, None]) ** 2 @ weight**2)
    assert 1 / np.sum(weight**2) > 2000
    z = (ours.mean(axis=1) - mean) / np.hypot(ours.std(axis=1, ddof=1) / COPIES**0.5, error)
    # ten or so correlated numbers; 4.5 sigma
    assert np.abs(z).max() < 4.5


@pytest.mark.slow  # the general route of fit, twice
def test_draws_of_gain_and_sigma_belong_to_the_draws_of_the_parameters():
    model = Model(noise=InferredNoise(3.0, 0.02, "pixel"), gain=ComplexGain(1.0))
    truth = Parameters(*(np.full(16, x) for x in (0.3, 0.5, 1.2, 0.4, 0.2)))
    data = simulate(model, truth, BALANCED, 0.05, rng=1, gain=0.6 - 0.5j)
    draws = sample(model, replace(data, sigma=None), Gibbs(evidence=False), draws=400, rng=2)
    assert draws.gain is not None
    assert draws.sigma is not None
    off = draws.gain - (0.6 - 0.5j)
    assert np.abs(off.mean()) < 0.05
    assert np.abs(off).mean() > 0.01
    # given the rest, (scale + Q) / sigma^2 is a gamma variate of shape 3 + 6, whatever Q is
    matrices = np.asarray(model.jones(draws.parameters)) @ BALANCED
    square = np.sum(np.abs(draws.gain[..., None, None] * matrices - data.response) ** 2, axis=(-1, -2))
    assert abs(np.mean((0.02 + square) / draws.sigma**2) - 9) < 0.15


def test_one_sigma_of_the_frame():
    rng = np.random.default_rng(4)
    truth = prior_draws(Model(), 60, rng)
    data = simulate(Model(), truth, BALANCED, 0.1, rng=2)
    model = Model(noise=InferredNoise(2.0, 0.01, "frame"))
    draws = sample(model, replace(data, sigma=None), Gibbs(evidence=False), draws=300, rng=1)
    assert draws.sigma is not None
    assert np.ptp(draws.sigma, axis=-1).max() == 0
    sigma = draws.sigma[..., 0]
    # 60 pixels of 12 real data less five parameters: 2 n sigma^2 is known to sqrt(2 / 420)
    assert abs(sigma.mean() - 0.1) < 4 * 0.1 * (0.5 / 420) ** 0.5
    assert 0.8 < sigma.std() / (0.1 * (0.5 / 420) ** 0.5) < 1.25


def test_a_pixel_does_not_depend_on_the_rest_of_the_frame_and_a_window_is_taken():
    rng = np.random.default_rng(8)
    truth = Parameters(*(x.reshape(4, 5) for x in prior_draws(Model(), 20, rng)))
    data = simulate(Model(), truth, BALANCED, 0.05, rng=2)
    mask = np.ones((4, 5), bool)
    mask[:2] = False
    whole = sample(Model(), data, Gibbs(evidence=False), draws=25, rng=3)
    part = sample(Model(), replace(data, mask=mask), Gibbs(evidence=False), draws=25, rng=3)
    assert np.all(part.status[:2] == int(Status.MASKED))
    assert np.isnan(part.parameters.retardance[:, :, :2]).all()
    np.testing.assert_allclose(part.parameters.retardance[0, 0, 2:], whole.parameters.retardance[0, 0, 2:], atol=1e-9)
    same = Parameters(*(np.full((4, 5), x) for x in (0.3, 0.5, 1.2, 0.4, 0.2)))
    even = simulate(Model(), same, BALANCED, 0.05, rng=2)
    shared = sample(Model(neighbours=Window(3, 3)), even, Gibbs(evidence=False), draws=200, rng=3)
    alone = sample(Model(), even, Gibbs(evidence=False), draws=200, rng=3)
    ratio = shared.summary().std.retardance[1:3, 1:4] / alone.summary().std.retardance[1:3, 1:4]
    np.testing.assert_allclose(ratio, 1 / 3, rtol=0.25)


def test_every_draw_is_the_copy_nearest_to_the_fit():
    rng = np.random.default_rng(8)
    data = simulate(Model(), prior_draws(Model(), 64, rng), BALANCED, 0.02, rng=2)
    found, draws = fit(Model(), data), sample(Model(), data, Gibbs(evidence=False), draws=50, rng=1)
    sure = (found.status == 0) & (np.stack(list(found.std)).max(axis=0) < 0.05)
    assert sure.sum() > 15
    for name, period in zip(Parameters._fields, (np.inf, np.pi, 2 * np.pi, np.pi, 2 * np.pi), strict=True):
        off = (getattr(draws.parameters, name) - getattr(found.parameters, name))[..., sure]
        if np.isfinite(period):
            off = off - period * np.round(off / period)
        assert np.abs(off / getattr(found.std, name)[sure]).max() < 7


FIXED = [({"circularity": 0.4}, Gibbs(evidence=False))]
FIXED += [
    pytest.param(fixed, sampler, marks=pytest.mark.slow)
    for fixed, sampler in (
        ({"circularity": 0.4}, Ensemble(warmup=50, thin=2)),
        ({"retardance": 1.1}, Gibbs(evidence=False)),
        ({"diattenuation": 0.3}, Gibbs(evidence=False)),
    )
]


@pytest.mark.parametrize(("fixed", "sampler"), FIXED)
def test_with_a_part_fixed_all_draws_are_still_of_one_copy(fixed, sampler):
    model, truth = Model(fixed=fixed), Parameters(*(np.full(2, x) for x in (0.3, 0.5, 1.1, 0.4, 0.4)))
    data = simulate(model, truth, BALANCED, 0.01, rng=2)
    found, draws = fit(model, data), sample(model, data, sampler, draws=64, rng=1)
    for name, period in zip(Parameters._fields, (np.inf, np.pi, 2 * np.pi, np.pi, 2 * np.pi), strict=True):
        if name in fixed:
            np.testing.assert_allclose(getattr(draws.parameters, name), fixed[name], rtol=1e-6)
            continue
        off = getattr(draws.parameters, name) - getattr(found.parameters, name)
        if np.isfinite(period):
            off = off - period * np.round(off / period)
        assert np.abs(off / getattr(found.std, name)).max() < 7


class Third(RetarderFirst):
    """An ordering of a user's own."""


def test_what_it_cannot_draw_from_is_named():
    data = simulate(Model(), Parameters(0.3, 0.5, 1.2, 0.4, 0.2), BALANCED, 0.05, rng=2)
    assert issubclass(Third, Ordering)
    with pytest.raises(ValueError, match="ordering Third are not known; use sampler=Ensemble"):
        sample(Model(Third()), data)
    with pytest.raises(ValueError, match="draws must be"):
        sample(Model(), data, draws=2)
    with pytest.raises(TypeError, match="sampler must be"):
        sample(Model(), data, sampler="gibbs")
    assert Ensemble().walkers == 32


@pytest.mark.slow  # three runs
def test_both_routes_to_the_evidence_agree_and_ridges_take_the_one_that_resolves_them(monkeypatch):
    model = Model(gain=ComplexGain(1.0))
    truth = Parameters(np.array([0.4, 0.05, 0.999]), *(np.full(3, x) for x in (0.5, 1.2, 0.4, 0.2)))
    data = simulate(model, truth, BALANCED, 0.02, rng=2)
    by_default = sample(model, data, draws=1000, rng=1)
    assert np.all(by_default.log_evidence_error < 0.02)
    monkeypatch.setattr(verb, "POOR", np.inf)
    conditionals = sample(model, data, draws=1000, rng=1)
    assert conditionals.log_evidence_error[2] > 0.1
    monkeypatch.setattr(verb, "POOR", 0.0)
    bridged = sample(model, data, draws=1000, rng=2)
    for other in (conditionals, by_default):
        error = np.hypot(bridged.log_evidence_error, other.log_evidence_error)
        assert np.all(np.abs(bridged.log_evidence - other.log_evidence) < 4 * error)
    # the draws are the same whatever the evidence comes from
    np.testing.assert_array_equal(by_default.parameters.retardance, conditionals.parameters.retardance)


def test_pixels_whose_chains_do_not_agree_go_to_the_fallback(monkeypatch):
    data = simulate(Model(), Parameters(*(np.full(2, x) for x in (0.3, 0.5, 1.1, 0.4, 0.4))), BALANCED, 0.05, rng=2)
    other = Ensemble(walkers=20, warmup=40, thin=5, evidence=False)
    expected = sample(Model(), data, other, draws=100, rng=1)
    monkeypatch.setattr(engine, "MORE", ())
    monkeypatch.setattr(engine, "LARGEST_R", -1.0)
    flagged = sample(Model(), data, Gibbs(evidence=False), draws=100, rng=1)
    assert np.all(flagged.status & int(Status.NOT_CONVERGED))
    found = sample(Model(), data, Gibbs(evidence=False, fallback=other), draws=100, rng=1)
    np.testing.assert_array_equal(found.parameters.retardance, expected.parameters.retardance)
    assert np.array_equal(found.status, expected.status)
    with pytest.raises(ValueError, match="fallback, but model infers one sigma of the frame"):
        sample(Model(noise=InferredNoise(2.0, 0.01, "frame")), replace(data, sigma=None), Gibbs(fallback=other))
    with pytest.raises(TypeError, match="fallback must be"):
        Gibbs(fallback=True)


def test_gains_and_noises_of_another_size_are_drawn_by_the_same_code():
    """What the code is compiled for is the structure of a plan; its numbers are leaves."""
    sizes = [(1.0, 2.0, 1e-3), (2e-4, 0.5, 1e-9)]
    plans = [plan(Model(gain=ComplexGain(a), noise=InferredNoise(b, c, "pixel"))) for a, b, c in sizes]
    one, other = (jax.tree.structure(p) for p in plans)
    assert one == other
    assert jax.tree.leaves(plans[1]) == pytest.approx([2e-4**-2, 0.5, 1e-9])
    assert one != jax.tree.structure(plan(Model(gain=PhaseGain(), noise=InferredNoise(2.0, 1e-3, "pixel"))))


def test_another_number_of_draws_is_made_by_the_same_code():
    """Batches of fewer draws are the first ones of full batches."""
    data = simulate(Model(), Parameters(*(np.full(2, x) for x in (0.3, 0.5, 1.1, 0.4, 0.4))), BALANCED, 0.05, rng=2)
    sample(Model(), data, Gibbs(evidence=False), draws=200, rng=1)
    compiled = kernel.advance._cache_size()
    sample(Model(), data, Gibbs(evidence=False), draws=101, rng=1)
    assert kernel.advance._cache_size() == compiled
    # 8 batches of 13 draws and 8 of 25 take as many sweeps to warm up where that is a multiple of both
    warm = replace(Gibbs(evidence=False), warmup=13 * 25)
    many, few = (sample(Model(), data, warm, draws=n, rng=1) for n in (200, 101))
    np.testing.assert_array_equal(few.parameters.retardance, many.parameters.retardance[:, :101])
