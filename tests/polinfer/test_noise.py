"""Unknown noise is really integrated out, and what is reported about it holds."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polinfer
from polinfer import (
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    Status,
    fit,
    simulate,
)
from polinfer.power_means import log_gain_mean, log_gamma_ratio, log_phase_mean
from tests.oracles import jones as oracle
from tests.oracles import noise as brute
from tests.polinfer.scenes import BALANCED, GAINS, X, everywhere


def data(states, seed=0, sigma=0.2, gain=1.0):
    generator = np.random.default_rng(seed)
    u, v = (generator.normal(size=(2, 2, states)) + 1j * generator.normal(size=(2, 2, states))) / 2**0.5
    return u, gain * (oracle.jones(X) @ u) + sigma * v


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize(("shape", "scale", "sigma"), [(2.0, 0.1, 0.2), (0.7, 1.5, 0.9)])
def test_unknown_noise_is_the_integral_over_sigma_and_the_gain(gain, shape, scale, sigma):
    u, v = data(4, sigma=sigma, gain=1.0 if gain == "none" else 0.9 * np.exp(0.6j))
    weight = np.array([1.0, 0.0, 2.5, 0.3])
    v[:, 1] = np.nan
    model = Model(noise=InferredNoise(shape, scale, "pixel"), gain=GAINS[gain])
    got = float(model.log_likelihood(Parameters(*X), Measurement(u, v, weight=weight)))
    reach = 4.0 if sigma < 0.5 else 9.0
    expected = brute.log_unknown_noise(X, u, v, shape, scale, gain, 0.8, weight, reach=reach)
    assert got == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("power", [2.01, 3.0, 6.5, 12.0, 1e3, 1e6])
def test_the_mean_over_a_phase_and_its_derivatives_are_those_of_fine_panels(power):
    ratios = np.array([0.0, 1e-6, 0.1, 1.0, 10.0, 1e4, 1e8, 1e12])
    first_and_second = (jax.grad(log_phase_mean, 1), jax.grad(jax.grad(log_phase_mean, 1), 1))
    every = jax.jit(lambda *x: (log_phase_mean(*x), *(jax.vmap(f)(*x) for f in first_and_second)))
    value, slope, bend = every(jnp.full(len(ratios), power), jnp.asarray(ratios))
    for i, ratio in enumerate(ratios):
        s, weight, expected = brute.log_phase_mean(power, ratio)
        part = s / (1 + ratio * s)
        first = -power * np.sum(weight * part)
        second = power * np.sum(weight * part**2) + power**2 * np.sum(weight * part**2) - first**2
        assert float(value[i]) == pytest.approx(expected, abs=1e-8)
        assert float(slope[i]) == pytest.approx(first, rel=1e-6)
        assert float(bend[i]) == pytest.approx(second, rel=1e-5)
    single = log_phase_mean(jnp.float32(power), jnp.asarray(ratios, jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, value, atol=1e-5)


CASES = [
    (power, rest, signal, share * max(signal, 1.0))
    for power in (2.01, 6.0, 50.0, 1e5)
    for rest, signal in ((0.0, 0.0), (3.0, 0.1), (0.0, 10.0), (0.0, 100.0), (2.0, 1e4), (0.0, 1e12))
    for share in (0.0, 1e-3, 0.03, 0.07, 0.1, 0.5, 1e4)
]


def test_the_mean_over_a_complex_gain_and_its_derivatives_are_those_of_a_dense_sum():
    columns = [jnp.asarray(x) for x in np.array(CASES).T]
    compiled = jax.jit(log_gain_mean)
    value, single = compiled(*columns), compiled(*(x.astype(jnp.float32) for x in columns))
    slopes = jax.jit(jax.vmap(jax.grad(log_gain_mean, (1, 2, 3))))(*columns)
    bends = jax.jit(jax.vmap(jax.hessian(log_gain_mean, (1, 2))))(*columns)
    for i, (power, rest, signal, width) in enumerate(CASES):
        s, weight, expected = brute.log_gain_mean(power, rest, signal, width)
        assert float(value[i]) == pytest.approx(expected, abs=2e-6), CASES[i]
        assert float(single[i]) == pytest.approx(expected, abs=1e-4, rel=3e-6), CASES[i]
        first, second = 1 / s, 1 / (width + s)
        third = -signal * second**2 + second
        for got, factor in zip(slopes, (first, second, third), strict=True):
            size = np.sum(weight * abs(factor))
            assert float(got[i]) == pytest.approx(-np.sum(weight * factor), abs=3e-5 * size + 1e-12), CASES[i]
        for a, one in enumerate((first, second)):
            for b, other in enumerate((first, second)):
                covariance = np.sum(weight * one * other) - np.sum(weight * one) * np.sum(weight * other)
                size = np.sum(weight * one * other)
                assert float(bends[a][b][i]) == pytest.approx(covariance, abs=1e-4 * size + 1e-12), CASES[i]


@pytest.mark.parametrize("start", [0.01, 3.0, 12.0, 1e6])
def test_a_ratio_of_gamma_functions_is_the_product(start):
    product = float(np.sum(np.log(start + np.arange(14))))
    assert float(log_gamma_ratio(start, 14.0)) == pytest.approx(product, abs=1e-9)
    assert float(log_gamma_ratio(start, jnp.float32(14))) == pytest.approx(product, rel=1e-6)


@pytest.mark.parametrize("gain", GAINS)
def test_a_prior_that_knows_sigma_is_known_noise(gain):
    u, v = data(3)
    known = Model(gain=GAINS[gain]).log_likelihood(Parameters(*X), Measurement(u, v, 0.2))
    model = Model(noise=InferredNoise(1e9, 0.04e9, "pixel"), gain=GAINS[gain])
    assert float(model.log_likelihood(Parameters(*X), Measurement(u, v))) == pytest.approx(float(known), abs=1e-5)


@pytest.mark.parametrize("gain", GAINS)
def test_dark_and_missing_data_have_a_density(gain):
    model = Model(noise=InferredNoise(0.5, 0.01, "pixel"), gain=GAINS[gain])
    dark = float(model.log_posterior(Parameters(*X), Measurement(np.eye(2), np.zeros((2, 2)))))
    assert np.isfinite(dark)
    slope = jax.grad(lambda d: model.log_posterior(Parameters(d, *X[1:]), Measurement(np.eye(2), np.zeros((2, 2)))))(
        0.3
    )
    assert np.isfinite(slope)
    nothing = Measurement(np.eye(2), np.full((2, 2), np.nan), weight=np.zeros(2))
    assert float(model.log_likelihood(Parameters(*X), nothing)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("gain", GAINS)
def test_float32_agrees_at_high_signal(gain):
    u, v = data(3, sigma=1e-4)
    single = Measurement(u.astype(np.complex64), v.astype(np.complex64))
    double = Measurement(single.illumination.astype(complex), single.response.astype(complex))
    model = Model(noise=InferredNoise(1.0, 1e-8, "pixel"), gain=GAINS[gain])
    p32, p64 = Parameters(*map(np.float32, X)), Parameters(*(float(np.float32(x)) for x in X))
    low, high = model.log_likelihood(p32, single), model.log_likelihood(p64, double)
    assert low.dtype == np.float32
    assert float(low) == pytest.approx(float(high), abs=0.02)


def test_intervals_and_sigma_hold_what_they_say_when_sigma_is_unknown_in_every_pixel():
    pixels, sigma = 1000, 0.02
    truth = everywhere(pixels, (0.4, 0.5, 1.3, 0.6, 0.2))
    model = Model(noise=InferredNoise(1e-3, 1e-9, "pixel"))
    result = fit(model, replace(simulate(Model(), truth, BALANCED, sigma, rng=3), sigma=None))
    low, high = result.interval(0.9)
    for name in Parameters._fields:
        inside = (getattr(low, name) <= getattr(truth, name)) & (getattr(truth, name) <= getattr(high, name))
        assert np.mean(inside) == pytest.approx(0.9, abs=0.04)
    # 12 real data less 5 parameters: sigma^2 is known to sqrt(2 / 7) in each pixel
    assert np.mean(result.sigma**2) == pytest.approx(sigma**2, rel=4 * np.sqrt(2 / 7 / pixels))
    assert np.std(result.sigma**2) == pytest.approx(np.sqrt(2 / 7) * sigma**2, rel=0.2)
    assert not np.any(result.status & int(Status.BAD_FIT | Status.NOT_CONVERGED))


def test_log_evidence_with_unknown_noise_is_the_integral_over_the_ranges():
    model = Model(noise=InferredNoise(0.5, 0.002, "pixel"), fixed={"diattenuation": 0.0})
    measurement = simulate(model, Parameters(0.0, 0.0, 1.9, 0.5, 0.3), BALANCED, 0.06, rng=1)
    measurement = replace(measurement, sigma=None)
    axes = [np.linspace(-limit, limit, count) for limit, count in ((np.pi, 121), (np.pi / 2, 181), (np.pi, 101))]
    mesh = np.meshgrid(*axes, indexing="ij")
    values = np.asarray(model.log_posterior(Parameters(0.0, 0.0, *mesh), measurement))
    top = values.max()
    density = np.exp(values - top)
    for axis in reversed(axes):
        density = np.trapezoid(density, axis, axis=-1)
    assert float(fit(model, measurement).log_evidence) == pytest.approx(np.log(density) + top, abs=0.1)


@pytest.mark.slow  # two models to compile
def test_a_residual_beyond_what_the_prior_of_sigma_expects_is_a_bad_fit():
    truth = everywhere(200, (0.4, 0.5, 1.3, 0.6, 0.2))
    sure, unsure = InferredNoise(50.0, 50 * 0.01**2, "pixel"), InferredNoise(0.1, 0.1 * 0.01**2, "pixel")
    flagged = []
    for noise, sigma in ((sure, 0.05), (unsure, 0.05), (sure, 0.01)):
        measurement = replace(simulate(Model(), truth, BALANCED, sigma, rng=3), sigma=None)
        flagged.append(np.mean(fit(Model(noise=noise), measurement).status & int(Status.BAD_FIT) != 0))
    assert flagged[0] > 0.9
    assert flagged[1] == 0
    assert flagged[2] < 0.03


@pytest.mark.parametrize(
    "gain", ["none", pytest.param("phase", marks=pytest.mark.slow), pytest.param("complex", marks=pytest.mark.slow)]
)
def test_the_sigma_of_a_frame_is_found(gain):
    scene = polinfer.phantoms.lesion((12, 12), rng=1)
    model = Model(gain=GAINS[gain], noise=InferredNoise(1e-3, 1e-9, "frame"))
    measurement = simulate(model, scene.parameters, BALANCED, 0.05, rng=2)
    assert model.noise.sigma(measurement).shape == (12, 12)
    response = measurement.response.copy()
    response[3, 4] = np.nan
    mask = np.ones((12, 12), bool)
    mask[7] = False
    response[7] += 100.0  # would drown the noise of all others
    result = fit(model, Measurement(BALANCED, response, mask=mask))
    used = 143 - 12
    freedom = 12 - 5 - model.known_gain.real_parameters
    assert float(result.sigma[0, 0]) == pytest.approx(0.05, rel=4 * 0.5 * np.sqrt(2 / (freedom * used)))
    assert np.ptp(result.sigma) == 0
    known = fit(Model(gain=GAINS[gain]), Measurement(BALANCED, response, result.sigma, mask=mask))
    np.testing.assert_allclose(result.log_posterior, known.log_posterior, atol=1e-6)
    assert result.status[3, 4] == Status.NON_FINITE
    assert (result.status[7] == Status.MASKED).all()


def test_what_the_model_leaves_out_counts_as_noise_of_the_frame():
    scene = polinfer.phantoms.lesion((10, 10), rng=1)
    measurement = simulate(Model(), scene.parameters, BALANCED, 0.03, rng=2)
    generator = np.random.default_rng(5)
    # crosstalk that the model does not know of, of the size of the noise
    other = 0.03 * (generator.normal(size=(10, 10, 2, 3)) + 1j * generator.normal(size=(10, 10, 2, 3))) / 2**0.5
    result = fit(Model(noise=InferredNoise(1e-3, 1e-9, "frame")), Measurement(BALANCED, measurement.response + other))
    assert float(result.sigma[0, 0]) == pytest.approx(0.03 * 2**0.5, rel=4 * 0.5 * np.sqrt(2 / (7 * 100)))
    # without noise, what is left is rounding and the prior
    clean = Measurement(BALANCED, np.asarray(Model().jones(scene.parameters)) @ BALANCED)
    assert float(fit(Model(noise=InferredNoise(1.0, 1e-10, "frame")), clean).sigma[0, 0]) < 1e-5


def test_an_empty_field_and_a_perfect_polariser_do_not_falsify_the_sigma_of_a_frame():
    # at D = 0 and eta = 0 no angle is identified, and yet the fit follows the noise in five directions
    for x in ((0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 0.3, 1.0, 0.5, 0.2)):
        truth = everywhere((14, 14), x)
        measurement = replace(simulate(Model(), truth, BALANCED, 0.02, rng=2), sigma=None)
        found = fit(Model(noise=InferredNoise(1e-3, 1e-9, "frame")), measurement).sigma
        assert float(found[0, 0]) == pytest.approx(0.02, rel=4 * 0.5 * np.sqrt(2 / (7 * 196)))


def test_the_frame_of_a_fit_is_the_maximum_of_the_summed_evidence():
    scene = polinfer.phantoms.lesion((8, 8), rng=3)
    noise = InferredNoise(3.0, 3 * 0.2**2, "frame")
    measurement = replace(simulate(Model(), scene.parameters, BALANCED, 0.1, rng=2), sigma=None)
    best = float(fit(Model(noise=noise), measurement).sigma[0, 0])

    def density(sigma):
        evidence = fit(Model(), replace(measurement, sigma=np.array(sigma))).log_evidence.sum()
        return evidence + brute.log_inverse_gamma(sigma**2, noise.shape, noise.scale) + np.log(sigma**2)

    step = 0.05
    low, middle, high = (density(best * np.exp(k * step)) for k in (-1, 0, 1))
    offset = 0.5 * step * (high - low) / (2 * middle - high - low)  # the vertex of the parabola
    width = step / np.sqrt(2 * middle - high - low)
    assert abs(offset) < 0.5 * width
    assert 2 * middle - high - low > 0


@pytest.mark.slow  # four models to compile
def test_complex64_gives_float32_for_either_scope():
    scene = polinfer.phantoms.lesion((4, 5), rng=1)
    measurement = simulate(Model(), scene.parameters, BALANCED.astype(np.complex64), 0.02, rng=2)
    single = Measurement(measurement.illumination, measurement.response.astype(np.complex64))
    double = Measurement(measurement.illumination, single.response.astype(complex))
    for scope in ("pixel", "frame"):
        model = Model(noise=InferredNoise(2.0, 2 * 0.02**2, scope))
        low, high = fit(model, single), fit(model, double)
        assert low.sigma.dtype == low.log_evidence.dtype == np.float32
        np.testing.assert_allclose(low.sigma, high.sigma, rtol=2e-3)
        np.testing.assert_allclose(low.log_posterior, high.log_posterior, atol=5e-3)


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: InferredNoise(0.0, 1.0, "pixel"), ValueError, "shape must be > 0"),
        (lambda: InferredNoise(1.0, -1.0, "pixel"), ValueError, "scale must be > 0"),
        (lambda: InferredNoise(1.0, np.nan, "pixel"), ValueError, "scale must be finite"),
        (lambda: InferredNoise(1.0, 1.0, "state"), ValueError, 'scope must be "pixel" or "frame"'),
        (
            lambda: fit(Model(noise=InferredNoise(1.0, 1.0, "pixel")), Measurement(np.eye(2), np.eye(2), 0.1)),
            ValueError,
            "pass sigma=None",
        ),
        (
            lambda: fit(Model(noise=InferredNoise(1.0, 1.0, "frame")), Measurement(np.eye(2), np.eye(2), 0.1)),
            ValueError,
            "pass sigma=None",
        ),
        (
            lambda: Model(noise=InferredNoise(1.0, 1.0, "frame")).log_likelihood(
                Parameters(*X), Measurement(np.eye(2), np.eye(2))
            ),
            ValueError,
            "give Measurement the sigma of a fit",
        ),
    ],
)
def test_wrong_declarations_are_named(make, error, text):
    with pytest.raises(error, match=text):
        make()
