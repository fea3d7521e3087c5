"""The bundle is lossless, is what its coupled-mode equation says, and shows the camera what Gaussian modes make."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from fibre import Bundle, Frame, Transmission, angular_spectrum, load, save
from fibre.evolution import Evolution

BUNDLE = Bundle.hexagonal(radius=20e-6, rng=0)


def random_amplitudes(seed, *lead, bundle=BUNDLE):
    generator = np.random.default_rng(seed)
    parts = generator.normal(size=(2, *lead, 2, bundle.cores))
    return parts[0] + 1j * parts[1]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_power_is_lost(seed):
    c = random_amplitudes(seed)
    assert np.linalg.norm(BUNDLE.transmit(c)) == pytest.approx(np.linalg.norm(c), rel=2e-5)


@settings(max_examples=25, deadline=None)
@given(a=st.integers(0, 2**32 - 1), b=st.integers(0, 2**32 - 1))
def test_the_adjoint_is_the_adjoint(a, b):
    x, y = random_amplitudes(a, 3), random_amplitudes(b, 3)
    left, right = np.vdot(y, BUNDLE.transmit(x)), np.vdot(BUNDLE.transmit_adjoint(y), x)
    assert abs(left - right) < 1e-12 * np.linalg.norm(x) * np.linalg.norm(y)


@pytest.mark.parametrize(("detuning", "coupling"), [(8.0, 0.25), (0.0, 1.5), (40.0, 0.1), (0.0, 0.0)])
def test_the_transfer_is_the_exponential_of_the_dense_coupling_matrix(detuning, coupling):
    bundle = Bundle.hexagonal(radius=13e-6, detuning=detuning, coupling=coupling, rng=0)
    dense = bundle.coupling.toarray()
    np.testing.assert_array_equal(dense, dense.conj().T)
    expected = scipy.linalg.expm(1j * dense)
    assert np.linalg.norm(bundle.transfer.toarray() - expected, 2) < 1e-7  # entries below 1e-9 are left out
    np.testing.assert_allclose(bundle.evolution.apply(np.eye(len(dense))), expected, atol=1e-11)
    np.testing.assert_allclose(bundle.evolution.apply(np.eye(len(dense)), -1), expected.conj().T, atol=1e-11)


def test_a_complex_coupling_evolves_as_its_dense_exponential():
    generator = np.random.default_rng(2)
    parts = generator.normal(size=(2, 12, 12))
    matrix = parts[0] + 1j * parts[1]
    matrix = matrix + matrix.conj().T
    expected = scipy.linalg.expm(1j * matrix)
    evolution = Evolution.of(scipy.sparse.csr_array(matrix))
    np.testing.assert_allclose(evolution.apply(np.eye(12)), expected, atol=1e-10)
    found = evolution.apply_jax(jnp.eye(12, dtype=complex))
    np.testing.assert_allclose(found, expected, atol=1e5 * jnp.finfo(found.dtype).eps)


def test_two_cores_exchange_their_light_as_the_coupled_mode_formula_says():
    strength = 0.7
    found = Evolution.of(scipy.sparse.csr_array(np.array([[0, strength], [strength, 0]]))).apply(np.eye(2))
    expected = [[np.cos(strength), 1j * np.sin(strength)], [1j * np.sin(strength), np.cos(strength)]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_bend_tilts_the_phase_and_heat_stretches_every_path():
    bare = Bundle.hexagonal(radius=20e-6, coupling=0.0, rng=0)
    c = random_amplitudes(0)
    tilt = (2e4, -1e4)
    phase = 0.3 + bare.centres @ tilt
    np.testing.assert_allclose(bare.disturbed(0.3, tilt).transmit(c), bare.transmit(c) * np.exp(1j * phase), atol=1e-10)
    warm = BUNDLE.disturbed(heating=0.01).transmit(c)
    expected = scipy.linalg.expm(1.01j * BUNDLE.coupling.toarray()) @ c.ravel()
    np.testing.assert_allclose(warm.ravel(), expected, atol=1e-10)
    # with coupling a bend is not only a tilt of the phase, but nearly so
    bent = BUNDLE.disturbed(0.3, tilt).transmit(c)
    turned = BUNDLE.transmit(c) * np.exp(1j * phase)
    away = np.linalg.norm(bent - turned) / np.linalg.norm(bent)
    assert 1e-4 < away < 0.1


SAMPLE, CAMERA = Frame((72, 64), 0.8e-6), Frame((60, 80), 0.7e-6)
TURNED = np.array([[0.998, -0.05, 1.5e-6], [0.05, 1.003, -0.8e-6]])
FAR = Bundle.hexagonal(radius=18e-6, registration=TURNED, rng=4)


def random_fields(seed, frame, kind=complex):
    parts = np.random.default_rng(seed).normal(size=(2, 2, *frame.shape))
    return (parts[0] + 1j * parts[1]).astype(kind)


def dense_modes(centres, radii, frame):
    """Gaussian modes of unit power on the pixels of a frame, (y x, m), by the formula alone."""
    squared = ((frame.points[:, None] - centres) ** 2).sum(-1)
    return np.sqrt(2 / np.pi) / radii * np.exp(-squared / radii**2)


@pytest.mark.parametrize(("distance", "defocus"), [(0.0, 0.0), (15e-6, 0.0), (15e-6, -20e-6)])
def test_fields_pass_as_the_product_of_dense_matrices_says(distance, defocus):
    fields = random_fields(0, SAMPLE)
    facet = angular_spectrum(fields, distance, FAR.wavelength, SAMPLE.pixel_size) if distance else fields
    launched = dense_modes(FAR.distal_centres, FAR.mode_radius, SAMPLE).T @ facet.reshape(2, -1).T
    launched *= SAMPLE.pixel_size**2
    received = (scipy.linalg.expm(1j * FAR.coupling.toarray()) @ launched.T.ravel()).reshape(2, -1)
    seen = (dense_modes(FAR.centres, FAR.mode_radius, CAMERA) @ received.T).T.reshape(2, *CAMERA.shape)
    expected = angular_spectrum(seen, defocus, FAR.wavelength, CAMERA.pixel_size) if defocus else seen
    for kind in (np.complex64, np.complex128):
        found = FAR.propagate(fields.astype(kind), SAMPLE, CAMERA, distance, defocus)
        assert found.dtype == kind
        assert np.linalg.norm(found - expected) < 5e-4 * np.linalg.norm(expected)  # modes end at three radii


@settings(max_examples=10, deadline=None)
@given(a=st.integers(0, 2**32 - 1), b=st.integers(0, 2**32 - 1))
def test_the_adjoint_of_the_whole_path_is_exact(a, b):
    x, y = random_fields(a, SAMPLE), random_fields(b, CAMERA)
    path = (SAMPLE, CAMERA, 15e-6, -20e-6)
    left, right = np.vdot(y, FAR.propagate(x, *path)), np.vdot(FAR.adjoint(y, *path), x)
    assert abs(left - right) < 1e-12 * np.linalg.norm(x) * np.linalg.norm(FAR.adjoint(y, *path))


@pytest.mark.parametrize("distance", [0.0, 12e-6])
def test_the_matrix_of_a_window_is_what_single_pixels_send_to_the_camera(distance):
    """Columns by the Hankel transform of the modes against fields sent through the FFT."""
    window = np.zeros(SAMPLE.shape, bool)
    window[30:34, 28:35] = True
    matrix = FAR.matrix(window, SAMPLE, CAMERA, distance)
    assert matrix.shape == (2 * 60 * 80, 2 * 28)
    fields = np.zeros((2, *SAMPLE.shape), complex)
    fields[:, window] = random_fields(3, Frame((4, 7), 1e-6)).reshape(2, -1)
    expected = FAR.propagate(fields, SAMPLE, CAMERA, distance)
    found = (matrix @ fields[:, window].ravel()).reshape(expected.shape)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


def test_the_function_for_jax_gives_the_same_fields_and_derivatives():
    path = Transmission(FAR, SAMPLE, CAMERA, 15e-6, -20e-6)
    fields, weights = random_fields(1, SAMPLE), random_fields(2, CAMERA)
    expected = path.propagate(fields)
    function = path.function()
    single = function(fields.astype(np.complex64))
    assert single.dtype == np.complex64
    assert np.linalg.norm(single - expected) < 1e-5 * np.linalg.norm(expected)
    tolerance = 1e5 * jnp.finfo(function(fields).dtype).eps
    assert np.linalg.norm(function(fields) - expected) < tolerance * np.linalg.norm(expected)
    slope = jax.grad(lambda f: jnp.sum(jnp.conj(weights) * function(f)).real)(jnp.asarray(fields))
    # JAX's gradient of a real function of z is the conjugate of the steepest direction
    adjoint = path.adjoint(weights)
    assert np.linalg.norm(np.conj(slope) - adjoint) < tolerance * np.linalg.norm(adjoint)


def test_a_bundle_with_two_facets_comes_back_from_its_file(tmp_path):
    again = load(save(FAR, tmp_path / "bundle.nc"))
    np.testing.assert_array_equal(again.distal_centres, FAR.centres @ TURNED[:, :2].T + TURNED[:, 2])
    c = random_amplitudes(5, bundle=FAR)
    np.testing.assert_array_equal(again.transmit(c), FAR.transmit(c))


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


def test_the_image_in_focus_is_the_sum_of_all_modes_everywhere():
    rng = np.random.default_rng(4)
    c = rng.standard_normal((2, M)) + 1j * rng.standard_normal((2, M))
    shape, pixel = (150, 97), 0.4e-6  # several tiles, the last ones narrower, light beyond the frame
    y, x = (((np.arange(n) - (n - 1) / 2) * pixel)[:, None] - BUNDLE.centres[:, i] for i, n in enumerate(shape))
    w = BUNDLE.mode_radius
    dense = np.einsum("yk,xk,pk->pyx", np.exp(-((y / w) ** 2)), np.exp(-((x / w) ** 2)), c * np.sqrt(2 / np.pi) / w)
    np.testing.assert_allclose(BUNDLE.image(c, shape, pixel), dense, atol=1e-6 * np.abs(dense).max())


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
        (lambda: BUNDLE.transmit(np.ones(M)), "amplitudes must have shape"),
        (lambda: BUNDLE.transmit(np.ones((2, M + 1))), "amplitudes must have shape"),
        (lambda: BUNDLE.launch(np.zeros((3, 3)), 1e-6), "points must have shape"),
        (lambda: BUNDLE.launch(np.zeros((3, 2)), 0.0), "waist must be > 0"),
        (lambda: BUNDLE.image(np.ones((2, M)), (8, 8), -1.0), "pixel_size must be > 0"),
        (lambda: BUNDLE.image(np.ones((2, M)), (8, 8), 1e-6, oversampling=0), "oversampling must be >= 1"),
        (lambda: Bundle(np.zeros((3, 2)), np.ones(3), np.eye(6)), "coupling must be a sparse matrix"),
        (lambda: Bundle(np.zeros((1, 2)), np.ones(1), scipy.sparse.csr_array([[0, 1], [2, 0]])), "Hermitian"),
        (lambda: BUNDLE.propagate(np.ones((2, 9, 9)), SAMPLE), "fields must have shape"),
        (lambda: BUNDLE.matrix(np.zeros(SAMPLE.shape, bool), SAMPLE), "at least one True"),
        (lambda: Transmission(BUNDLE, SAMPLE, SAMPLE, defocus=1e-6).matrix(np.ones(SAMPLE.shape, bool)), "defocus"),
        (lambda: BUNDLE.columns(np.eye(3)), "launched must have"),
        (lambda: BUNDLE.disturbed(heating=-2.0), "heating must be > -1"),
        (lambda: Bundle(np.zeros((3, 2)), np.ones(2), scipy.sparse.eye_array(6)), "mode_radius must have shape"),
        (lambda: Bundle(np.full((3, 2), np.nan), np.ones(3), scipy.sparse.eye_array(6)), "centres must be finite"),
    ],
)
def test_wrong_arguments_are_named(call, text):
    with pytest.raises(ValueError, match=text):
        call()


def test_a_frame_must_be_a_frame():
    with pytest.raises(TypeError, match="sample must be Frame"):
        BUNDLE.propagate(np.ones((2, 9, 9)), (9, 9))
