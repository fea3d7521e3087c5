"""Holograms put light where they say; every far field here is a plain Fourier sum."""

import numpy as np
import pytest

from fibre import holograms
from fibre.holograms import Modulator, fresnel_lens, quantise, spot_amplitudes, spot_array, superpose

SLM = Modulator((120, 160), 12e-6, 850e-9, 0.2)


def share(phase, point, light=None):
    """Of one spot's possible power, by the sum over all pixels, written out."""
    rows, columns = np.meshgrid(*SLM.axes(), indexing="ij")
    light = np.ones(SLM.shape) if light is None else light
    wave = np.exp(-2j * np.pi * (point[0] * rows + point[1] * columns) / (SLM.wavelength * SLM.focal_length))
    return abs(np.sum(light * np.exp(1j * phase) * wave)) ** 2 / light.sum() ** 2


def circle(count=12, radius=1.1e-3, turn=0.1):
    angle = 2 * np.pi * np.arange(count) / count + turn
    return radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.23])
def test_twelve_spots_are_even_wherever_they_lie(turn):
    points = circle(turn=turn)
    found = spot_array(SLM, points)
    powers = np.array([share(found.phase, point) for point in points])
    assert 1 - np.ptp(powers) / (powers.max() + powers.min()) >= 0.99
    assert powers.sum() > 0.8
    np.testing.assert_allclose(found.powers, powers, rtol=1e-9)
    assert found.efficiency == pytest.approx(powers.sum())


def test_a_fourier_transform_of_a_padded_frame_sees_the_same_spots():
    points = circle()
    phase = spot_array(SLM, points).phase
    size = 2048
    far = np.abs(np.fft.fft2(np.exp(1j * phase), (size, size))) ** 2 / phase.size**2
    step = SLM.wavelength * SLM.focal_length / (size * SLM.pixel_size)
    near = np.rint(points / step).astype(int)
    assert np.all(far[tuple(near.T % size)] > 0.9 * 0.8 / 12)


def test_spots_have_the_powers_that_were_asked_for():
    points, wanted = circle(5), np.array([1.0, 2.0, 3.0, 1.0, 0.5])
    light = holograms.gaussian(SLM, 6e-4)
    found = spot_array(SLM, points, wanted, light)
    powers = np.array([share(found.phase, point, light) for point in points])
    np.testing.assert_allclose(powers / powers.sum(), wanted / wanted.sum(), rtol=0.02)


def test_the_reference_stays_while_the_array_moves():
    reference, amplitudes = [-2.0e-3, 2.1e-3], []
    for shift in np.linspace(0, 80e-6, 4):
        array = spot_array(SLM, circle() + np.array([shift, 0])).phase
        both = superpose(SLM, array, reference, 0.08)
        amplitudes.append(spot_amplitudes(SLM, np.exp(1j * both), [reference])[0])
        assert share(both, reference) == pytest.approx(0.08, rel=0.01)
        powers = np.array([share(both, point) for point in circle() + np.array([shift, 0])])
        assert powers.sum() > 0.65
        assert np.ptp(powers) < 0.4 * powers.mean()
    assert np.ptp(np.angle(amplitudes)) < 1e-3


def test_a_lens_focuses_at_its_focal_length():
    focus = 0.15
    phase = fresnel_lens(SLM, focus)
    rows, columns = np.meshgrid(*SLM.axes(), indexing="ij")
    squared = rows**2 + columns**2

    def on_axis(distance):  # Fresnel's integral on the axis
        return abs(np.sum(np.exp(1j * phase) * np.exp(1j * np.pi * squared / (SLM.wavelength * distance)))) / phase.size

    assert on_axis(focus) == pytest.approx(1)
    assert max(on_axis(0.6 * focus), on_axis(2 * focus)) < 0.3


@pytest.mark.parametrize("levels", [2, 4, 16])
def test_grey_levels_cost_what_the_formula_says(levels):
    rows, _ = np.meshgrid(*SLM.axes(), indexing="ij")
    period = 16 * SLM.pixel_size  # whole pixels in every level
    ramp = 2 * np.pi * (rows - SLM.axes()[0][0]) / period
    shown = quantise(ramp - np.pi / levels + np.pi / 16, levels)  # no phase lies between two levels
    point = [SLM.wavelength * SLM.focal_length / period, 0.0]
    # a sampled ramp of 16 pixels a period, summed pixel by pixel: 16 levels are all that it has
    sampled = np.sinc(1 / levels) ** 2 / np.sinc(1 / 16) ** 2
    assert share(shown, point) == pytest.approx(sampled, rel=0.02)


def test_phases_are_shown_by_the_nearest_level():
    phase = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    whole = quantise(phase, 8)
    assert len(np.unique(whole)) == 8
    assert np.abs(np.angle(np.exp(1j * (whole - phase)))).max() <= np.pi / 8 + 1e-12
    short = quantise(phase, 8, np.pi)
    near = np.abs(np.angle(np.exp(1j * (np.arange(8) * np.pi / 8 - phase[:, None])))).min(1)
    np.testing.assert_allclose(np.abs(np.angle(np.exp(1j * (short - phase)))), near, atol=1e-12)


def test_a_logo_is_centred_and_as_tall_as_asked():
    points = holograms.logo(SLM, "PI", height=2e-3, spacing=2e-4)
    assert np.ptp(points[:, 0]) == pytest.approx(2e-3, abs=4.1e-4)
    assert np.abs(points.max(0) + points.min(0)).max() < 4e-4
    assert len(points) > 10


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: spot_array(SLM, [[0.0, 1.0]]), "points must be at least one, and within"),
        (lambda: spot_array(SLM, circle(), np.zeros(12)), "powers"),
        (lambda: spot_array(SLM, circle(), illumination=np.zeros(SLM.shape)), "illumination is dark"),
        (lambda: fresnel_lens(SLM, 1e-3), "focal_length must be at least"),
        (lambda: superpose(SLM, np.zeros(SLM.shape), [0.0, 1e-3], 1.5), "share"),
        (lambda: quantise([0.0], 1), "levels"),
        (lambda: holograms.logo(SLM, " ", 1e-3, 1e-4), "text must have letters"),
        (lambda: holograms.aperture(SLM, -1.0), "radius"),
    ],
)
def test_bad_input_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_letters_have_their_holes():
    modulator = holograms.Modulator((512, 512), 12e-6, 850e-9, 0.2)
    points = holograms.logo(modulator, "O", height=2e-3, spacing=5e-5)
    assert len(points) > 100
    assert np.hypot(*points.T).min() > 3e-4
