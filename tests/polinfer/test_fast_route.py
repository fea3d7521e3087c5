"""The fast route of ``fit`` finds what the general route finds, and what brute force says."""

from math import pi

import jax
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_t

import polinfer
from polinfer import (
    AxialVonMises,
    ComplexGain,
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    PhaseGain,
    PolariserFirst,
    Status,
    TruncatedNormal,
    UniformAngle,
    VonMises,
    Window,
    fit,
    simulate,
)
from polinfer.fitting.fast import fast_scene
from polinfer.fitting.fast.frame import frame_of_responses, solve
from tests.polinfer.scenes import (
    BALANCED,
    CASES,
    FREE,
    PRIORS,
    UNBALANCED,
    Same,
    Sandwich,
    case,
    drawn,
    everywhere,
    fitted,
    general,
    with_priors,
)


def gaussian(result, widest):
    """Pixels around whose maximum the density is a Gaussian in all parameters."""
    std = np.stack([getattr(result.std, name) for name in result.model.free])
    return (std.max(axis=0) < widest) & (result.status & int(Status.AT_EDGE) == 0)


SLOW = ("pure polariser", "known polariser", "pure retarder", "skew states")  # to compile


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES]
)
def test_both_routes_find_the_same_maximum_and_describe_it_alike(name):
    model, data = case(name)
    fast, slow = fitted(name), fit(general(model), data)
    assert fast_scene(model) is not None
    assert fast_scene(general(model)) is None
    assert (fast.log_posterior >= slow.log_posterior - 1e-6).all()
    same = np.abs(fast.log_posterior - slow.log_posterior) < 1e-6
    assert same.mean() > 0.85  # the general route misses a few maxima where the data say little
    for field in Parameters._fields:
        ours, theirs = getattr(fast.parameters, field)[same], getattr(slow.parameters, field)[same]
        np.testing.assert_allclose(ours, theirs, atol=2e-5, err_msg=field)
    scale = np.sqrt(np.einsum("pi,pj->pij", *[np.einsum("pii->pi", slow.covariance)[same]] * 2))
    off = np.abs(fast.covariance - slow.covariance)[same] / np.where(scale > 0, scale, 1)
    at_edge = (fast.status & int(Status.AT_EDGE) != 0)[same]
    assert off[~at_edge].max() < 1e-3
    # on a bound the one integrates the Gaussian that it finds there, the other the density itself, as far as it
    # follows the other parameters
    assert off[(fast.status == Status.AT_EDGE)[same]].max(initial=0) < 0.15
    np.testing.assert_array_equal(fast.status[same], slow.status[same])
    np.testing.assert_array_equal(fast.degrees_of_freedom, slow.degrees_of_freedom)
    np.testing.assert_allclose(fast.chi_square[same], slow.chi_square[same], atol=1e-4)
    assert (fast.gain is None) == (model.gain is None)
    if fast.gain is not None:
        np.testing.assert_allclose(fast.gain[same], slow.gain[same], atol=1e-5)
    np.testing.assert_array_equal(fast.sigma, slow.sigma)
    # where the density is no Gaussian the two differ by what either lacks
    sure = same & gaussian(fast, 0.1)
    assert sure.sum() > 4
    np.testing.assert_allclose(fast.log_evidence[sure], slow.log_evidence[sure], atol=0.02)
    at_maximum = np.asarray(model.log_posterior(fast.parameters, data))
    np.testing.assert_allclose(fast.log_posterior[same], at_maximum[same], atol=1e-8)


def sampled_evidence(result, data, pixels, draws=4000):
    """Log evidence by importance sampling around the maximum; the eight copies have the same likelihood.

    D is drawn as ``sin delta``, in which the density is a Gaussian up to the bound.
    """
    model = result.model
    found = []
    for p in pixels:
        rng = np.random.default_rng(p)
        centre = np.array([x[p] for x in result.parameters])
        covariance = result.covariance[p].copy()
        centre[0] = np.arcsin(np.clip(centre[0], -1, 1))
        cosine = max(np.cos(centre[0]), np.sqrt(result.std.diattenuation[p]))
        covariance[0] /= cosine
        covariance[:, 0] /= cosine
        proposal = multivariate_t(centre, 1.5 * covariance, 5, seed=rng)
        x = proposal.rvs(draws)
        inside = (np.abs(x[:, 0]) <= pi / 2) & ((np.abs(x[:, 2]) <= pi) | model.known_gain.free_phase)
        values = np.where(inside, np.array([np.sin(x[:, 0]), *x.T[1:]]), 0.1)
        one = Measurement(data.illumination, data.response[p], data.sigma.reshape(-1)[p % data.sigma.size])
        copies = Parameters(*(np.asarray(v) for v in polinfer.orbit(Parameters(*values))))
        prior = np.logaddexp.reduce(np.asarray(model.log_prior(copies)), axis=0)
        data_part = np.asarray(model.log_likelihood(Parameters(*values), one))
        log_weight = data_part + prior + np.log(np.maximum(np.cos(x[:, 0]), 1e-300)) - proposal.logpdf(x)
        log_weight = np.where(inside, log_weight, -np.inf)
        top = log_weight.max()
        weight = np.exp(log_weight - top)
        assert weight.sum() ** 2 / np.sum(weight**2) > 200, "too few draws count"
        found.append(np.log(weight.mean()) + top)
    return np.array(found)


