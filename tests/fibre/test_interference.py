"""conj(H) V from phase steps: exact, with a variance that is true."""

import numpy as np
import pytest

from fibre import relative_phase

UNEQUAL = np.array([0.1, 1.3, 2.9, 4.0, 5.5])


def fields(shape=(5, 6), seed=0):
    generator = np.random.default_rng(seed)
    parts = generator.normal(size=(4, *shape))
    return parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]


def interfere(h, v, steps):
    return np.stack([0.5 * np.abs(h + v * np.exp(1j * d)) ** 2 for d in steps], axis=-3)


@pytest.mark.parametrize("steps", [UNEQUAL, UNEQUAL[:3], np.arange(4) * np.pi / 2, [0, 0, 1.0, 2.0]])
def test_the_product_is_exact_for_any_steps(steps):
    h, v = fields((2, 5, 6))
    found = relative_phase(interfere(h, v, steps), steps)
    np.testing.assert_allclose(found.product, np.conj(h) * v, atol=1e-12)
    np.testing.assert_allclose(found.mean, (np.abs(h) ** 2 + np.abs(v) ** 2) / 2, atol=1e-12)


def test_it_is_the_dense_weighted_least_squares_solution():
    generator = np.random.default_rng(1)
    images, weights = generator.normal(size=(5, 2, 3)), generator.uniform(0.1, 3, (5, 2, 3))
    found = relative_phase(images, UNEQUAL, weights)
    design = np.stack([np.ones(5), np.cos(UNEQUAL), -np.sin(UNEQUAL)], 1)
    for y, x in np.ndindex(2, 3):
        root = np.sqrt(weights[:, y, x])
        a, re, im = np.linalg.lstsq(design * root[:, None], images[:, y, x] * root, rcond=None)[0]
        assert found.product[y, x] == pytest.approx(re + 1j * im)
        assert found.mean[y, x] == pytest.approx(a)
        covariance = np.linalg.inv((design.T * weights[:, y, x]) @ design)
        assert found.variance[y, x] == pytest.approx(covariance[1, 1] + covariance[2, 2])


@pytest.mark.parametrize("known", [True, False])
def test_the_stated_variance_is_the_mean_squared_error(known):
    h, v = fields((60, 60))
    generator = np.random.default_rng(2)
    sigma = generator.uniform(0.01, 0.05, (5, 60, 60)) if known else np.full((5, 60, 60), 0.03)
    images = interfere(h, v, UNEQUAL) + sigma * generator.normal(size=sigma.shape)
    found = relative_phase(images, UNEQUAL, 1 / sigma**2 if known else None)
    ratio = np.abs(found.product - np.conj(h) * v) ** 2 / found.variance
    # a sum of two squares of normal variables: standard deviation about 1 a pixel, 3600 pixels
    assert ratio.mean() == pytest.approx(1, abs=4 * ratio.std() / 60)
    assert ratio.std() < 1.5


def test_weight_zero_leaves_a_step_out():
    h, v = fields()
    images = interfere(h, v, UNEQUAL) + 0.01 * np.random.default_rng(3).normal(size=(5, 5, 6))
    weights = np.ones_like(images)
    weights[2] = 0
    images[2] = 1e6
    found = relative_phase(images, UNEQUAL, weights)
    without = relative_phase(np.delete(images, 2, 0), np.delete(UNEQUAL, 2), np.delete(weights, 2, 0))
    np.testing.assert_allclose(found.product, without.product, rtol=1e-10)
    np.testing.assert_allclose(found.variance, without.variance, rtol=1e-10)


def test_fewer_than_three_usable_steps_have_no_answer_and_say_so():
    h, v = fields()
    weights = np.ones((5, 5, 6))
    weights[:3, 1, 2] = 0
    weights[:, 3, 3] = 0
    found = relative_phase(interfere(h, v, UNEQUAL), UNEQUAL, weights)
    lost = np.isnan(found.product)
    assert set(zip(*np.nonzero(lost), strict=True)) == {(1, 2), (3, 3)}
    assert np.all(np.isinf(found.variance) == lost)
    assert np.all(np.isnan(found.mean) == lost)


def test_three_steps_without_weights_leave_the_variance_unknown():
    h, v = fields()
    found = relative_phase(interfere(h, v, UNEQUAL[:3]), UNEQUAL[:3])
    assert np.isnan(found.variance).all()


def test_the_unit_of_the_images_does_not_matter():
    h, v = fields()
    images = interfere(h, v, UNEQUAL)
    small = relative_phase(1e-9 * images, UNEQUAL, np.full(images.shape, 1e24))
    large = relative_phase(1e9 * images, UNEQUAL, np.full(images.shape, 1e-24))
    np.testing.assert_allclose(small.product * 1e18, large.product, rtol=1e-9)


@pytest.mark.parametrize(
    ("images", "steps", "weights", "text"),
    [
        (np.ones((2, 4, 4)), [0, 1.0], None, "steps must hold three different phases"),
        (np.ones((4, 4, 4)), [0, 1, 0, 1.0], None, "steps must hold three different phases"),
        (np.ones((3, 4, 4)), [0, 1, 2 * np.pi], None, "steps must hold three different phases"),
        (np.ones((3, 4, 4)), [0, 1, 2, 3], None, "steps must have shape"),
        (np.ones((4, 4)), [0, 1, 2, 3], None, "images must have shape"),
        (np.full((4, 4, 4), np.nan), [0, 1, 2, 3], None, "images must be finite"),
        (np.ones((4, 4, 4)), [0, 1, 2, 3], np.ones((4, 4)), "weights must have the shape of images"),
        (np.ones((4, 4, 4)), [0, 1, 2, 3], -np.ones((4, 4, 4)), "weights must be >= 0"),
    ],
)
def test_wrong_arguments_are_named(images, steps, weights, text):
    with pytest.raises(ValueError, match=text):
        relative_phase(images, steps, weights)
