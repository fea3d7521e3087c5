"""Fibrelets are found where they are, and fields are expressed in their modes with a true variance."""

import os

import numpy as np
import pytest
import scipy.ndimage
import scipy.spatial
import skimage.io

from fibre import Bundle, Fibrelets, find_fibrelets
from fibre.fibrelets import LocalPower, ModeBasis, locate_fibrelets, mode_matrix
from polinfer import datasets

PIXEL, SHAPE = 0.5e-6, (140, 150)


@pytest.fixture(scope="module")
def bundle():
    return Bundle.hexagonal(radius=30e-6, rng=2)


@pytest.fixture(scope="module")
def image(bundle):
    """An incoherent sum of many random fields, with photon noise: 500 photo-electrons at a typical peak."""
    generator = np.random.default_rng(0)
    parts = generator.normal(size=(2, 30, 2, bundle.cores))
    total = (np.abs(bundle.image(parts[0] + 1j * parts[1], SHAPE, PIXEL)) ** 2).sum((0, 1)).astype(float)
    return generator.poisson(total * 500 / np.quantile(total, 0.95)).astype(float)


def pixels(bundle):
    return bundle.centres / PIXEL + (np.array(SHAPE) - 1) / 2


def test_every_fibrelet_is_found_once_and_nothing_else(bundle, image):
    found = find_fibrelets(image)
    distance, _ = scipy.spatial.cKDTree(found).query(pixels(bundle))
    assert np.mean(distance < 1.5) >= 0.99  # recall
    distance, nearest = scipy.spatial.cKDTree(pixels(bundle)).query(found)
    assert np.mean(distance < 1.5) >= 0.99  # precision
    assert len(np.unique(nearest)) == len(nearest)
    assert np.sqrt(np.mean(distance[distance < 1.5] ** 2)) < 0.2


@pytest.mark.parametrize("width", [70, 110, 200])
def test_a_wide_dark_margin_adds_no_fibrelets(width):
    bundle, pixel = Bundle.hexagonal(radius=20e-6, rng=2), 0.72e-6
    generator = np.random.default_rng(0)
    parts = generator.normal(size=(2, 30, 2, bundle.cores))
    total = (np.abs(bundle.image(parts[0] + 1j * parts[1], (width, width), pixel)) ** 2).sum((0, 1)).astype(float)
    noisy = generator.poisson(total * 500 / total.max()) + 3 * generator.normal(size=total.shape)
    found = find_fibrelets(noisy)
    distance, _ = scipy.spatial.cKDTree(bundle.centres / pixel + (width - 1) / 2).query(found)
    assert len(found) == bundle.cores
    assert distance.max() < 1


def facet(pitch, size, generator, shade=0.0, photons=300, jitter=0.08):
    """Centres (m, 2) of a turned, jittered hexagonal lattice in a disc, and its noisy image (size, size).

    Fibrelets of unlike brightness and width, on a pedestal of light in the cladding, which fades across the facet by
    ``shade`` as they do. ``photons`` at a typical peak.
    """
    reach = int(size / pitch) + 4
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    lattice = np.stack([row * np.sqrt(3) / 2, column + 0.5 * (row % 2)], -1).reshape(-1, 2) * pitch
    angle = generator.uniform(0, np.pi / 3)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centres = lattice @ turn + generator.uniform(-0.5, 0.5, 2)
    centres += jitter * pitch * generator.uniform(-1, 1, centres.shape)
    radius = 0.42 * size
    centres = centres[np.hypot(*centres.T) < radius]

    def fading(rows):
        return 1 - shade * (rows / radius + 1) / 2

    height = generator.uniform(0.4, 1.3, len(centres)) * fading(centres[:, 0])
    width = 0.3 * pitch * generator.uniform(0.9, 1.1, len(centres))
    middle = (size - 1) / 2
    y, x = np.mgrid[:size, :size]
    image = 0.1 * (np.hypot(y - middle, x - middle) < radius) * fading(y - middle)
    offset = np.arange(-int(2 * pitch), int(2 * pitch) + 1)
    centres = centres + middle
    for centre, h, w in zip(centres, height, width, strict=True):
        at = np.rint(centre).astype(int)[:, None] + offset
        down, across = np.exp(-(((at - centre[:, None]) / w) ** 2))
        image[np.ix_(*at)] += h * np.outer(down, across)
    return centres, generator.poisson(photons * image + 5) + 2 * generator.normal(size=image.shape)