@pytest.mark.parametrize("name", ["free", "skew states"])
def test_the_evidence_is_that_of_importance_sampling_where_the_density_is_a_gaussian(name):
    (_, data), fast = case(name), fitted(name)
    pixels = np.flatnonzero(gaussian(fast, 0.12))[:12]
    assert len(pixels) >= 8
    expected = sampled_evidence(fast, data, pixels)
    np.testing.assert_allclose(fast.log_evidence[pixels], expected, atol=0.1)


@pytest.mark.parametrize(
    "fixed", [{"diattenuation": 0.4}, pytest.param({"retardance_angle": 0.3}, marks=pytest.mark.slow)]
)
def test_fixed_values_are_kept_where_other_starts_are_tried(fixed):
    model = Model(gain=ComplexGain(0.8), **with_priors(**fixed))
    data = simulate(model, drawn(model, 64, np.random.default_rng(17)), UNBALANCED, 0.2, rng=1)
    fast = fit(model, data)
    for name, value in fixed.items():
        np.testing.assert_array_equal(getattr(fast.parameters, name), value)
    at_maximum = np.asarray(model.log_posterior(fast.parameters, data))
    np.testing.assert_allclose(fast.log_posterior, at_maximum, atol=1e-8)


def test_of_two_copies_with_nearly_the_same_density_the_better_one_is_found():
    model = Model(priors=PRIORS)
    response = [
        [0.3036 + 0.0788j, 0.2448 + 0.1578j, 0.4505 + 0.1831j],
        [1.1031 - 0.2379j, 0.1995 + 0.565j, -0.1866 - 0.7389j],
    ]
    data = Measurement(BALANCED, np.array(response), 0.2)
    result = fit(model, data)
    density = jax.jit(jax.value_and_grad(lambda x: -model.log_posterior(Parameters(*x), data)))
    for copy in np.stack(polinfer.orbit(result.parameters)).T:
        found = minimize(density, copy, jac=True, method="BFGS")
        assert abs(found.x[0]) < 0.95
        assert result.log_posterior > -found.fun - 1e-5


EDGES = Parameters(
    np.array([0.2, -0.3, 0.1, 0.4, 0.2, 1.0, -1.0, 0.999, -0.99, 0.95, 1.0, 0.9]), 0.5,
    np.array([pi, -pi, pi - 0.01, 0.02 - pi, pi + 0.03, 1.2, -0.8, 0.9, 1.3, 2.0, pi, 0.04 - pi]), 0.6, 0.3,
)  # fmt: skip


def test_at_and_near_bounds_the_evidence_is_that_of_importance_sampling_and_of_the_general_route():
    truth = Parameters(*(np.repeat(x, 4) for x in np.broadcast_arrays(*EDGES)))
    matrices = np.asarray(FREE.jones(truth)) @ BALANCED
    noise = np.random.default_rng(5).normal(scale=0.02 / 2**0.5, size=(2, *matrices.shape))
    data = Measurement(BALANCED, matrices + noise[0] + 1j * noise[1], 0.02)
    fast, slow = fit(FREE, data), fit(general(FREE), data)
    np.testing.assert_allclose(fast.log_posterior, slow.log_posterior, atol=1e-6)
    np.testing.assert_array_equal(fast.status, slow.status)
    at_edge = fast.status & int(Status.AT_EDGE) != 0
    assert 10 < at_edge.sum() < 40
    # so many draws leave 0.01 to 0.02 nat
    expected = sampled_evidence(fast, data, range(len(at_edge)), 8000)
    np.testing.assert_allclose(fast.log_evidence, expected, atol=0.06)
    # with one parameter on a bound and one near its own, the general route integrates the second over a Gaussian of
    # the first, which is none
    both = (truth.diattenuation == 1) & (truth.retardance == pi)
    np.testing.assert_allclose(fast.log_evidence[~both], slow.log_evidence[~both], atol=0.005)
    for name in Parameters._fields:
        ours, theirs = getattr(fast.std, name)[~both], getattr(slow.std, name)[~both]
        np.testing.assert_allclose(ours, theirs, rtol=0.01)


