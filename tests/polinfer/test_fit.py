"""``fit`` finds the maximum of the posterior, and flags what keeps it from doing so."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import polinfer
from polinfer import (
    Measurement,
    Model,
    Parameters,
    PhaseGain,
    Prior,
    Status,
    TruncatedNormal,
    UniformAngle,
    VonMises,
    canonicalise,
    fit,
    simulate,
)
from tests.oracles import jones as oracle
from tests.polinfer.scenes import (
    BALANCED,
    GAINS,
    LIMITS,
    ORDERINGS,
    UNBALANCED,
    Sandwich,
    everywhere,
    measured,
    oracle_posterior,
    uniform,
)


@pytest.mark.parametrize(
    ("ordering", "gain", "u", "sigma"),
    [
        ("retarder_first", "complex", BALANCED, 0.1),
        ("polariser_first", "none", UNBALANCED, 0.3),
        pytest.param("polariser_first", "phase", UNBALANCED, 0.4, marks=pytest.mark.slow),
        pytest.param("retarder_first", "none", BALANCED, 0.4, marks=pytest.mark.slow),
        pytest.param("retarder_first", "phase", BALANCED, 0.2, marks=pytest.mark.slow),
        pytest.param("polariser_first", "complex", UNBALANCED, 0.05, marks=pytest.mark.slow),
    ],
)
def test_no_scipy_optimiser_from_many_starts_finds_a_better_point(ordering, gain, u, sigma):
    model = Model(ORDERINGS[ordering], gain=GAINS[gain])
    data = simulate(model, uniform(2, seed=4), u, sigma, rng=11)
    result = fit(model, data)
    generator = np.random.default_rng(0)
    for i in range(2):
        v = data.response[i]
        best = -np.inf
        for start in generator.uniform(-1, 1, (10, 5)) * LIMITS:
            found = optimize.minimize(
                lambda x, v=v: -max(oracle_posterior(x, u, v, sigma, gain, ordering), -1e9),
                start,
                method="L-BFGS-B",
                bounds=[(-1, 1), (None, None), (-np.pi, np.pi), (None, None), (None, None)],
            )
            best = max(best, -found.fun)
        ours = oracle_posterior([x[i] for x in result.parameters], u, v, sigma, gain, ordering)
        assert ours == pytest.approx(float(result.log_posterior[i]), abs=1e-8)
        assert ours >= best - 1e-6


@pytest.mark.parametrize("gain", ["none", *(pytest.param(x, marks=pytest.mark.slow) for x in ("phase", "complex"))])
def test_hard_corners_converge_and_are_never_nan_where_ok(gain):
    grid = np.array(np.meshgrid([0.0, 1e-3, 0.5, 1.0], [0.0, np.pi / 2], [0.0, 1e-3, np.pi - 1e-3, np.pi],
                                [0.0, np.pi / 4, np.pi / 2], [0.0, np.pi]))  # fmt: skip
    truth = Parameters(*grid.reshape(5, -1))
    model = Model(gain=GAINS[gain])
    for sigma in (1e-8, 1e-2, 2.0):
        data = simulate(model, truth, BALANCED, sigma, rng=3, gain=1.0)
        result = fit(model, data)
        # behind a perfect polariser a free phase leaves a ridge 1e8 times longer than it is wide: its width is rounding
        hopeless = (truth.diattenuation == 1) & (sigma < 1e-4)
        assert ((result.status & int(Status.NOT_CONVERGED) == 0) | hopeless).all()
        for values in (*result.parameters, *result.std, result.log_posterior, result.chi_square):
            assert np.isfinite(values).all()
        assert np.isfinite(result.log_evidence[~hopeless]).all()
        if sigma == 1e-8:
            continue  # the density of the rounded truth says nothing there
        at_truth = np.asarray(model.log_posterior(truth, data))
        assert (result.log_posterior >= at_truth - 1e-6 * (1 + np.abs(at_truth))).all()


def test_retardance_beyond_half_a_wave_ends_on_its_bound_without_gain():
    beyond = oracle.jones((0.1, 0.3, np.pi + 0.1, 0.6, 0.2))
    data = measured(np.stack([beyond @ BALANCED] * 2), 0.02)
    result = fit(Model(), data)
    np.testing.assert_allclose(np.abs(result.parameters.retardance), np.pi, rtol=0, atol=1e-6)
    assert (result.status & int(Status.AT_EDGE)).all()
    free = fit(Model(gain=PhaseGain()), data)
    assert not (free.status & int(Status.AT_EDGE)).any()
    np.testing.assert_allclose(np.abs(free.parameters.retardance), np.pi - 0.1, rtol=0, atol=0.01)


def test_reported_maximum_is_the_canonical_member_of_the_best_orbit():
    data = simulate(Model(), uniform(40, seed=1), BALANCED, 0.02, rng=4)
    result = fit(Model(), data)
    copies = polinfer.orbit(result.parameters)
    density = np.asarray(Model().log_posterior(copies, data))
    assert (density <= result.log_posterior + 1e-6).all()
    better = np.abs(result.parameters.circularity) <= np.pi / 2 + 1e-9  # the prior prefers this half
    assert better.all()


def test_a_flat_prior_leaves_the_choice_to_the_canonical_rule():
    model = Model(priors={"circularity": UniformAngle(2 * np.pi)})
    data = simulate(model, uniform(40, seed=1), BALANCED, 0.02, rng=4)
    result = fit(model, data)
    np.testing.assert_allclose(np.stack(canonicalise(result.parameters)), np.stack(result.parameters), atol=1e-12)


def test_complex64_is_fitted_in_float32_and_agrees_with_float64():
    truth = uniform(64, seed=2, diattenuation=0.5)
    double = simulate(Model(), truth, BALANCED, 0.02, rng=6)
    single = Measurement(double.illumination.astype(np.complex64), double.response.astype(np.complex64),
                         double.sigma.astype(np.float32))  # fmt: skip
    low, high = fit(Model(), single), fit(Model(), double)
    for name in Parameters._fields:
        assert getattr(low.parameters, name).dtype == np.float32
    sure = (high.status == 0) & (low.status == 0)
    assert sure.mean() > 0.6
    matrices = [np.asarray(Model().jones(f.parameters)) for f in (low, high)]
    assert np.abs(matrices[0] - matrices[1])[sure].max() < 2e-3
    for name in Parameters._fields:
        np.testing.assert_allclose(getattr(low.std, name)[sure], getattr(high.std, name)[sure], rtol=0.05)
    np.testing.assert_allclose(low.log_posterior, high.log_posterior, atol=2e-3)
    np.testing.assert_allclose(low.log_evidence[sure], high.log_evidence[sure], atol=0.05)
    assert np.mean((low.status & int(Status.NOT_CONVERGED)) != 0) == 0


def test_masked_and_nan_pixels_are_flagged_and_disturb_no_other():
    scene = polinfer.phantoms.lesion((4, 5), rng=1)
    clean = simulate(Model(), scene.parameters, BALANCED, 0.05, rng=2)
    response = clean.response.copy()
    response[1, 2, 0, 0] = np.nan
    response[2, 3] = np.inf
    mask = np.ones((4, 5), bool)
    mask[0, 0] = False
    result = fit(Model(), Measurement(BALANCED, response, clean.sigma, mask=mask))
    expected = fit(Model(), clean)
    lost = [(0, 0, Status.MASKED), (1, 2, Status.NON_FINITE), (2, 3, Status.NON_FINITE)]
    good = np.ones((4, 5), bool)
    for y, x, flag in lost:
        assert result.status[y, x] == flag
        assert np.isnan(result.parameters.retardance[y, x])
        assert np.isnan(result.covariance[y, x]).all()
        assert np.isnan(result.log_evidence[y, x])
        good[y, x] = False
    for name in Parameters._fields:
        np.testing.assert_array_equal(getattr(result.parameters, name)[good], getattr(expected.parameters, name)[good])


def test_a_frame_without_any_good_pixel_is_all_nan_and_flagged():
    result = fit(Model(gain=PhaseGain()), measured(np.full((3, 2, 3), np.nan + 0j), 0.1))
    assert (result.status == Status.NON_FINITE).all()
    assert np.isnan(result.parameters.diattenuation).all()


def test_a_wrong_sigma_is_a_bad_fit():
    data = simulate(Model(), uniform(30, seed=3), BALANCED, 0.05, rng=1)
    assert np.mean(fit(Model(), data).status & int(Status.BAD_FIT) != 0) < 0.1
    wrong = measured(data.response, 0.01)
    assert np.mean(fit(Model(), wrong).status & int(Status.BAD_FIT) != 0) > 0.9


def test_what_the_data_do_not_constrain_is_flagged():
    status = int(fit(Model(), Measurement(BALANCED, BALANCED, 0.05)).status)
    assert status & Status.UNIDENTIFIED_DIATTENUATION_ANGLE
    assert status & (Status.UNIDENTIFIED_RETARDANCE_ANGLE | Status.UNIDENTIFIED_CIRCULARITY)
    assert not status & (Status.UNIDENTIFIED_RETARDANCE | Status.UNIDENTIFIED_DIATTENUATION | Status.NOT_CONVERGED)


def test_dark_pixels_return_the_prior_and_say_so():
    result = fit(Model(gain=GAINS["complex"]), measured(np.zeros((2, 2, 3), complex), 1e3))
    assert (result.status & int(Status.UNIDENTIFIED_RETARDANCE)).all()
    np.testing.assert_allclose(result.parameters.diattenuation, 0, atol=1e-4)
    np.testing.assert_allclose(result.parameters.circularity, 0, atol=1e-4)


@pytest.mark.parametrize("states", [1, 2])
def test_fewer_states_than_unknowns_still_give_an_answer(states):
    model = Model()
    data = simulate(model, uniform(8, seed=6), BALANCED[:, :states], 0.05, rng=2)
    result = fit(model, data)
    assert np.isfinite(np.stack(result.parameters)).all()
    assert result.degrees_of_freedom.tolist() == [0 if states == 1 else 3] * 8
    assert np.mean(result.status & int(Status.NOT_CONVERGED) != 0) == 0


@pytest.mark.parametrize("shape", [(), (1, 1), (1, 7), (2, 1, 3)])
def test_every_pixel_shape_is_kept(shape):
    # one frame for all shapes: code is compiled for every number of pixels
    data = simulate(Model(), everywhere(8, (0.3, 0.4, 1.3, 0.6, 0.2)), BALANCED, 0.02, rng=1)
    response = data.response[: int(np.prod(shape))].reshape(*shape, 2, 3)
    result = fit(Model(), Measurement(BALANCED, response, 0.02))
    assert result.status.shape == result.log_evidence.shape == result.std.retardance.shape == shape
    assert result.covariance.shape == (*shape, 5, 5)


def test_an_earlier_fit_as_start_gives_the_same_answer():
    scene = polinfer.phantoms.lesion((6, 6), rng=3)
    first = simulate(Model(), scene.parameters, BALANCED, 0.05, rng=1)
    second = simulate(Model(), scene.parameters, BALANCED, 0.05, rng=2)
    cold, warm = fit(Model(), second), fit(Model(), second, start=fit(Model(), first))
    np.testing.assert_allclose(warm.log_posterior, cold.log_posterior, atol=1e-6)
    assert (cold.started_from_fit, warm.started_from_fit) == (False, True)


@dataclass(frozen=True)
class Triangle(Prior):
    """Density rising from 0 to ``high``."""

    high: float

    def log_density(self, x):
        inside = (x > 0) & (x <= self.high)
        return jnp.where(inside, jnp.log(2 * jnp.where(inside, x, 1) / self.high**2), -jnp.inf)

    def sample(self, rng, shape):
        return self.high * np.sqrt(rng.uniform(size=shape))

    @property
    def support(self):
        return 0.0, self.high


def test_an_ordering_and_a_prior_of_ones_own_go_through_fit():
    model = Model(Sandwich(), priors={"diattenuation": Triangle(0.5), "circularity": VonMises(0.2, 50.0)})
    truth = Parameters(np.full(6, 0.3), 0.4, 1.3, 0.6, 0.2)
    result = fit(model, simulate(model, truth, BALANCED, 0.01, rng=1))
    assert (result.status == 0).all()
    for name in Parameters._fields:
        error = np.abs(getattr(result.parameters, name) - getattr(truth, name))
        assert (error < 5 * getattr(result.std, name)).all()


def test_a_prior_with_bounds_on_an_angle_keeps_the_answer_inside():
    prior = TruncatedNormal(0.0, 0.3, -0.2, 0.2)
    model = Model(priors={"circularity": prior})
    result = fit(model, simulate(Model(), Parameters(0.3, 0.4, 1.3, 0.6, 0.5), BALANCED, 0.01, rng=1))
    assert float(result.parameters.circularity) == pytest.approx(0.2, abs=1e-6)
    assert int(result.status) & Status.AT_EDGE


def test_the_gain_is_recovered():
    model = Model(gain=GAINS["complex"])
    result = fit(model, simulate(model, uniform(20, 3, 0.3), BALANCED, 0.01, rng=1, gain=0.7 * np.exp(0.4j)))
    square = result.gain**2  # the sign of gain and retardance are one freedom
    np.testing.assert_allclose(square, 0.49 * np.exp(0.8j), atol=0.06)


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: fit(Model(), np.eye(2)), TypeError, "measurement must be Measurement"),
        (lambda: fit("retarder_first", Measurement(np.eye(2), np.eye(2), 1.0)), TypeError, "model must be Model"),
        (lambda: fit(Model(), Measurement(np.eye(2), np.eye(2))), ValueError, "sigma None"),
        (
            lambda: fit(Model(fixed=dict.fromkeys(Parameters._fields, 0.1)), Measurement(np.eye(2), np.eye(2), 1.0)),
            ValueError,
            "no free parameter",
        ),
    ],
)
def test_wrong_arguments_are_named(call, error, text):
    with pytest.raises(error, match=text):
        call()


def test_float32_keeps_its_promise_up_to_a_signal_of_100000():
    scene = polinfer.phantoms.lesion((8, 8), rng=1)
    data = simulate(Model(), scene.parameters, BALANCED.astype(np.complex64), 1e-5, rng=2)
    single = Measurement(data.illumination, data.response.astype(np.complex64), data.sigma.astype(np.float32))
    result = fit(Model(), single)
    truth = canonicalise(scene.parameters)
    for name in Parameters._fields:
        assert np.abs(getattr(result.parameters, name) - getattr(truth, name)).max() < 1e-3
    assert np.median(np.abs(result.parameters.retardance - truth.retardance) / result.std.retardance) < 1.5
    assert not np.any(result.status & int(Status.NOT_CONVERGED))