@pytest.mark.parametrize("shade", [0.0, 0.8])
@pytest.mark.parametrize("pitch", [4.5, 9])
def test_precision_and_recall_within_half_a_pitch_are_at_least_99_percent(pitch, shade):
    centres, image = facet(pitch, 300 if pitch < 6 else 500, np.random.default_rng(int(10 * pitch)), shade)
    found = find_fibrelets(image)
    distance, nearest = scipy.spatial.cKDTree(centres).query(found)
    right = len(np.unique(nearest[distance < pitch / 2]))  # one that is found twice counts once
    assert right / len(found) >= 0.99
    assert right / len(centres) >= 0.99


def test_noise_alone_around_a_small_facet_is_not_a_fibrelet():
    centres, image = facet(6, 200, np.random.default_rng(7), photons=60)
    generator = np.random.default_rng(8)
    wide = generator.poisson(np.full((700, 700), 5)) + 2 * generator.normal(size=(700, 700))
    wide[250:450, 250:450] = image
    found = find_fibrelets(wide)
    distance, _ = scipy.spatial.cKDTree(centres + 250).query(found)
    assert np.mean(distance < 3) > 0.995


def test_a_facet_that_fills_the_frame_has_no_dark_margin_to_know_the_noise_from():
    centres, image = facet(6, 400, np.random.default_rng(9))
    found = find_fibrelets(image[120:280, 120:280])
    inside = centres[np.all((centres > 124) & (centres < 275), axis=1)] - 120
    distance, _ = scipy.spatial.cKDTree(found).query(inside)
    assert np.mean(distance < 3) >= 0.99
    distance, _ = scipy.spatial.cKDTree(centres - 120).query(found)
    assert np.mean(distance < 3) >= 0.99


@pytest.fixture(scope="module")
def measured():
    """A measured facet, evenly lit; skipped where the data are not."""
    try:
        path = datasets.data_directory() / "fibre_bundle_images" / "usaf1_background.tif"
        if not path.is_file():
            raise FileNotFoundError(f"directory has no {path.name}; expected it at {path}.")
    except FileNotFoundError as error:
        if os.environ.get("POLINFER_REQUIRE_DATA") == "1":
            pytest.fail(f"POLINFER_REQUIRE_DATA=1, but {error}")
        pytest.skip(f"measured data are not here: {error}")
    return skimage.io.imread(path).astype(float)


def test_the_fibrelets_of_a_measured_facet_are_counted_and_evenly_spaced(measured):
    found = find_fibrelets(measured)
    assert len(found) == pytest.approx(27838, rel=0.01)  # what PyFibreBundle finds
    tree = scipy.spatial.cKDTree(found)
    nearest = tree.query(found, 2)[0][:, 1]
    assert np.median(nearest) == pytest.approx(4.9, abs=0.1)
    assert np.mean(np.abs(nearest / np.median(nearest) - 1) < 0.15) > 0.99
    # no holes and no doubles: triangles between neighbours have one size, up to dirt on the facet
    corners = found[scipy.spatial.Delaunay(found).simplices]
    a, b, c = (np.linalg.norm(corners[:, i] - corners[:, i - 1], axis=1) for i in range(3))
    s = (a + b + c) / 2
    circumradius = a * b * c / (4 * np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 1e-9)))
    middle = found.mean(0)
    within = np.linalg.norm(corners.mean(1) - middle, axis=1) < np.linalg.norm(found - middle, axis=1).max() - 8
    assert np.sum(circumradius[within] > 1.5 * np.median(circumradius)) < 10


def test_centres_in_a_measured_facet_are_where_the_light_is(measured):
    """Brighter than the ring of pixels half a pitch around, without any of the function's own smoothing."""
    found = find_fibrelets(measured)
    y, x = np.mgrid[-3:4, -3:4]
    ring = (np.hypot(y, x) > 2) & (np.hypot(y, x) < 3)
    around = scipy.ndimage.convolve(measured, ring / ring.sum())
    places = tuple(np.rint(found).astype(int).T)
    assert np.mean(measured[places] > 1.2 * around[places]) > 0.995


