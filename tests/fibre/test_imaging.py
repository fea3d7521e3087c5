"""Amplitude and phase of a sample against what it was made of, and against repeated noise."""

import numpy as np
import pytest

from fibre import TransmissionImage, load, save, transmission_image
from polinfer import Measurement
from tests.oracles import jones as oracle

STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)


def test_amplitude_and_phase_of_a_plain_sample():
    gain = np.array([[0.2, 1.0], [0.5j, -0.7]])
    image = transmission_image(Measurement(STATES, gain[..., None, None] * STATES, sigma=1e-9))
    np.testing.assert_allclose(image.amplitude, np.abs(gain), rtol=1e-9)
    np.testing.assert_allclose(image.phase, np.angle(gain), atol=1e-9)


def test_a_diattenuator_transmits_the_mean_of_its_two_powers():
    """Balanced states: the mean of tr(J J^H) / 2; and the phase of a retarder is that of its trace."""
    matrix = oracle.jones(np.array([0.6, 0.3, 1.2, 0.7, 0.2]))
    image = transmission_image(Measurement(STATES, 0.8 * matrix @ STATES, sigma=1e-9))
    assert image.amplitude == pytest.approx(0.8 * np.sqrt(np.trace(matrix @ matrix.conj().T).real / 2))
    assert image.phase == pytest.approx(np.angle(np.trace(matrix)))


def test_the_stated_deviations_are_those_of_repeated_noise():
    generator, sigma, gain = np.random.default_rng(0), 0.05, 0.6 * np.exp(0.4j)
    noise = (generator.standard_normal((4000, 2, 3)) + 1j * generator.standard_normal((4000, 2, 3))) / np.sqrt(2)
    image = transmission_image(Measurement(STATES, gain * STATES + sigma * noise, sigma=sigma))
    # 4000 draws: 1.1 % of the deviation, 4 sigma
    assert image.amplitude.std() == pytest.approx(np.median(image.amplitude_std), rel=0.05)
    assert image.phase.std() == pytest.approx(np.median(image.phase_std), rel=0.05)
    assert abs(image.amplitude.mean() - 0.6) < 4 * image.amplitude.std() / np.sqrt(4000) + sigma**2


def test_what_is_not_known_is_said():
    half_wave = np.diag([1, -1]) + 0j
    image = transmission_image(Measurement(STATES, half_wave @ STATES, sigma=0.01))
    assert image.amplitude == pytest.approx(1, abs=1e-3)
    assert np.isinf(image.phase_std)
    dark = transmission_image(Measurement(STATES, 0 * STATES, sigma=0.01))
    assert dark.amplitude == 0
    assert np.isinf(dark.phase_std)
    masked = transmission_image(Measurement(STATES, np.array([STATES, STATES]), sigma=0.1, mask=[True, False]))
    assert np.isfinite(masked.amplitude).tolist() == [True, False]
    without = transmission_image(Measurement(STATES, STATES))
    assert without.amplitude == pytest.approx(1)
    assert np.isnan(without.amplitude_std)
    with pytest.raises(TypeError, match="measurement"):
        transmission_image(STATES)


def test_states_without_weight_do_not_count():
    response = np.array(0.5 * STATES)
    response[:, 1] = np.nan
    image = transmission_image(Measurement(STATES, response, sigma=1e-9, weight=np.array([1.0, 0.0, 1.0])))
    assert image.amplitude == pytest.approx(0.5)


def test_it_can_be_kept_and_looked_at(tmp_path):
    generator = np.random.default_rng(1)
    gain = generator.uniform(0.2, 1, (5, 6)) * np.exp(1j * generator.uniform(-3, 3, (5, 6)))
    image = transmission_image(Measurement(STATES, gain[..., None, None] * STATES, sigma=0.02))
    back = load(save(image, tmp_path / "image.nc"))
    assert isinstance(back, TransmissionImage)
    np.testing.assert_array_equal(back.phase, image.phase)
    figure = image.plot(pixel_size=4e-6)
    assert [axes.get_title() for axes in figure.axes][:2] == ["amplitude", "phase (°)"]
