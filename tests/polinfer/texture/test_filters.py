"""The filters give what a loop over the windows gives, and what they estimate is without bias."""

import numpy as np
import pytest
from scipy.special import i0e

from polinfer import AxialVonMises, TruncatedNormal, VonMises, texture
from polinfer.texture import Angle, Bounded, Chi, Rescaled
from polinfer.texture.angles import concentration_of
from polinfer.texture.bounded import truncated_entropy
from tests.polinfer.texture import oracle


def scene(shape=(23, 31), concentration=2.0, seed=1):
    rng = np.random.default_rng(seed)
    image = rng.vonmises(2.9, concentration, shape)
    image[3, 4] = np.nan
    image[-1, -1] = np.inf
    return image, rng.random(shape) < 0.7


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("prior", "period"), [(VonMises, 2 * np.pi), (AxialVonMises, np.pi)])
def test_filters_agree_with_a_loop_over_masked_windows(dtype, prior, period):
    image, used = scene()
    image = (image * (period / (2 * np.pi))).astype(dtype)
    mean, entropy = oracle.angles(image, 7, period, used)
    found = texture.describe(image, 7, prior, used)
    assert found.expectation.dtype == found.entropy.dtype == dtype
    tolerance = 1e-9 if dtype == np.float64 else 1e-5
    turn = 2 * np.pi / period
    np.testing.assert_allclose(np.exp(1j * turn * found.expectation), np.exp(1j * turn * mean), atol=tolerance)
    np.testing.assert_allclose(found.entropy, entropy, atol=tolerance)
    np.testing.assert_array_equal(texture.entropy(image, 7, prior, used), found.entropy)
    np.testing.assert_array_equal(texture.expectation(image, 7, prior, used), found.expectation)
    assert np.all(np.abs(found.expectation) <= period / 2 * (1 + 1e-6))


def test_a_window_with_too_few_pixels_has_no_answer_and_others_have():
    image = np.full((9, 9), np.nan)
    image[4, 3:8] = [0.1, 0.2, -0.1, 0.4, 0.3]
    found = texture.describe(image, 5)
    assert found.count[4, 5] == 5
    assert np.array_equal(np.isfinite(found.entropy), found.count >= 5)
    assert np.array_equal(np.isfinite(found.expectation), found.count >= 5)
    assert np.isfinite(texture.entropy(image, 5, fewest=4)).sum() > np.isfinite(found.entropy).sum()


@pytest.mark.parametrize("shape", [(1, 30), (30, 1), (1, 1), (30,), (2, 3, 8, 9)])
def test_any_shape_of_frame(shape):
    image = np.random.default_rng(2).vonmises(0, 1, shape)
    found = texture.describe(image, 15)
    assert found.entropy.shape == shape
    if image.ndim == 4:
        np.testing.assert_array_equal(found.entropy[1, 2], texture.entropy(image[1, 2], 15))
    elif image.size > 1:
        assert np.all(np.isfinite(found.entropy))


def test_entropy_of_a_concentration_from_1e_minus_6_to_1e6():
    for kappa in np.logspace(-6, 6, 25):
        assert abs(float(texture.von_mises_entropy(kappa)) - oracle.von_mises(kappa)) < 1e-7
    np.testing.assert_allclose(texture.von_mises_entropy(0.0), np.log(2 * np.pi), rtol=1e-15)


def test_concentrations_are_found_from_resultants():
    from scipy.special import i1e

    kappa = np.logspace(-5, 5, 41)
    np.testing.assert_allclose(concentration_of(i1e(kappa) / i0e(kappa)), kappa, rtol=1e-8)


@pytest.mark.parametrize("concentration", [0.01, 30.0, 1e3, 1e5])
def test_single_precision_is_right_to_1e_3(concentration):
    image = np.random.default_rng(3).vonmises(3.0, concentration, (40, 40)).astype(np.float32)
    single, double = texture.describe(image, 15), texture.describe(image.astype(float), 15)
    np.testing.assert_allclose(single.entropy, double.entropy, atol=3e-4)
    np.testing.assert_allclose(np.exp(1j * single.expectation), np.exp(1j * double.expectation), atol=3e-5)


def test_equal_pixels_have_no_spread_and_their_own_mean():
    for dtype in (np.float32, np.float64):
        found = texture.describe(np.full((8, 8), 3.0, dtype), 5)
        assert np.all(found.entropy < -12)
        np.testing.assert_allclose(found.expectation, 3.0, rtol=1e-6)


def tiles(values, side):
    """Means over tiles of side x side pixels."""
    rows, columns = values.shape[0] // side, values.shape[1] // side
    return values.reshape(rows, side, columns, side).mean(axis=(1, 3))