def test_centres_of_separate_spots_are_sub_pixel_for_any_offset():
    y, x = np.mgrid[:90, :90]
    generator = np.random.default_rng(1)
    centres = np.array([(10 + 9 * r, 10 + 10 * c + 5 * (r % 2)) for r in range(8) for c in range(7)], float)
    centres += generator.uniform(-0.5, 0.5, centres.shape)
    image = sum(np.exp(-((y - r) ** 2 + (x - c) ** 2) / 6) for r, c in centres)
    found = find_fibrelets(image)
    assert len(found) == len(centres)
    distance, _ = scipy.spatial.cKDTree(centres).query(found)
    assert distance.max() < 0.05


def test_the_mode_radius_and_the_positions_in_metres_are_the_bundles(bundle, image):
    found = locate_fibrelets(image, PIXEL)
    assert found.mode_radius.mean() == pytest.approx(bundle.mode_radius.mean(), rel=0.02)
    distance, _ = scipy.spatial.cKDTree(bundle.centres).query(found.centres)
    assert np.median(distance) < 0.1e-6


def test_every_fibrelet_has_its_own_radius_and_a_faint_one_keeps_the_common():
    bundle = Bundle.hexagonal(radius=30e-6, mode_spread=0.04, rng=5)
    generator = np.random.default_rng(6)
    power = generator.uniform(0.5, 1.5, bundle.cores)
    power[:3] = 1e-5
    image = np.zeros((130, 130))
    for core in range(bundle.cores):  # an incoherent sum: one core lit at a time
        one = np.zeros((2, bundle.cores))
        one[0, core] = np.sqrt(power[core])
        image += np.abs(bundle.image(one, image.shape, PIXEL)[0]) ** 2
    image = generator.poisson(2e4 * image / image.max()) / 2e4
    found = locate_fibrelets(image, PIXEL)
    distance, core = scipy.spatial.cKDTree(bundle.centres).query(found.centres)
    ratio = found.mode_radius / bundle.mode_radius[core]
    bright = power[core] > 0.1
    assert distance.max() < 0.3e-6
    assert np.std(ratio[bright]) < 0.01 < 0.03 < np.std(bundle.mode_radius / bundle.mode_radius.mean())
    assert abs(ratio[bright].mean() - 1) < 0.005
    faint = found.mode_radius[~bright] / np.median(found.mode_radius)
    assert np.all(np.abs(faint - 1) < 0.05)


def test_a_dark_or_flat_image_shows_no_lattice():
    with pytest.raises(ValueError, match="image shows no lattice"):
        find_fibrelets(np.ones((64, 64)))
    with pytest.raises(ValueError, match="image must have shape"):
        find_fibrelets(np.ones(64))
    with pytest.raises(ValueError, match="image must be finite"):
        find_fibrelets(np.full((64, 64), np.inf))


def test_modes_have_unit_power_and_overlap_as_gaussians_do(bundle):
    w = 1.6e-6
    modes = mode_matrix(Fibrelets(bundle.centres, w), SHAPE, PIXEL)
    gram = (modes.T @ modes).toarray()
    np.testing.assert_allclose(gram.diagonal(), 1, rtol=1e-5)
    distance2 = ((bundle.centres[:, None] - bundle.centres) ** 2).sum(-1)
    np.testing.assert_allclose(gram, np.exp(-distance2 / (2 * w**2)), atol=2e-4)


def test_modes_are_those_of_the_bundles_image(bundle):
    same = Bundle(bundle.centres, np.full(bundle.cores, 1.6e-6), bundle.coupling)
    c = np.random.default_rng(1).normal(size=(2, bundle.cores)) + 0j
    seen = same.image(c, SHAPE, PIXEL)[1] * PIXEL
    made = (mode_matrix(Fibrelets(same.centres, 1.6e-6), SHAPE, PIXEL) @ c[1]).reshape(SHAPE)
    assert np.linalg.norm(seen - made) < 1e-3 * np.linalg.norm(made)


def small():
    centres = np.array([[0, 0], [4.4, 0.3], [0.2, 4.6], [-4.1, 2.2], [2.3, -4.5]]) * 1e-6
    return mode_matrix(Fibrelets(centres, 1.6e-6), (30, 32), PIXEL)