def test_every_pixel_may_have_its_own_illumination_weight_and_sigma():
    rng = np.random.default_rng(3)
    truth = drawn(FREE, 64, rng)
    turn = np.linalg.qr(rng.normal(size=(64, 3, 3)))[0]
    illumination = np.where(np.arange(64)[:, None, None] % 2, BALANCED @ turn, UNBALANCED)
    weight = rng.uniform(0.5, 2, (64, 3))
    weight[3, 1] = 0
    sigma = rng.uniform(0.02, 0.1, 64)
    noise = sigma[:, None, None] * rng.normal(size=(2, 64, 2, 3)) / (2 * weight[:, None] + 1e-9) ** 0.5
    response = np.asarray(FREE.jones(truth)) @ illumination + noise[0] + 1j * noise[1]
    response[3, :, 1] = np.nan
    data = Measurement(illumination, response, sigma, weight=weight)
    fast, slow = fit(FREE, data), fit(general(FREE), data)
    np.testing.assert_allclose(fast.log_posterior, slow.log_posterior, atol=1e-6)
    for name in Parameters._fields:
        np.testing.assert_allclose(getattr(fast.parameters, name), getattr(slow.parameters, name), atol=2e-5)
        ours, theirs = getattr(fast.std, name), getattr(slow.std, name)
        inside = fast.status & int(Status.AT_EDGE) == 0
        np.testing.assert_allclose(ours[inside], theirs[inside], rtol=1e-4, err_msg=name)
        np.testing.assert_allclose(ours, theirs, rtol=0.2, err_msg=name)
    np.testing.assert_allclose(fast.chi_square, slow.chi_square, atol=1e-4)
    np.testing.assert_array_equal(fast.degrees_of_freedom, slow.degrees_of_freedom)
    np.testing.assert_array_equal(fast.status, slow.status)
    sure = gaussian(fast, 0.1)
    assert sure.sum() > 10
    np.testing.assert_allclose(fast.log_evidence[sure], slow.log_evidence[sure], atol=0.02)


def test_a_window_is_the_joint_fit_of_its_pixels():
    truth = Parameters(0.3, 0.4, 1.3, 0.6, 0.2)
    shape = (4, 5)
    data = simulate(FREE, everywhere(shape, truth), BALANCED, 0.2, rng=2)
    mask = np.ones(shape, bool)
    mask[1, 1] = False
    result = fit(Model(neighbours=Window(3, 3)), Measurement(BALANCED, data.response, 0.2, mask=mask))
    assert (result.status == 0).sum() > 10
    for y, x in ((0, 0), (0, 2), (2, 2), (3, 4)):
        rows, columns = slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2)
        members = data.response[rows, columns][mask[rows, columns]]
        # the pixels of a window are so many more states of one pixel
        joint = Measurement(np.tile(BALANCED, len(members)), np.concatenate(list(members), axis=-1), 0.2)
        expected = fit(general(FREE), joint)
        for name in ("log_posterior", "log_evidence", "chi_square", "degrees_of_freedom", "status"):
            np.testing.assert_allclose(getattr(result, name)[y, x], getattr(expected, name), atol=2e-3, err_msg=name)
        np.testing.assert_allclose([v[y, x] for v in result.parameters], np.stack(expected.parameters), atol=1e-5)
        np.testing.assert_allclose(result.covariance[y, x], expected.covariance, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "fast"),
    [
        (FREE, True),
        (Model(PolariserFirst(), gain=PhaseGain(), priors=PRIORS), True),
        (Model(gain=ComplexGain(2.0), priors={"diattenuation": UniformAngle(2.0)}), True),
        (Model(neighbours=Window(3, 3)), True),
        (Model(noise=InferredNoise(2.0, 0.1, "frame")), True),
        (Model(noise=InferredNoise(2.0, 0.1, "pixel")), False),
        (Model(gain=PhaseGain(), neighbours=Window(3, 3)), False),
        (Model(Sandwich()), False),
        (Model(priors={"circularity": Same(VonMises(0.0, 1.0))}), False),
        (Model(priors={"circularity": UniformAngle(1.0)}), False),
        (Model(priors={"retardance": TruncatedNormal(0.0, 1.0, -pi, pi)}), False),
        (Model(priors={"diattenuation": TruncatedNormal(0.0, 0.5, -0.9, 1.0)}), False),
        (Model(gain=PhaseGain(), priors={"retardance": AxialVonMises(0.0, 1.0)}), False),
    ],
)
def test_what_is_shipped_goes_the_fast_route_and_what_is_not_the_general_one(model, fast):
    assert (fast_scene(model) is not None) == fast


def test_small_frames_by_their_statistics_have_the_answers_of_their_responses():
    """Of four unbalanced states, one without weight, sigma by pixels: the two sides of the limit of small frames."""
    rng = np.random.default_rng(7)
    truth = polinfer.phantoms.lesion((6, 8), rng=1).parameters
    states = rng.standard_normal((2, 4)) + 1j * rng.standard_normal((2, 4))
    sigma = rng.uniform(0.01, 0.03, (6, 8))
    response = simulate(Model(), truth, states, sigma, rng=2).response
    response[..., 3] = np.nan
    model, weight = Model(gain=ComplexGain(1.0)), np.array([1.0, 0.5, 2.0, 0.0])
    frame = frame_of_responses(model, Measurement(states, response, sigma, weight), None)
    assert frame.small
    one, other = (solve(fast_scene(model), each).rows for each in (frame, frame.summed()))
    assert np.isfinite(one).all()
    np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-9)