@pytest.mark.parametrize(("side", "bar"), [(5, 0.005), (15, 0.001)])
@pytest.mark.parametrize("concentration", [0.1, 2.0, 100.0])
def test_entropies_of_independent_angles_are_right_on_average(side, bar, concentration):
    """Against the mean of -log p of the same draws, whose expectation is the entropy and which fluctuates alike."""
    image = np.random.default_rng(4).vonmises(0, concentration, (60 * side, 60 * side))
    truth = np.log(2 * np.pi * i0e(concentration)) + concentration * (1 - tiles(np.cos(image), side))
    centre = slice(side // 2, None, side)
    error = texture.entropy(image, side)[centre, centre] - truth
    standard = error.std() / 60
    assert abs(error.mean()) + 2 * standard < bar
    assert standard < bar / 5


@pytest.mark.parametrize("degrees", [1, 2, 5])
def test_chi_entropy_and_mean_are_without_bias(degrees):
    from scipy.special import digamma, gammaln

    rng, side, scale = np.random.default_rng(5), 3, 0.3
    image = scale * np.sqrt(rng.chisquare(degrees, (150 * side, 150 * side)))
    true = oracle.grid_entropy(lambda x: (degrees - 1) * np.log(x) - x * x / (2 * scale**2), 1e-9, 12 * scale)
    closed = gammaln(degrees / 2) + (degrees - np.log(2) - (degrees - 1) * digamma(degrees / 2)) / 2 + np.log(scale)
    assert abs(true - closed) < 1e-6
    found = texture.describe(image, side, Chi(degrees))
    for values, expected in (
        (found.entropy, true),
        (found.expectation, scale * np.sqrt(2) * np.exp(gammaln((degrees + 1) / 2) - gammaln(degrees / 2))),
    ):
        inner = values[1::side, 1::side]
        assert abs(inner.mean() - expected) < 4 * inner.std() / inner.size**0.5
    np.testing.assert_array_equal(texture.entropy(image, side, Chi()), texture.entropy(image, side, Chi(1)))


def test_truncated_gaussians_have_the_entropy_of_their_moments():
    rng = np.random.default_rng(6)
    for _ in range(60):
        middle, scale = rng.uniform(-2, 2), 10 ** rng.uniform(-1.5, 1)
        # the part of [-1, 1] where the density is not 0
        top = np.clip(middle, -1, 1)
        reach = 14 * scale if abs(middle) < 1 else min(14 * scale, 40 * scale**2 / (abs(middle) - 1))
        low, high = max(-1, top - reach), min(1, top + reach)
        x = low + (np.arange(40_000) + 0.5) * ((high - low) / 40_000)
        weight = np.exp((-((x - middle) ** 2) + (top - middle) ** 2) / (2 * scale**2))
        weight /= weight.sum()
        mean = np.sum(weight * x)
        variance = np.sum(weight * (x - mean) ** 2)
        true = oracle.grid_entropy(lambda y, m=middle, s=scale: -(((y - m) / s) ** 2) / 2, low, high)
        assert abs(truncated_entropy(mean, variance) - true) < 1e-4, (middle, scale)


def test_variances_beyond_the_exponential_density_count_as_that_one():
    assert abs(truncated_entropy(0.0, 0.9) - np.log(2)) < 1e-4  # uniform
    assert abs(truncated_entropy(0.0, 0.9) - truncated_entropy(0.0, 1 / 3)) < 1e-12


def test_truncated_entropies_are_right_on_average_and_scale_with_the_bounds():
    rng, side = np.random.default_rng(7), 5
    prior = TruncatedNormal(0.7, 0.4, -1.0, 1.0)
    image = prior.sample(rng, (80 * side, 80 * side))
    true = oracle.grid_entropy(lambda x: -(((x - 0.7) / 0.4) ** 2) / 2, -1, 1)
    found = texture.entropy(image, side, TruncatedNormal)[2::side, 2::side]
    control = tiles(-np.asarray(prior.log_density(image), float), side)
    error = found - control
    assert abs(control.mean() - true) < 5 * control.std() / 80
    assert abs(error.mean()) < 0.005
    assert error.std() / 80 < 0.001
    moved = texture.describe(3 + 2 * image, side, Bounded(1.0, 5.0))
    np.testing.assert_allclose(moved.entropy[2::side, 2::side], found + np.log(2), atol=1e-9)
    np.testing.assert_allclose(moved.expectation, 3 + 2 * texture.expectation(image, side, TruncatedNormal), rtol=1e-9)


def test_rescaled_values_are_gaussian():
    image = np.random.default_rng(8).normal(5.0, 0.1, (60, 60))
    found = texture.describe(image, 59, Rescaled(5.0, 2.0))
    assert abs(found.entropy[30, 30] - 0.5 * np.log(2 * np.pi * np.e * np.var(image[1:, 1:]))) < 0.003
    assert abs(found.expectation[30, 30] - image[1:, 1:].mean()) < 1e-4


@pytest.mark.parametrize("concentration", [1.0, 10.0])
def test_noise_is_taken_out_of_the_entropy_of_angles(concentration):
    rng, side = np.random.default_rng(9), 15
    tissue = rng.vonmises(0.5, concentration, (60 * side, 60 * side))
    std = rng.uniform(0.1, 0.4, tissue.shape)
    seen = tissue + std * rng.normal(size=tissue.shape)
    found = texture.describe(seen, side, std=std)
    centre = slice(7, None, side)
    true = oracle.von_mises(concentration)
    inner = found.entropy[centre, centre]
    assert abs(inner.mean() - true) < max(4 * inner.std() / 60, 0.002)
    assert texture.entropy(seen, side)[centre, centre].mean() > true + 0.01
    # as wide as a Gaussian of the mean square width, the narrow noise of heavier pixels counting more
    gaussian = 0.5 * np.log(2 * np.pi * np.e * np.mean(std**2))
    assert abs(found.noise_entropy.mean() - gaussian) < 0.05
    assert np.all(found.count < 225)
    assert abs(np.mean(found.expectation[centre, centre]) - 0.5) < 0.01


@pytest.mark.parametrize(
    ("distribution", "draw"),
    [
        (Chi(1), lambda rng, shape: np.abs(rng.normal(0, 0.3, shape))),
        (Bounded(-1, 1), lambda rng, shape: rng.normal(0.1, 0.15, shape)),
        (Rescaled(0.1, 3.0), lambda rng, shape: rng.normal(0.1, 0.15, shape)),
    ],
)
def test_noise_is_taken_out_of_other_entropies(distribution, draw):
    rng, side = np.random.default_rng(10), 15
    tissue = draw(rng, (20 * side, 20 * side))
    noise = 0.1
    centre = slice(7, None, side)
    if isinstance(distribution, Chi):
        seen = np.sqrt(tissue**2 + (noise * rng.normal(size=tissue.shape)) ** 2)
    else:
        seen = tissue + noise * rng.normal(size=tissue.shape)
    found = texture.entropy(seen, side, distribution, std=noise)[centre, centre]
    true = texture.entropy(tissue, side, distribution)[centre, centre]
    assert abs(np.mean(found - true)) < 0.01
    assert texture.entropy(seen, side, distribution)[centre, centre].mean() > true.mean() + 0.03


def test_noise_alone_leaves_no_disorder():
    rng = np.random.default_rng(11)
    image = 0.2 * rng.normal(size=(45, 45))
    for distribution in (VonMises, TruncatedNormal):
        found = texture.describe(image.clip(-1, 1), 15, distribution, std=np.full(image.shape, 0.25))
        assert np.all(np.isneginf(found.entropy))
        assert np.all(np.isfinite(found.noise_entropy))


def test_pixels_whose_noise_has_no_width_are_left_out():
    image, std = np.zeros((9, 9)), np.full((9, 9), 0.1)
    image[:, 4:] = 2.0
    std[:, 4:] = np.nan
    assert np.all(np.abs(texture.expectation(image, 3, std=std, fewest=3)[:, :4]) < 1e-12)
    assert np.all(np.isnan(texture.expectation(image, 3, std=std, fewest=3)[:, 5:]))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"size": 4}, ValueError, "size must be odd"),
        ({"size": 1}, ValueError, "size must be >= 3"),
        ({"size": 5.0}, TypeError, "size must be an integer"),
        ({"fewest": 2}, ValueError, "fewest must be >= 3"),
        ({"mask": np.ones((3, 3), int)}, TypeError, "mask must be a bool array"),
        ({"mask": np.ones((2, 3), bool)}, ValueError, "mask has shape"),
        ({"std": -np.ones((9, 9))}, ValueError, "std must be >= 0"),
        ({"distribution": "von mises"}, TypeError, "distribution must be one of the classes VonMises"),
        ({"distribution": VonMises(0, 1)}, TypeError, "distribution must be"),
        ({"distribution": TruncatedNormal}, ValueError, "impossible for Bounded: they must be from -1 to 1"),
        ({"distribution": Chi(1), "image": -np.ones((9, 9))}, ValueError, "impossible for Chi: they must be >= 0"),
        ({"distribution": Rescaled(0.0, 1.0)}, ValueError, "impossible for Rescaled: they must be within"),
        ({"image": np.ones((9, 9), complex)}, TypeError, "image must be real"),
    ],
)
def test_mistakes_are_named(change, error, words):
    arguments = {"image": np.full((9, 9), 2.0), "size": 5} | change
    with pytest.raises(error, match=words):
        texture.describe(**arguments)


def test_settings_of_distributions_are_checked():
    for make in (lambda: Angle(0), lambda: Bounded(1, 1), lambda: Chi(0), lambda: Rescaled(0, -1)):
        with pytest.raises(ValueError, match="must be"):
            make()
