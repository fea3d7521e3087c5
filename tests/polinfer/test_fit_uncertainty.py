"""The covariance, the evidence and the intervals of ``fit`` are those of the density itself."""

import numpy as np
import pytest
from scipy.stats import multivariate_t

import polinfer
from polinfer import (
    Measurement,
    Model,
    Parameters,
    PhaseGain,
    PolariserFirst,
    Status,
    fit,
    simulate,
)
from tests.polinfer.scenes import (
    BALANCED,
    GAINS,
    ORDERINGS,
    UNBALANCED,
    everywhere,
    oracle_posterior,
)


def test_covariance_is_the_inverse_of_the_finite_difference_hessian():
    model = Model(PolariserFirst(), gain=PhaseGain())
    data = simulate(model, everywhere(2, (0.4, 0.3, 1.4, 0.5, 0.2)), UNBALANCED, 0.03, rng=2)
    result = fit(model, data)
    x0 = np.array([x[0] for x in result.parameters])
    hessian = np.zeros((5, 5))
    step = 2e-4
    for i in range(5):
        for j in range(5):
            for si, sj in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                x = x0.copy()
                x[i] += si * step
                x[j] += sj * step
                value = oracle_posterior(x, UNBALANCED, data.response[0], 0.03, "phase", "polariser_first")
                hessian[i, j] += si * sj * value / (4 * step**2)
    expected = np.linalg.inv(-hessian)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(result.covariance[0] / scale, expected / scale, atol=1e-3)
    np.testing.assert_allclose(np.stack(result.std), np.sqrt(np.einsum("pii->ip", result.covariance)))


@pytest.mark.parametrize(
    ("ordering", "gain"),
    [("retarder_first", "none"), pytest.param("polariser_first", "complex", marks=pytest.mark.slow)],
)
def test_errors_reach_the_cramer_rao_bound_and_the_stated_width(ordering, gain):
    pixels, sigma = 2000, 0.01
    truth = Parameters(0.3, 0.4, 1.3, 0.6, 0.3)
    model = Model(ORDERINGS[ordering], gain=GAINS[gain])
    data = simulate(model, everywhere(pixels, truth), BALANCED, sigma, rng=8, gain=1.0)
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


def test_intervals_hold_the_truth_as_often_as_they_say_and_cross_the_wrap():
    pixels = 1000
    truth = Parameters(0.4, 1.56, 1.3, -1.56, 0.2)
    data = simulate(Model(), everywhere(pixels, truth), BALANCED, 0.02, rng=3)
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
