"""Joint distributions: the fit finds what it should, and its entropy is that of a dense grid."""

import numpy as np
import pytest

from polinfer import AxialVonMises, TruncatedNormal, VonMises, texture
from polinfer.texture import MultivariateVonMises, Rescaled, TorusGraph, quadrature
from polinfer.texture.joint import score_matching, terms
from polinfer.texture.joint_frames import _correction
from polinfer.texture.quadrature import joint_entropy
from tests.polinfer.texture import oracle

MODELS = [MultivariateVonMises(), TorusGraph()]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize(("angles", "nodes"), [(2, 320), (3, 48)])
def test_quadrature_agrees_with_a_dense_grid(model, angles, nodes):
    statistics = model.statistics(angles)
    rng = np.random.default_rng(1)
    for scale in (0.3, 3.0, 20.0) if angles == 2 else (0.3, 3.0):
        parameters = scale * rng.normal(size=(2, len(statistics)))
        found = joint_entropy(model, parameters, np.full((2, angles), 0.3))
        for value, own in zip(found, parameters, strict=True):
            assert abs(value - oracle.joint_entropy(statistics, own, angles, nodes)) < 1e-3


def test_concentrated_angles_need_no_more_nodes():
    """A narrow first angle, and Gaussians, where the determinant of the precision is the answer."""
    statistics = MultivariateVonMises().statistics(2)
    narrow = np.array([3000.0, 2.0, 20.0])
    resultant = np.array([[1 - 0.5 / 2900, 0.6]])
    found = joint_entropy(MultivariateVonMises(), narrow[None], resultant)[0]
    assert abs(found - oracle.joint_entropy(statistics, narrow, 2, 600)) < 0.01
    close = np.array([400.0, 900.0, 100.0])
    found = joint_entropy(MultivariateVonMises(), close[None], np.array([[0.99875, 0.9994]]))[0]
    assert abs(found - oracle.joint_entropy(statistics, close, 2, 600)) < 0.01


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize(("angles", "nodes"), [(2, 96), (3, 32)])
def test_score_matching_finds_the_parameters_of_exact_moments(model, angles, nodes):
    statistics = model.statistics(angles)
    parameters = np.random.default_rng(2).normal(size=len(statistics))
    grid = oracle.torus(angles, nodes)
    weight = np.exp(oracle.joint_log_density(statistics, parameters, grid))
    weight /= weight.sum()
    needed = terms(model, angles)
    waves = [np.exp(1j * sum(k * g for k, g in zip(f, grid, strict=True))) for f in needed.frequencies]
    means = np.array([[np.sum(weight * wave)] for wave in waves])
    found, point, singular = score_matching(needed, means, noisy=False)
    assert not point[0]
    assert not singular[0]
    np.testing.assert_allclose(found[0], parameters, atol=1e-8)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_sampling_agrees_with_the_grid(model, monkeypatch):
    """Within five of the standard errors that 16,384 draws have."""
    rng = np.random.default_rng(11)
    angles = 3
    parameters = rng.normal(size=(4, len(model.statistics(angles))))
    parameters[:2, :angles] += 6
    resultants = np.array([[0.9] * angles] * 2 + [[0.4] * angles] * 2)
    grid = joint_entropy(model, parameters, resultants)
    monkeypatch.setattr(quadrature, "MOST_NODES", 0)
    np.testing.assert_allclose(joint_entropy(model, parameters, resultants), grid, atol=0.1)


def pairs(rng, shape, spread=0.5):
    one = rng.vonmises(0.4, 3.0, shape)
    return one, one + rng.normal(0.3, spread, shape)


