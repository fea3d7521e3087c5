"""Every prior is a normalised density, and its sampler draws from it. A new prior is one row of the table."""

import numpy as np
import pytest
from scipy import integrate, special, stats

from polinfer import AxialVonMises, Model, TruncatedNormal, UniformAngle, VonMises
from polinfer.circular import log_scaled_bessel

PRIORS = [
    VonMises(0.3, 0.0),
    VonMises(-2.0, 1.0),
    VonMises(3.0, 500.0),
    AxialVonMises(0.7, 0.0),
    AxialVonMises(-1.2, 3.0),
    UniformAngle(np.pi),
    UniformAngle(2 * np.pi),
    TruncatedNormal(0.0, 0.5, -1.0, 1.0),
    TruncatedNormal(3.0, 0.2, -1.0, 1.0),
    TruncatedNormal(-9.0, 0.5, 0.0, 1.0),
]


def density(prior, x):
    return np.exp(np.asarray(prior.log_density(np.asarray(x, float))))


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_density_integrates_to_one(prior):
    low, high = prior.support
    nodes = np.linspace(low, high, 40_001)
    assert integrate.simpson(density(prior, nodes), x=nodes) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_draws_follow_the_density(prior):
    low, high = prior.support
    nodes = np.linspace(low, high, 20_001)
    cumulative = integrate.cumulative_trapezoid(density(prior, nodes), nodes, initial=0)
    draws = prior.sample(np.random.default_rng(5), (50, 40))
    assert draws.shape == (50, 40)
    assert draws.min() >= low - 1e-12
    assert draws.max() <= high + 1e-12
    assert stats.kstest(draws.ravel(), lambda x: np.interp(x, nodes, cumulative)).pvalue > 1e-3


def test_densities_are_those_of_scipy():
    x = np.linspace(-1.5, 1.5, 7)
    np.testing.assert_allclose(VonMises(0.4, 2.0).log_density(x), stats.vonmises.logpdf(x, 2.0, loc=0.4), atol=1e-12)
    axial = stats.vonmises.logpdf(2 * (x - 0.4), 2.0) + np.log(2)
    np.testing.assert_allclose(AxialVonMises(0.4, 2.0).log_density(x), axial, atol=1e-12)
    normal = stats.truncnorm.logpdf(x, -2.4, 1.6, loc=0.2, scale=0.5)
    np.testing.assert_allclose(TruncatedNormal(0.2, 0.5, -1, 1).log_density(x), normal, atol=1e-12)


def test_angular_densities_are_periodic():
    for prior, period in ((VonMises(1.0, 3.0), 2 * np.pi), (AxialVonMises(1.0, 3.0), np.pi)):
        assert float(prior.log_density(0.2 + period)) == pytest.approx(float(prior.log_density(0.2)), abs=1e-12)


def test_log_scaled_bessel_is_exact_at_every_size_and_so_are_its_derivatives():
    import jax

    x = np.concatenate([np.linspace(0, 60, 241), np.logspace(2, 12, 21)])
    np.testing.assert_allclose(log_scaled_bessel(x), np.log(special.i0e(x)), rtol=1e-14, atol=1e-15)
    ratio = special.i1e(x[1:]) / special.i0e(x[1:])
    first = jax.jit(jax.vmap(jax.grad(log_scaled_bessel)))(x[1:])
    np.testing.assert_allclose(first, ratio - 1, rtol=1e-9, atol=1e-13)
    second = jax.jit(jax.vmap(jax.grad(jax.grad(log_scaled_bessel))))(x[1:241])
    np.testing.assert_allclose(second, 1 - ratio[:240] / x[1:241] - ratio[:240] ** 2, rtol=1e-6, atol=1e-12)


def test_default_prior_of_the_model_is_normalised():
    from polinfer import Parameters
    from tests.oracles import jones as oracle

    x = (0.3, 0.2, -1.0, 1.1, 2.0)
    assert float(Model().log_prior(Parameters(*x))) == pytest.approx(oracle.log_prior(x), abs=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: VonMises(0.0, -1.0), "concentration must be >= 0"),
        (lambda: AxialVonMises(np.nan, 1.0), "mean must be finite"),
        (lambda: UniformAngle(0.0), "period must be > 0"),
        (lambda: TruncatedNormal(0.0, 0.0, -1.0, 1.0), "scale must be > 0"),
        (lambda: TruncatedNormal(0.0, 1.0, 1.0, -1.0), "low must be < high"),
    ],
)
def test_wrong_settings_are_named(make, text):
    with pytest.raises(ValueError, match=text):
        make()
