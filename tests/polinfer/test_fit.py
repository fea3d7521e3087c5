"""``fit`` finds the maximum of the posterior, and its uncertainty is right."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import polinfer
from polinfer import (
    ComplexGain,
    Measurement,
    Model,
    Ordering,
    Parameters,
    PhaseGain,
    PolariserFirst,
    Prior,
    RetarderFirst,
    Status,
    TruncatedNormal,
    UniformAngle,
    VonMises,
    canonicalise,
    fit,
    simulate,
)
from polinfer.elements import multiply, polariser, retarder
from tests.oracles import jones as oracle

BALANCED = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
UNBALANCED = np.array([[1, 0.9, 0.7], [0.1, 0.5j, 0.4 - 0.3j]])
GAINS = {"none": None, "phase": PhaseGain(), "complex": ComplexGain(0.8)}
ORDERINGS = {"retarder_first": RetarderFirst(), "polariser_first": PolariserFirst()}
LIMITS = np.array([1, np.pi / 2, np.pi, np.pi / 2, np.pi])


def random_truth(count, seed, diattenuation=0.9):
    x = np.random.default_rng(seed).uniform(-1, 1, (5, count)) * LIMITS[:, None]
    x[0] *= diattenuation
    return Parameters(*x)


def oracle_posterior(x, u, v, sigma, gain, ordering):
    x = np.array(x, float)
    if gain != "none":
        x[2] = (x[2] + np.pi) % (2 * np.pi) - np.pi
    prior = oracle.log_prior(x)
    if prior == -np.inf:
        return -np.inf
    return prior + oracle.log_marginal(x, u, v, sigma, gain, 0.8, ordering)


@pytest.mark.parametrize(
    ("ordering", "gain", "u", "sigma"),
    [
        ("retarder_first", "none", BALANCED, 0.4),
        ("retarder_first", "phase", UNBALANCED, 0.2),
        ("retarder_first", "complex", BALANCED, 0.1),
        ("polariser_first", "none", UNBALANCED, 0.3),
        ("polariser_first", "phase", BALANCED, 0.4),
        ("polariser_first", "complex", UNBALANCED, 0.05),
    ],
)
def test_no_scipy_optimiser_from_many_starts_finds_a_better_point(ordering, gain, u, sigma):
    model = Model(ORDERINGS[ordering], gain=GAINS[gain])
    data = simulate(model, random_truth(2, seed=4), u, sigma, rng=11)
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


@pytest.mark.parametrize("gain", ["none", "phase", "complex"])
def test_hard_corners_converge_and_are_never_nan_where_ok(gain):
    grid = np.array(np.meshgrid([0.0, 1e-3, 0.5, 1.0], [0.0, np.pi / 2], [0.0, 1e-3, np.pi - 1e-3, np.pi],
                                [0.0, np.pi / 4, np.pi / 2], [0.0, np.pi]))  # fmt: skip
    truth = Parameters(*grid.reshape(5, -1))
    model = Model(gain=GAINS[gain])
    for sigma in (1e-8, 1e-2, 2.0):
        data = simulate(model, truth, BALANCED, sigma, rng=3, gain=1.0)
        result = fit(model, data)
        # behind a perfect polariser the retarder's parameters are one curved ridge, 1e8 times longer than it is wide
        hopeless = (truth.diattenuation == 1) & (sigma < 1e-4)
        assert ((result.status & int(Status.NOT_CONVERGED) == 0) | hopeless).all()
        for values in (*result.parameters, *result.std, result.log_posterior, result.chi_square):
            assert np.isfinite(values).all()
        assert np.isfinite(result.log_evidence[~hopeless]).all()
        if sigma == 1e-8:
            continue  # the density of the rounded truth says nothing there
        at_truth = np.asarray(model.log_posterior(truth, data))
        assert (result.log_posterior >= at_truth - 1e-6 * (1 + np.abs(at_truth))).all()


def test_covariance_is_the_inverse_of_the_finite_difference_hessian():
    model = Model(gain=PhaseGain())
    truth = Parameters(0.4, 0.3, 1.4, 0.5, 0.2)
    data = simulate(model, truth, UNBALANCED, 0.03, rng=2)
    result = fit(model, data)
    x0 = np.array([float(x) for x in result.parameters])
    hessian = np.zeros((5, 5))
    step = 2e-4
    for i in range(5):
        for j in range(5):
            for si, sj in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                x = x0.copy()
                x[i] += si * step
                x[j] += sj * step
                value = oracle_posterior(x, UNBALANCED, data.response, 0.03, "phase", "retarder_first")
                hessian[i, j] += si * sj * value / (4 * step**2)
    expected = np.linalg.inv(-hessian)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(result.covariance / scale, expected / scale, atol=1e-3)
    np.testing.assert_allclose(np.stack(result.std), np.sqrt(np.diag(result.covariance)))


@pytest.mark.parametrize(("ordering", "gain"), [("retarder_first", "none"), ("polariser_first", "complex")])
def test_errors_reach_the_cramer_rao_bound_and_the_stated_width(ordering, gain):
    pixels, sigma = 2000, 0.01
    truth = Parameters(0.3, 0.4, 1.3, 0.6, 0.3)
    model = Model(ORDERINGS[ordering], gain=GAINS[gain])
    data = simulate(model, Parameters(*(np.full(pixels, x) for x in truth)), BALANCED, sigma, rng=8, gain=1.0)
    result = fit(model, data)
    bound = polinfer.cramer_rao_bound(model, truth, BALANCED, sigma)
    for name in Parameters._fields:
        error = getattr(result.parameters, name) - getattr(truth, name)
        width = float(getattr(bound, name))
        assert np.sqrt(np.mean(error**2)) == pytest.approx(width, rel=5 / np.sqrt(2 * pixels))
        assert abs(error.mean()) < 5 * width / np.sqrt(pixels)
        assert np.median(getattr(result.std, name)) == pytest.approx(width, rel=0.02)
    assert np.mean(result.status == 0) > 0.99
    assert result.chi_square.mean() == pytest.approx(result.degrees_of_freedom[0], rel=0.03)


def test_cramer_rao_bound_follows_the_known_limits():
    bound = polinfer.cramer_rao_bound(Model(), Parameters(1e-6, 0.3, 1.2, 0.5, 0.1), BALANCED, 0.01)
    assert bound.retardance == pytest.approx(0.01 / 1.5**0.5, rel=1e-3)
    assert bound.diattenuation == pytest.approx(0.01 / 1.5**0.5, rel=1e-3)
    assert bound.retardance_angle == pytest.approx(0.01 / (4.899 * np.sin(0.6)), rel=1e-3)
    fixed = polinfer.cramer_rao_bound(Model(fixed={"diattenuation": 0.0}), Parameters(0, 0, 1.2, 0.5, 0.1), BALANCED, 1)
    assert (fixed.diattenuation, fixed.diattenuation_angle) == (0, np.inf)


def evidence_on_grid(model, data, **axes):
    """Log evidence by the trapezoidal rule on a grid over the free parameters."""
    names, grids = list(axes), list(axes.values())
    mesh = np.meshgrid(*grids, indexing="ij")
    values = dict.fromkeys(Parameters._fields, 0.0) | dict(zip(names, mesh, strict=True))
    log_values = np.asarray(model.log_posterior(Parameters(**values), data))
    peak = log_values.max()
    density = np.exp(log_values - peak)
    for grid in reversed(grids):
        density = np.trapezoid(density, grid, axis=-1)
    return float(np.log(density) + peak)


@pytest.mark.parametrize("gain", ["none", "complex"])
def test_log_evidence_is_the_integral_over_the_ranges_of_a_pure_retarder(gain):
    model = Model(gain=GAINS[gain], fixed={"diattenuation": 0.0})
    data = simulate(model, Parameters(0.0, 0.0, 1.9, 0.5, 0.3), BALANCED, 0.08, rng=1, gain=1.0)
    result = fit(model, data)
    exact = evidence_on_grid(
        model,
        data,
        retardance=np.linspace(-np.pi, np.pi, 121),
        retardance_angle=np.linspace(-np.pi / 2, np.pi / 2, 181),
        circularity=np.linspace(-np.pi, np.pi, 101),
    )
    assert float(result.log_evidence) == pytest.approx(exact, abs=0.02)
    assert result.covariance[0].tolist() == [0] * 5
    assert np.isnan(result.parameters.diattenuation_angle)
    assert int(result.status) == Status.UNIDENTIFIED_DIATTENUATION_ANGLE


def test_log_evidence_in_five_dimensions_agrees_with_importance_sampling():
    model = Model()
    data = simulate(model, Parameters(0.5, 0.4, 1.3, 0.6, 0.3), BALANCED, 0.05, rng=5)
    result = fit(model, data)
    generator = np.random.default_rng(0)
    count, dof = 40_000, 5
    root = 1.2 * np.linalg.cholesky(result.covariance)
    z = generator.normal(size=(count, 5)) / np.sqrt(generator.chisquare(dof, (count, 1)) / dof)
    x = np.stack(result.parameters) + z @ root.T
    from scipy.stats import multivariate_t

    proposal = multivariate_t.logpdf(x, np.stack(result.parameters), root @ root.T, dof)
    # four copies have the prior of this one, four have the circularity on the other side
    p = Parameters(*x.T)
    flipped = p._replace(circularity=p.circularity + np.pi)
    inside = np.abs(x[:, 0]) <= 1
    data_part = np.where(inside, np.asarray(model.log_likelihood(p, data)), -np.inf)
    prior = np.logaddexp(model.log_prior(p), model.log_prior(flipped)) + np.log(4)
    exact = np.log(np.mean(np.exp(data_part + prior - proposal - result.log_evidence))) + result.log_evidence
    assert float(result.log_evidence) == pytest.approx(float(exact), abs=0.05)


def test_on_a_bound_the_evidence_and_the_width_are_those_of_the_cut_density():
    model = Model(fixed={"retardance": 0.0})
    # the sign of the weak axis is wrong: the nearest polariser is a perfect one
    data = Measurement.from_jones(np.array([[1.4, 0.1], [0.1, -0.08]]), 0.05)
    result = fit(model, data)
    assert int(result.status) & Status.AT_EDGE
    edge = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 1501))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 401)
    exact = evidence_on_grid(model, data, diattenuation=edge, diattenuation_angle=angle)
    assert float(result.log_evidence) == pytest.approx(exact, abs=0.03)
    mesh = np.meshgrid(edge, angle, indexing="ij")
    density = np.exp(np.asarray(model.log_posterior(Parameters(*mesh, 0.0, 0.0, 0.0), data)) - exact)
    value = 1 if result.parameters.diattenuation > 0 else -1
    near = np.where(np.sign(mesh[0]) == value, density, 0)
    square = np.trapezoid(np.trapezoid(near * (mesh[0] - value) ** 2, angle), edge)
    expected = np.sqrt(square / np.trapezoid(np.trapezoid(near, angle), edge))
    assert float(result.std.diattenuation) == pytest.approx(expected, rel=0.05)


def test_retardance_beyond_half_a_wave_ends_on_its_bound_without_gain():
    beyond = oracle.jones((0.1, 0.3, np.pi + 0.1, 0.6, 0.2))
    result = fit(Model(), Measurement.from_jones(beyond, 0.02))
    assert abs(float(result.parameters.retardance)) == pytest.approx(np.pi, abs=1e-6)
    assert int(result.status) & Status.AT_EDGE
    free = fit(Model(gain=PhaseGain()), Measurement.from_jones(beyond, 0.02))
    assert not int(free.status) & Status.AT_EDGE
    assert abs(float(free.parameters.retardance)) == pytest.approx(np.pi - 0.1, abs=0.01)


def test_reported_maximum_is_the_canonical_member_of_the_best_orbit():
    data = simulate(Model(), random_truth(40, seed=1), BALANCED, 0.02, rng=4)
    result = fit(Model(), data)
    copies = polinfer.orbit(result.parameters)
    density = np.asarray(Model().log_posterior(copies, data))
    assert (density <= result.log_posterior + 1e-6).all()
    better = np.abs(result.parameters.circularity) <= np.pi / 2 + 1e-9  # the prior prefers this half
    assert better.all()


def test_a_flat_prior_leaves_the_choice_to_the_canonical_rule():
    model = Model(priors={"circularity": UniformAngle(2 * np.pi)})
    data = simulate(model, random_truth(40, seed=1), BALANCED, 0.02, rng=4)
    result = fit(model, data)
    np.testing.assert_allclose(np.stack(canonicalise(result.parameters)), np.stack(result.parameters), atol=1e-12)


def test_complex64_is_fitted_in_float32_and_agrees_with_float64():
    truth = random_truth(64, seed=2, diattenuation=0.5)
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
    result = fit(Model(gain=PhaseGain()), Measurement.from_jones(np.full((3, 2, 2), np.nan), 0.1))
    assert (result.status == Status.NON_FINITE).all()
    assert np.isnan(result.parameters.diattenuation).all()


def test_a_wrong_sigma_is_a_bad_fit():
    data = simulate(Model(), random_truth(30, seed=3), BALANCED, 0.05, rng=1)
    assert np.mean(fit(Model(), data).status & int(Status.BAD_FIT) != 0) < 0.1
    wrong = Measurement(BALANCED, data.response, 0.01)
    assert np.mean(fit(Model(), wrong).status & int(Status.BAD_FIT) != 0) > 0.9


def test_what_the_data_do_not_constrain_is_flagged():
    status = int(fit(Model(), Measurement.from_jones(np.eye(2), 0.05)).status)
    assert status & Status.UNIDENTIFIED_DIATTENUATION_ANGLE
    assert status & (Status.UNIDENTIFIED_RETARDANCE_ANGLE | Status.UNIDENTIFIED_CIRCULARITY)
    assert not status & (Status.UNIDENTIFIED_RETARDANCE | Status.UNIDENTIFIED_DIATTENUATION | Status.NOT_CONVERGED)


def test_dark_pixels_return_the_prior_and_say_so():
    model = Model(gain=ComplexGain(1.0))
    result = fit(model, Measurement(np.eye(2), np.zeros((2, 2)), 1e3))
    assert int(result.status) & Status.UNIDENTIFIED_RETARDANCE
    assert float(result.parameters.diattenuation) == pytest.approx(0, abs=1e-4)
    assert float(result.parameters.circularity) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("states", [1, 2])
def test_fewer_states_than_unknowns_still_give_an_answer(states):
    model = Model()
    data = simulate(model, random_truth(8, seed=6), BALANCED[:, :states], 0.05, rng=2)
    result = fit(model, data)
    assert np.isfinite(np.stack(result.parameters)).all()
    assert result.degrees_of_freedom.tolist() == [0 if states == 1 else 3] * 8
    assert np.mean(result.status & int(Status.NOT_CONVERGED) != 0) == 0


@pytest.mark.parametrize("shape", [(), (1, 1), (1, 7), (2, 1, 3)])
def test_every_pixel_shape_is_kept(shape):
    truth = Parameters(*(np.full(shape, x) for x in (0.3, 0.4, 1.3, 0.6, 0.2)))
    result = fit(Model(), simulate(Model(), truth, BALANCED, 0.02, rng=1))
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
class Sandwich(Ordering):
    """Half the retarder on either side of the polariser."""

    def jones(self, parameters):
        p = parameters
        half = retarder(p.retardance / 2, p.retardance_angle, p.circularity)
        return multiply(half, multiply(polariser(p.diattenuation, p.diattenuation_angle), half))


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


def test_intervals_hold_the_truth_as_often_as_they_say_and_cross_the_wrap():
    pixels = 1000
    truth = Parameters(0.4, 1.56, 1.3, -1.56, 0.2)
    data = simulate(Model(), Parameters(*(np.full(pixels, x) for x in truth)), BALANCED, 0.02, rng=3)
    low, high = fit(Model(), data).interval(0.9)
    copies = polinfer.orbit(truth)
    for name, period in (("diattenuation_angle", np.pi), ("retardance_angle", np.pi)):
        lower, upper = getattr(low, name), getattr(high, name)
        width = np.mod(upper - lower, period)
        inside = np.zeros(pixels, bool)
        for value in np.unique(np.round(getattr(copies, name), 9)):
            inside |= np.mod(value - lower, period) <= width
        assert np.mean(inside) == pytest.approx(0.9, abs=0.04)
    assert np.any(low.diattenuation_angle > high.diattenuation_angle)


def test_the_gain_is_recovered():
    model = Model(gain=ComplexGain(1.0))
    result = fit(model, simulate(model, random_truth(20, 3, 0.3), BALANCED, 0.01, rng=1, gain=0.7 * np.exp(0.4j)))
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
