"""A window of pixels has the likelihood of all its data, and every pixel is in the right windows."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import polinfer
from polinfer import (
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    RetarderFirst,
    Status,
    Window,
    decompose,
    fit,
    simulate,
)
from polinfer.neighbours import box_mean, box_sum
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED, GAINS, X, everywhere

NOISES = {"known": None, "pixel": InferredNoise(1.5, 0.06, "pixel")}


def around(y, x, shape, window):
    """Pixels of the window around (y, x)."""
    for i in range(y - window.rows // 2, y + window.rows // 2 + 1):
        for j in range(x - window.columns // 2, x + window.columns // 2 + 1):
            if 0 <= i < shape[0] and 0 <= j < shape[1]:
                yield i, j


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 3, 5, 7, 21]), st.sampled_from([1, 3, 5, 7, 21]),
    st.integers(0, 1000),
)  # fmt: skip
def test_box_sums_are_the_naive_loop(rows, columns, high, wide, seed):
    window = Window(high, wide)
    values = np.random.default_rng(seed).normal(size=(2, rows, columns, 2))
    got = box_sum(values, window, trailing=1)
    for y in range(rows):
        for x in range(columns):
            expected = sum(values[:, i, j] for i, j in around(y, x, (rows, columns), window))
            np.testing.assert_allclose(got[:, y, x], expected, atol=1e-12)


def test_a_large_value_leaves_no_trace_in_windows_that_do_not_hold_it():
    values = np.ones(200)
    values[50] = 1e20
    got = box_sum(values, Window(1, 5))
    assert (got[53:] == np.r_[np.full(145, 5.0), 4.0, 3.0]).all()
    counted = box_sum(np.ones((4, 5), bool).astype(int), Window(3, 3))
    assert counted.dtype.kind == "i"
    assert counted[0].tolist() == [4, 6, 6, 6, 4]


def test_a_line_and_a_single_pixel_are_frames_of_one_row():
    line = np.arange(5.0)
    assert box_sum(line, Window(7, 3)).tolist() == [1, 3, 6, 9, 7]
    assert float(box_sum(np.array(2.0), Window(3, 3))) == 2
    mean = box_mean(np.array([1.0, np.nan, 3.0, 5.0]), Window(1, 3))
    np.testing.assert_array_equal(mean, [1.0, np.nan, 4.0, 4.0])


def scene(kind, shape=(4, 5), states=3, sigma=0.2):
    """A frame with the traps of a frame: masked, broken and empty pixels, missing states, sigma or states by pixel."""
    generator = np.random.default_rng(7)

    def normal(*size):
        return (generator.normal(size=size) + 1j * generator.normal(size=size)) / 2**0.5

    u = normal(*(shape if kind == "states" else ()), 2, states)
    noise_level = generator.uniform(0.5, 1.5, shape) * sigma if kind == "sigma" else np.array(sigma)
    x = [np.full(shape, value) + 0.1 * generator.normal(size=shape) for value in X]
    v = np.array([[oracle.jones([p[i, j] for p in x]) for j in range(shape[1])] for i in range(shape[0])]) @ u
    v = v + noise_level[..., None, None] * normal(*shape, 2, states)
    weight = None
    mask = np.ones(shape, bool)
    if kind == "weights":
        weight = generator.uniform(0.3, 2, (*shape, states))
        weight[0, 0] = 0
        weight[-1, -1, 0] = 0
    if kind != "plain":
        v[1 % shape[0], 2, 0, 0] = np.nan
        mask[shape[0] // 2, -1] = False
    return Measurement(u, v, noise_level, weight, mask)


def by_pixel(measurement, unknown):
    """A measurement of every pixel alone."""
    m = measurement
    shape = m.shape
    u = np.broadcast_to(m.illumination, (*shape, *m.illumination.shape[-2:]))
    sigma = np.broadcast_to(m.sigma, shape)
    for i in range(shape[0]):
        for j in range(shape[1]):
            weight = None if m.weight is None else m.weight[i, j]
            yield (i, j), Measurement(u[i, j], m.response[i, j], None if unknown else sigma[i, j], weight)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("kind", ["plain", "shared", "sigma", "states", "weights"])
@pytest.mark.parametrize("window", [Window(3, 5), Window(1, 3), Window(9, 1)])
def test_the_log_likelihood_of_a_window_is_the_sum_over_its_pixels(kind, gain, noise, window):
    measurement = scene(kind)
    single = Model(gain=GAINS[gain]) if noise == "known" else Model(gain=GAINS[gain], noise=NOISES[noise])
    model = Model(gain=single.gain, noise=single.noise, neighbours=window)
    x = Parameters(*X)
    alone = {}
    for place, pixel in by_pixel(measurement, noise != "known"):
        value = float(single.log_likelihood(x, pixel))
        if measurement.mask[place] and np.isfinite(value):
            alone[place] = value
            if noise == "known" and gain != "phase":
                w = np.ones(3) if pixel.weight is None else pixel.weight
                root = np.sqrt(w)
                expected = oracle.log_marginal(
                    X, pixel.illumination * root, pixel.response * root, float(pixel.sigma), gain, 0.8
                )
                expected += np.sum(np.where(w > 0, 2 * np.log(np.where(w > 0, w, 1)), 0))
                expected += 2 * np.sum(w == 0) * np.log(np.pi * float(pixel.sigma) ** 2)
                assert value == pytest.approx(expected, abs=1e-9)
    used = measurement if noise == "known" else Measurement(
        measurement.illumination, measurement.response, None, measurement.weight, measurement.mask
    )  # fmt: skip
    got = np.asarray(model.log_likelihood(x, used))
    for y in range(4):
        for j in range(5):
            if (y, j) not in alone:
                assert np.isnan(got[y, j])
                continue
            expected = sum(alone[p] for p in around(y, j, (4, 5), window) if p in alone)
            assert got[y, j] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("gain", ["none", "phase", "complex"])
def test_one_row_a_grid_of_parameters_and_a_frame_of_noise_are_windows_too(gain):
    measurement = scene("shared", (1, 6))
    model = Model(gain=GAINS[gain], neighbours=Window(3, 5))
    values = Parameters(*(np.array(value) + np.zeros((2, 1, 1)) for value in X))
    got = model.log_likelihood(values, measurement)
    assert got.shape == (2, 1, 6)
    np.testing.assert_array_equal(got[0], got[1])
    line = Measurement(measurement.illumination, measurement.response[0], measurement.sigma, mask=measurement.mask[0])
    np.testing.assert_allclose(model.log_likelihood(Parameters(*X), line), got[0, 0], atol=1e-10)
    frame = Model(gain=GAINS[gain], neighbours=Window(3, 5), noise=InferredNoise(1.0, 1.0, "frame"))
    np.testing.assert_array_equal(frame.log_likelihood(Parameters(*X), line), got[0, 0])
    assert np.isfinite(model.log_likelihood(Parameters(*X), Measurement(np.eye(2), np.eye(2), 0.1)))


@pytest.mark.parametrize("gain", ["none", "complex"])
@pytest.mark.parametrize("kind", ["shared", "states"])
@pytest.mark.parametrize("noise", [1e-4, 1e-8])
def test_sums_over_a_window_keep_the_digits_of_a_high_signal(gain, kind, noise):
    generator = np.random.default_rng(3)
    shape = (6, 40)
    u = generator.normal(size=(*(shape if kind == "states" else ()), 2, 3)) + 0j
    # the matrix drifts by about the noise over the frame
    x = Parameters(*(np.asarray(value) + noise * np.linspace(0, 1, 240).reshape(shape) for value in X))
    factor = 1.0 if gain == "none" else np.exp(1j * generator.uniform(-3, 3, shape))[..., None, None]
    clean = factor * (np.asarray(Model().jones(x)) @ u)
    error = generator.normal(size=clean.shape) + 1j * generator.normal(size=clean.shape)
    measurement = Measurement(u, clean + noise * error / 2**0.5, noise)
    model, single = (Model(gain=GAINS[gain], neighbours=w) for w in (Window(3, 5), None))
    got = np.asarray(model.log_likelihood(Parameters(*X), measurement))
    each = np.asarray(single.log_likelihood(Parameters(*X), measurement))
    for place in ((0, 0), (2, 20), (5, 39)):
        expected = sum(each[p] for p in around(*place, shape, Window(3, 5)))
        assert got[place] == pytest.approx(expected, abs=1e-3 if noise > 1e-5 else 1e-4)


@pytest.mark.parametrize("gain", ["none", pytest.param("complex", marks=pytest.mark.slow)])
def test_a_window_over_the_whole_frame_gives_every_pixel_the_same_fit_and_sharper_widths(gain):
    truth = everywhere((3, 3), (0.4, 0.5, 1.3, 0.6, 0.2))
    measurement = simulate(Model(gain=GAINS[gain]), truth, BALANCED, 0.05, rng=3)
    result = fit(Model(gain=GAINS[gain], neighbours=Window(5, 5)), measurement)
    alone = fit(Model(gain=GAINS[gain]), measurement)
    for name in Parameters._fields:
        values = getattr(result.parameters, name)
        assert np.ptp(values) < 1e-6
        assert abs(values[0, 0] - getattr(truth, name)[0, 0]) < 5 * getattr(result.std, name)[0, 0]
        together = np.sum(getattr(alone.std, name) ** -2.0) ** -0.5
        assert getattr(result.std, name)[1, 1] == pytest.approx(together, rel=0.25)
    assert (result.status == 0).all()
    gains = 0 if gain == "none" else GAINS[gain].real_parameters
    assert (result.degrees_of_freedom == 9 * 12 - 5 - 9 * gains).all()
    freedom = float(result.degrees_of_freedom[0, 0])
    assert abs(float(result.chi_square[0, 0]) - freedom) < 4 * np.sqrt(2 * freedom)
    if gain != "none":
        assert result.gain.shape == (3, 3)
        phase = np.angle(result.gain / alone.gain)
        assert np.abs(np.sin(phase)).max() < 0.3  # up to the sign that gain and retardance share
        assert np.ptp(np.abs(result.gain)) > 0


@pytest.mark.parametrize(
    ("gain", "noise"),
    [
        ("none", "known"),
        pytest.param("complex", "known", marks=pytest.mark.slow),
        pytest.param("phase", "pixel", marks=pytest.mark.slow),
    ],
)
def test_the_fit_of_a_window_is_a_maximum_of_the_windowed_density(gain, noise):
    measurement = scene("weights" if gain == "none" else "shared", (3, 4), sigma=0.1)
    declared = {} if noise == "known" else {"noise": NOISES[noise]}
    if noise == "pixel":
        measurement = Measurement(measurement.illumination, measurement.response, mask=measurement.mask)
    model = Model(gain=GAINS[gain], neighbours=Window(3, 3), **declared)
    result = fit(model, measurement)
    lost = np.isnan(np.asarray(model.log_likelihood(Parameters(*X), measurement)))
    assert (np.isnan(result.parameters.retardance) == lost).all()
    assert ((result.status & int(Status.MASKED | Status.NON_FINITE)) != 0)[lost].all()
    assert lost.sum() == 2
    at_best = np.asarray(model.log_posterior(result.parameters, measurement))
    np.testing.assert_allclose(at_best[~lost], result.log_posterior[~lost], atol=1e-6)
    generator = np.random.default_rng(1)
    for _ in range(20):
        moved = Parameters(*(x + 0.02 * generator.normal(size=(3, 4)) for x in result.parameters))
        assert (np.asarray(model.log_posterior(moved, measurement))[~lost] <= at_best[~lost] + 1e-9).all()
    assert np.isfinite(result.log_evidence[~lost]).all()


def test_a_frame_of_unknown_noise_is_found_with_a_window():
    truth = everywhere((8, 8), (0.4, 0.5, 1.3, 0.6, 0.2))
    measurement = simulate(Model(), truth, BALANCED, 0.05, rng=3)
    model = Model(noise=InferredNoise(1e-3, 1e-9, "frame"), neighbours=Window(3, 3))
    result = fit(model, Measurement(BALANCED, measurement.response))
    assert float(result.sigma[0, 0]) == pytest.approx(0.05, rel=4 * 0.5 * np.sqrt(2 / (12 * 64 - 5 * 8)))


def test_float32_windows_agree_with_float64():
    landscape = polinfer.phantoms.lesion((5, 6), rng=1)
    double = simulate(Model(), landscape.parameters, BALANCED, 0.01, rng=2)
    single = Measurement(
        double.illumination.astype(np.complex64), double.response.astype(np.complex64), np.float32(0.01)
    )
    x = Parameters(*X)
    for gain in GAINS.values():
        model = Model(gain=gain, neighbours=Window(3, 3))
        low = model.log_likelihood(Parameters(*map(jnp.float32, X)), single)
        high = model.log_likelihood(x, double)
        assert low.dtype == np.float32
        np.testing.assert_allclose(low, high, rtol=1e-4)


def test_the_closed_form_of_a_window_is_that_of_the_mean_matrix():
    generator = np.random.default_rng(2)
    truth = everywhere((5, 6), (0.4, 0.5, 1.3, 0.6, 0.2))
    jones = np.asarray(RetarderFirst().jones(truth))
    noisy = jones + 0.05 * (generator.normal(size=jones.shape) + 1j * generator.normal(size=jones.shape))
    noisy[2, 3, 0, 1] = np.nan
    window = Window(3, 3)
    found = decompose(noisy, RetarderFirst(), window)
    for y in range(5):
        for x in range(6):
            members = [noisy[p] for p in around(y, x, (5, 6), window) if np.isfinite(noisy[p]).all()]
            expected = decompose(np.mean(members, axis=0), RetarderFirst())
            for a, b in zip(found, expected, strict=True):
                if (y, x) == (2, 3):
                    assert np.isnan(a[y, x])
                else:
                    assert a[y, x] == pytest.approx(float(b), abs=1e-9)
    single = decompose(noisy.astype(np.complex64), RetarderFirst(), window)
    assert single.retardance.dtype == np.float32


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: Window(2, 3), ValueError, "rows must be odd"),
        (lambda: Window(3, 0), ValueError, "columns must be >= 1"),
        (lambda: Window(3, 1.0), TypeError, "columns must be an integer"),
        (lambda: Model(neighbours=3), TypeError, "neighbours must be Window"),
        (lambda: decompose(np.eye(2), RetarderFirst(), 3), TypeError, "neighbours must be Window"),
    ],
)
def test_wrong_windows_are_named(make, error, text):
    with pytest.raises(error, match=text):
        make()