def test_the_power_around_a_mode_is_the_mean_of_its_own_and_its_neighbours(bundle):
    frame, pixel, w = (150, 150), 0.5e-6, 1.6e-6
    centres = np.stack([np.zeros(7), (np.arange(7) - 3) * 9e-6], 1)  # a row, too far apart to overlap
    modes = mode_matrix(Fibrelets(centres, w), frame, pixel)
    power = np.array([0, 0, 1e4, 0, 0, 0, 0.0])
    squares = modes.T.tocsr().power(2)
    noise = np.random.default_rng(0).standard_normal(frame)
    found = LocalPower(squares, centres)((squares.T @ power).reshape(frame) + noise, np.ones(frame), 1e6)
    # two standard errors of a mean of two or three modes' powers, and the mean's own noise
    error = 1 / np.sqrt(squares.power(2).sum(1)) / np.sqrt([2, 3, 3, 3, 3, 3, 2])
    np.testing.assert_allclose(found[1:4], [1e4 / 3] * 3, rtol=0.02)
    assert np.all(found[[0, 4, 5, 6]] >= 2 * error[[0, 4, 5, 6]] * (1 - 1e-6))
    assert np.all(found[[0, 4, 5, 6]] < 5 * error[[0, 4, 5, 6]])
    nothing = LocalPower(squares, centres)(np.full(frame, np.nan), np.zeros(frame), 123.0)
    np.testing.assert_array_equal(nothing, 123.0)


def test_amplitudes_are_dense_weighted_least_squares():
    modes, generator = small(), np.random.default_rng(3)
    field = generator.normal(size=(30, 32)) + 1j * generator.normal(size=(30, 32))
    variance = generator.uniform(0.5, 2, (30, 32))
    variance[10:14, 12:20] = np.inf
    field[11, 13] = np.nan  # where it says nothing it may be anything
    prior = 3.0
    found, stated = ModeBasis(modes).amplitudes(field, variance, prior)
    g = modes.toarray()
    usable = np.isfinite(variance.ravel())
    weight = 1 / variance.ravel()[usable]
    rows = np.vstack([g[usable] * np.sqrt(weight)[:, None], np.eye(5) / np.sqrt(prior)])
    right = np.concatenate([field.ravel()[usable] * np.sqrt(weight), np.zeros(5)])
    np.testing.assert_allclose(found, np.linalg.lstsq(rows + 0j, right, rcond=None)[0], rtol=1e-9)
    np.testing.assert_allclose(stated, np.diag(np.linalg.inv(rows.T @ rows)), rtol=0.01)
    # one variance for the whole frame takes another way
    alike, _ = ModeBasis(modes).amplitudes(np.nan_to_num(field), np.full((30, 32), 0.7), prior)
    expected = np.linalg.solve(g.T @ g / 0.7 + np.eye(5) / prior, g.T @ np.nan_to_num(field).ravel() / 0.7)
    np.testing.assert_allclose(alike, expected, rtol=1e-9)


def test_the_stated_variance_is_the_mean_squared_error():
    modes, generator = small(), np.random.default_rng(4)
    basis = ModeBasis(modes)
    truth = generator.normal(size=5) + 1j * generator.normal(size=5)
    clean = (modes @ truth).reshape(30, 32)
    variance = generator.uniform(0.01, 0.05, (30, 32))
    errors = []
    for _ in range(600):
        noise = generator.normal(size=(2, 30, 32)) * np.sqrt(variance / 2)
        found, stated = basis.amplitudes(clean + noise[0] + 1j * noise[1], variance, 1e6)
        errors.append(np.abs(found - truth) ** 2 / stated)
    # exponential variables: standard deviation 1 each
    assert np.mean(errors) == pytest.approx(1, abs=4 / np.sqrt(600 * 5) + 0.01)
    assert np.std(errors) == pytest.approx(1, rel=0.1)


def test_without_light_the_prior_is_all_there_is():
    found, stated = ModeBasis(small()).amplitudes(np.ones((30, 32)), np.full((30, 32), np.inf), 2.5)
    assert np.all(found == 0)
    np.testing.assert_allclose(stated, 2.5)
