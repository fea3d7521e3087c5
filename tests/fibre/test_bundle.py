"""The bundle is lossless, is what its coupled-mode equation says, and shows the camera what Gaussian modes make."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from fibre import Bundle, angular_spectrum
from fibre.bundle import _couplings, _exponential

BUNDLE = Bundle.hexagonal(radius=20e-6, rng=0)


def random_amplitudes(seed, *lead, bundle=BUNDLE):
    generator = np.random.default_rng(seed)
    parts = generator.normal(size=(2, *lead, 2, bundle.cores))
    return parts[0] + 1j * parts[1]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_power_is_lost(seed):
    c = random_amplitudes(seed)
    assert np.linalg.norm(BUNDLE.propagate(c)) == pytest.approx(np.linalg.norm(c), rel=2e-5)


@settings(max_examples=25, deadline=None)
@given(a=st.integers(0, 2**32 - 1), b=st.integers(0, 2**32 - 1))
def test_the_adjoint_is_the_adjoint(a, b):
    x, y = random_amplitudes(a, 3), random_amplitudes(b, 3)
    left, right = np.vdot(y, BUNDLE.propagate(x)), np.vdot(BUNDLE.adjoint(y), x)
    assert abs(left - right) < 1e-12 * np.linalg.norm(x) * np.linalg.norm(y)


@pytest.mark.parametrize(("detuning", "coupling"), [(8.0, 0.25), (0.0, 1.5), (40.0, 0.1)])
def test_the_transfer_is_the_exponential_of_the_dense_coupling_matrix(detuning, coupling):
    centres = Bundle.hexagonal(radius=13e-6, rng=0).centres
    k = _couplings(centres, 4.5e-6, detuning, 2.0, coupling, np.random.default_rng(3))
    dense = k.toarray()
    np.testing.assert_allclose(dense, dense.conj().T)
    expected = scipy.linalg.expm(1j * dense)
    assert np.linalg.norm(_exponential(1j * k).toarray() - expected, 2) < 1e-4


def test_two_cores_exchange_their_light_as_the_coupled_mode_formula_says():
    strength, length = 0.7, 1.0
    k = scipy.sparse.csr_array(np.array([[0, strength], [strength, 0]]))
    found = _exponential(1j * length * k).toarray()
    expected = [[np.cos(strength), 1j * np.sin(strength)], [1j * np.sin(strength), np.cos(strength)]]
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_coupling_is_local_and_touches_only_neighbours():
    row, column = np.nonzero(BUNDLE.transfer.toarray())
    near = np.hypot(*(BUNDLE.centres[row % BUNDLE.cores] - BUNDLE.centres[column % BUNDLE.cores]).T)
    strength = np.abs(BUNDLE.transfer.toarray()[row, column])
    assert strength[near > 20e-6].max() < 0.02 < strength[near < 1e-9].mean()
    bare = Bundle.hexagonal(radius=20e-6, coupling=0.0, rng=0).transfer.toarray()
    apart = (np.arange(len(bare))[:, None] - np.arange(len(bare))) % (len(bare) // 2) != 0
    assert np.all(bare[apart] == 0)


def test_the_lattice_has_the_pitch_and_extent_that_were_asked_for():
    bundle = Bundle.hexagonal(radius=30e-6, pitch=4.5e-6, jitter=0.0, rng=1)
    distance = np.hypot(*(bundle.centres[:, None] - bundle.centres).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_allclose(distance.min(1), 4.5e-6, rtol=1e-9)
    assert np.hypot(*bundle.centres.T).max() <= 30e-6
    assert bundle.cores == pytest.approx(np.pi * 30**2 / (4.5**2 * np.sqrt(3) / 2), rel=0.05)
    middle = np.argmin(np.hypot(*bundle.centres.T))
    assert np.count_nonzero(distance[middle] < 4.6e-6) == 6


def test_the_same_seed_is_the_same_bundle():
    again, other = Bundle.hexagonal(radius=20e-6, rng=0), Bundle.hexagonal(radius=20e-6, rng=1)
    np.testing.assert_array_equal(again.transfer.toarray(), BUNDLE.transfer.toarray())
    np.testing.assert_array_equal(again.centres, BUNDLE.centres)
    assert not np.array_equal(other.centres, BUNDLE.centres)


def test_launching_is_the_overlap_integral_of_spot_and_mode():
    step, waist = 0.1e-6, 2.5e-6
    point = BUNDLE.centres[40] + [1.1e-6, -0.7e-6]
    axis = np.arange(-25e-6, 25e-6, step)
    y, x = np.meshgrid(axis, axis, indexing="ij")

    def mode(centre, w):
        return np.sqrt(2 / np.pi) / w * np.exp(-((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / w**2)

    found = BUNDLE.launch(point[None], waist).toarray()[:, 0]
    spot = mode(point, waist)
    for core in (40, np.argmin(np.abs(found - 0.1)), np.argmin(np.abs(found - 1e-3))):
        expected = np.sum(spot * mode(BUNDLE.centres[core], BUNDLE.mode_radius[core])) * step**2
        assert found[core] == pytest.approx(expected, rel=1e-6, abs=1e-9)
    own = BUNDLE.launch(BUNDLE.centres[:1], float(BUNDLE.mode_radius[0])).toarray()
    assert own[0, 0] == pytest.approx(1)  # a spot that is the mode goes in whole


def test_a_spot_beside_the_bundle_launches_nothing():
    assert BUNDLE.launch(np.array([[1e-3, 0]]), 2e-6).nnz == 0
    assert BUNDLE.launch(np.zeros((0, 2)), 2e-6).shape == (BUNDLE.cores, 0)


def test_one_lit_core_shows_its_power_at_its_place():
    c = np.zeros((2, BUNDLE.cores), complex)
    c[0, 17], c[1, 60] = 0.8 - 0.3j, 2j
    pixel = 0.4e-6
    image = BUNDLE.image(c, (150, 160), pixel)
    power = np.sum(np.abs(image) ** 2, axis=(1, 2)) * pixel**2
    np.testing.assert_allclose(power, np.sum(np.abs(c) ** 2, 1), rtol=1e-5)
    for p, core in ((0, 17), (1, 60)):
        y, x = np.unravel_index(np.argmax(np.abs(image[p])), image[p].shape)
        place = (np.array([y, x]) - [74.5, 79.5]) * pixel
        assert np.abs(place - BUNDLE.centres[core]).max() < pixel


@pytest.mark.parametrize("oversampling", [1, 2])
def test_a_defocused_image_is_the_propagated_focus_image(oversampling):
    shape, pixel, distances = (64, 64), 0.7e-6, np.array([-3e-5, 0.0, 5e-5])
    c = random_amplitudes(1)
    step = pixel / oversampling
    wide = BUNDLE.image(c, (128, 128), pixel, oversampling=oversampling)
    found = BUNDLE.image(c, shape, pixel, distances, oversampling=oversampling, padding=2)
    assert found.shape == (3, 2, 64 * oversampling, 64 * oversampling)
    crop = slice(32 * oversampling, 96 * oversampling)
    for z, distance in enumerate(distances):
        expected = angular_spectrum(wide, distance, BUNDLE.wavelength, step)[:, crop, crop]
        assert np.linalg.norm(found[z] - expected) < 1e-5 * np.linalg.norm(expected)


def test_the_image_is_linear_and_batches_are_single_images():
    c = random_amplitudes(2, 3)
    image = BUNDLE.image(c, (40, 44), 0.9e-6, [0.0, 2e-5])
    assert image.shape == (3, 2, 2, 40, 44)
    for b in range(3):
        np.testing.assert_array_equal(image[b], BUNDLE.image(c[b], (40, 44), 0.9e-6, [0.0, 2e-5]))
    combined = BUNDLE.image(c[0] - 2j * c[1], (40, 44), 0.9e-6, [0.0, 2e-5])
    np.testing.assert_allclose(combined, image[0] - 2j * image[1], atol=1e-5 * np.abs(combined).max())


M = BUNDLE.cores


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: Bundle.hexagonal(radius=1e-6), "radius must be at least one pitch"),
        (lambda: Bundle.hexagonal(radius=-1.0), "radius must be > 0"),
        (lambda: Bundle.hexagonal(pitch=0.0), "pitch must be > 0"),
        (lambda: Bundle.hexagonal(jitter=-1e-7), "jitter must be >= 0"),
        (lambda: BUNDLE.propagate(np.ones(M)), "amplitudes must have shape"),
        (lambda: BUNDLE.propagate(np.ones((2, M + 1))), "amplitudes must have shape"),
        (lambda: BUNDLE.launch(np.zeros((3, 3)), 1e-6), "points must have shape"),
        (lambda: BUNDLE.launch(np.zeros((3, 2)), 0.0), "waist must be > 0"),
        (lambda: BUNDLE.image(np.ones((2, M)), (8, 8), -1.0), "pixel_size must be > 0"),
        (lambda: BUNDLE.image(np.ones((2, M)), (8, 8), 1e-6, oversampling=0), "oversampling must be >= 1"),
        (lambda: Bundle(np.zeros((3, 2)), np.ones(3), np.eye(6)), "transfer must be a sparse matrix"),
        (lambda: Bundle(np.zeros((3, 2)), np.ones(2), scipy.sparse.eye_array(6)), "mode_radius must have shape"),
        (lambda: Bundle(np.full((3, 2), np.nan), np.ones(3), scipy.sparse.eye_array(6)), "centres must be finite"),
    ],
)
def test_wrong_arguments_are_named(call, text):
    with pytest.raises(ValueError, match=text):
        call()
