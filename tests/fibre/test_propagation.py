"""Free space turns a field, loses nothing that stays in the frame, and follows the textbook beam."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fibre import angular_spectrum
from fibre.propagation import transfer_function

WAVELENGTH, PIXEL = 850e-9, 0.7e-6


def coordinates(n):
    return np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * PIXEL] * 2, indexing="ij")


def gaussian(n, waist):
    y, x = coordinates(n)
    return np.sqrt(2 / np.pi) / waist * np.exp(-(x**2 + y**2) / waist**2)


@settings(max_examples=20, deadline=None)
@given(z=st.floats(-1e-4, 1e-4), seed=st.integers(0, 2**32 - 1))
def test_there_and_back_returns_any_field_of_low_aperture(z, seed):
    generator = np.random.default_rng(seed)
    spectrum = np.zeros((48, 48), complex)
    spectrum[:5, :5] = generator.normal(size=(5, 5)) + 1j * generator.normal(size=(5, 5))  # far below the band limit
    field = np.fft.ifft2(spectrum)
    back = angular_spectrum(angular_spectrum(field, z, WAVELENGTH, PIXEL), -z, WAVELENGTH, PIXEL)
    np.testing.assert_allclose(back, field, atol=1e-12 * np.abs(field).max())


def test_two_steps_are_one_long_step():
    field = gaussian(64, 4e-6)
    twice = angular_spectrum(angular_spectrum(field, 3e-5, WAVELENGTH, PIXEL), 4e-5, WAVELENGTH, PIXEL)
    np.testing.assert_allclose(twice, angular_spectrum(field, 7e-5, WAVELENGTH, PIXEL), atol=1e-6 * np.abs(field).max())


def test_the_transfer_is_one_or_zero_in_modulus_and_zero_for_evanescent_waves():
    h = transfer_function((32, 40), [0.0, 3e-5, 4e-4], WAVELENGTH, 0.3e-6)
    modulus = np.abs(h)
    assert np.all((np.abs(modulus - 1) < 1e-12) | (modulus == 0))
    fy, fx = np.fft.fftfreq(32, 0.3e-6), np.fft.fftfreq(40, 0.3e-6)
    evanescent = fy[:, None] ** 2 + fx**2 >= 1 / WAVELENGTH**2
    assert evanescent.any()
    assert np.all(h[:, evanescent] == 0)
    assert np.all(h[0, ~evanescent] == 1)
    assert np.count_nonzero(h[2]) < np.count_nonzero(h[1]) < np.count_nonzero(~evanescent)  # the band limit narrows


def test_one_plane_wave_gets_the_phase_of_its_axial_wavenumber():
    row, column, z = 3, -5, 4e-5
    n = 64
    y, x = np.mgrid[:n, :n]
    wave = np.exp(2j * np.pi * (row * y + column * x) / n)
    k = 2 * np.pi / WAVELENGTH
    transverse = 2 * np.pi * np.hypot(row, column) / (n * PIXEL)
    expected = wave * np.exp(1j * z * (np.sqrt(k**2 - transverse**2) - k))
    np.testing.assert_allclose(angular_spectrum(wave, z, WAVELENGTH, PIXEL), expected, atol=1e-10)


@pytest.mark.parametrize("z", [-2.5e-4, 1e-4, 2.5e-4])
def test_a_gaussian_beam_of_small_aperture_follows_its_q_parameter(z):
    waist, n = 8e-6, 160
    y, x = coordinates(n)
    rayleigh = np.pi * waist**2 / WAVELENGTH
    q = z - 1j * rayleigh  # for exp(i(kz - wt))
    paraxial = np.sqrt(2 / np.pi) / waist * (-1j * rayleigh) / q
    paraxial = paraxial * np.exp(1j * np.pi * (x**2 + y**2) / (WAVELENGTH * q))
    found = angular_spectrum(gaussian(n, waist), z, WAVELENGTH, PIXEL)
    assert np.linalg.norm(found - paraxial) / np.linalg.norm(paraxial) < 2e-3
    radius2 = 2 * np.average(x**2 + y**2, weights=np.abs(found) ** 2)  # of a Gaussian: w^2 = 2 <r^2>
    assert np.sqrt(radius2) == pytest.approx(waist * np.sqrt(1 + (z / rayleigh) ** 2), rel=2e-3)


def test_power_inside_the_frame_is_kept():
    field = gaussian(96, 3e-6)
    far = angular_spectrum(field, 6e-5, WAVELENGTH, PIXEL)
    assert np.sum(np.abs(far) ** 2) == pytest.approx(np.sum(np.abs(field) ** 2), rel=1e-6)
    assert np.sum(np.abs(field) ** 2) * PIXEL**2 == pytest.approx(1, rel=1e-6)


def test_light_that_leaves_the_frame_does_not_come_back_at_the_other_side():
    n, z, tilt = 64, 3e-4, 0.2  # moves by 60 um, the frame is 45 um wide
    _, x = coordinates(n)
    field = gaussian(n, 5e-6) * np.exp(2j * np.pi * x * tilt / WAVELENGTH)
    assert np.sum(np.abs(angular_spectrum(field, z, WAVELENGTH, PIXEL)) ** 2) < 0.02 * np.sum(np.abs(field) ** 2)


def test_leading_axes_are_fields_and_precision_is_kept():
    fields = np.random.default_rng(0).normal(size=(2, 3, 16, 20)).astype(np.complex64)
    found = angular_spectrum(fields, 2e-5, WAVELENGTH, PIXEL)
    assert (found.shape, found.dtype) == (fields.shape, np.complex64)
    np.testing.assert_allclose(found[1, 2], angular_spectrum(fields[1, 2], 2e-5, WAVELENGTH, PIXEL), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((np.ones(8), 1e-5, WAVELENGTH, PIXEL), "field must have shape"),
        ((np.ones((8, 8)), np.nan, WAVELENGTH, PIXEL), "distance must be finite"),
        ((np.ones((8, 8)), 1e-5, -1.0, PIXEL), "wavelength must be > 0"),
        ((np.ones((8, 8)), 1e-5, WAVELENGTH, 0.0), "pixel_size must be > 0"),
    ],
)
def test_wrong_arguments_are_named(arguments, text):
    with pytest.raises(ValueError, match=text):
        angular_spectrum(*arguments)