def test_the_filter_fits_the_pixels_of_each_window():
    rng = np.random.default_rng(3)
    one, other = pairs(rng, (17, 19))
    other[5, 6] = np.nan
    used = rng.random(one.shape) < 0.9
    model = MultivariateVonMises()
    found = texture.entropy([one, other / 2], 9, [VonMises, AxialVonMises], used, stride=3)
    assert found.shape == (6, 7)
    needed = terms(model, 2)
    both = np.where(np.isnan(other), np.nan, one)
    for row, column in ((0, 0), (6, 9), (15, 18)):
        x = oracle.members(both, row, column, 9, used)
        y = oracle.members(other, row, column, 9, used)
        z = np.array([np.exp(1j * x), np.exp(1j * y)])
        z *= np.exp(-1j * np.angle(z.mean(axis=1, keepdims=True)))
        means = np.array([[np.mean(z[0] ** f[0] * z[1] ** f[1])] for f in needed.frequencies])
        parameters = score_matching(needed, means, noisy=False)[0]
        expected = oracle.joint_entropy(model.statistics(2), parameters[0], 2, 256)
        expected += float(_correction(np.array([len(x)]), 2, 5)[0]) - np.log(2)
        assert abs(found[row // 3, column // 3] - expected) < 2e-3


def test_joint_entropies_of_independent_angles_are_sums_on_average():
    rng, side = np.random.default_rng(4), 15
    images = [rng.vonmises(0, k, (20 * side, 20 * side)) for k in (1.0, 8.0)]
    centre = slice(7, None, side)
    joint = texture.entropy(images, side, stride=1)[centre, centre]
    apart = sum(texture.entropy(x, side)[centre, centre] for x in images)
    difference = joint - apart
    assert abs(difference.mean()) < 0.004
    assert difference.std() / 20 < 0.001


def test_gaussian_pairs_have_the_entropy_of_their_covariance():
    rng, size = np.random.default_rng(5), 31
    covariance = np.array([[0.02, 0.015], [0.015, 0.03]])
    one, other = np.moveaxis(rng.multivariate_normal([0, 0.3], covariance, (size, size)), -1, 0)
    found = texture.entropy([one, other], size)[size // 2, size // 2]
    sample = np.cov(one.ravel(), other.ravel())
    assert abs(found - 0.5 * np.log(np.linalg.det(2 * np.pi * np.e * sample))) < 0.01
    rescaled = texture.entropy([one, 10 * other], size, [VonMises, Rescaled(3.0, 20.0)])[size // 2, size // 2]
    assert abs(rescaled - found - np.log(10)) < 0.01


def test_four_images_at_once():
    rng = np.random.default_rng(6)
    images = list(rng.normal(0, 0.04, (4, 31, 31)))
    found = texture.entropy(images, 31, stride=15)[1, 1]
    sample = np.cov(np.reshape(images, (4, -1)))
    assert abs(found - 0.5 * np.linalg.slogdet(2 * np.pi * np.e * sample)[1]) < 0.02


def test_a_torus_graph_sees_a_constant_difference_that_the_sine_model_cannot():
    rng = np.random.default_rng(7)
    one = rng.uniform(-np.pi, np.pi, (31, 31))
    other = one + rng.vonmises(0, 4.0, one.shape)
    sine, graph = (texture.entropy([one, other], 31, joint=m)[15, 15] for m in MODELS)
    true = np.log(2 * np.pi) + oracle.von_mises(4.0)
    assert abs(graph - true) < 0.1
    assert sine > true + 0.3


def test_a_constant_image_has_no_density():
    image = np.random.default_rng(8).vonmises(0, 2, (12, 12))
    assert np.all(np.isneginf(texture.entropy([image, np.zeros_like(image)], 9)[3:9, 3:9]))


def test_cooccurrence_is_the_joint_entropy_with_the_moved_image():
    rng = np.random.default_rng(9)
    image = rng.vonmises(0, 2, (20, 24))
    mask = rng.random(image.shape) < 0.9
    for rows, columns in ((0, 4), (2, -3)):
        moved = np.full(image.shape, np.nan)
        for y, x in np.ndindex(image.shape):
            if 0 <= y + rows < 20 and 0 <= x + columns < 24 and mask[y + rows, x + columns]:
                moved[y, x] = image[y + rows, x + columns]
        expected = texture.entropy([image, moved], 9, mask=mask)
        found = texture.cooccurrence_entropy(image, 9, mask=mask, offset=(rows, columns))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_noise_is_taken_out_of_joint_entropies():
    rng, side = np.random.default_rng(10), 15
    one, other = pairs(rng, (10 * side, 10 * side))
    seen = [x + 0.2 * rng.normal(size=x.shape) for x in (one, other)]
    centre = slice(7, None, side)
    true = texture.entropy([one, other], side)[centre, centre]
    found = texture.entropy(seen, side, std=[np.array(0.2), 0.2])[centre, centre]
    assert abs(np.median(found - true)) < 0.03
    assert np.mean(texture.entropy(seen, side)[centre, centre] - true) > 0.1
    pair = texture.cooccurrence_entropy(seen[0], side, std=0.2)[centre, centre]
    assert abs(np.nanmedian(pair[:, :-1] - texture.cooccurrence_entropy(one, side)[centre, centre][:, :-1])) < 0.03


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"images": []}, ValueError, "empty list"),
        ({"images": [np.ones((5, 5)), np.ones((5, 6))]}, ValueError, "one shape"),
        ({"distribution": [VonMises]}, ValueError, "list of 1 for 2 images"),
        ({"distribution": TruncatedNormal}, TypeError, "joint distributions are of angles"),
        ({"joint": TorusGraph}, TypeError, "joint must be Joint"),
        ({"stride": 0}, ValueError, "stride must be >= 1"),
        ({"size": 2}, ValueError, "size must be"),
    ],
)
def test_mistakes_are_named(change, error, words):
    arguments = {"images": [np.zeros((5, 5)), np.ones((5, 5))], "size": 5} | change
    with pytest.raises(error, match=words):
        texture.entropy(**arguments)
    with pytest.raises(ValueError, match="offset must not be"):
        texture.cooccurrence_entropy(np.zeros((5, 5)), 5, offset=(0, 0))
