"""Photon transfer against cameras of known gain, read noise and dark current."""

import numpy as np
import pytest

from acquisition import InverseVariance, photon_transfer

TIMES = np.array([0.01, 0.05, 0.1, 0.2, 0.4])


def frames(generator, rate, gain, read, dark, offset=12.0, bits=12, times=TIMES, side=40, uneven=0.1):
    """Pairs of frames of an uneven lamp: (n, 2, side, side)."""
    lamp = rate * (1 + uneven * np.linspace(-1, 1, side))
    electrons = generator.poisson(
        np.broadcast_to((lamp + dark) * times[:, None, None, None], (len(times), 2, side, side))
    )
    counts = (electrons + read * generator.standard_normal(electrons.shape)) / gain + offset
    return np.clip(np.rint(counts), 0, 2**bits - 1).astype(np.uint16)


@pytest.mark.parametrize(("gain", "read", "dark"), [(2.0, 6.0, 30.0), (8.0, 20.0, 0.0), (0.5, 2.0, 300.0)])
def test_gain_read_noise_and_dark_current_are_found_within_their_stated_errors(gain, read, dark):
    """Twenty cameras: the mean of the normalised errors is 0 and their size 1, within four of their own errors."""
    found = []
    for seed in range(20):
        g = np.random.default_rng(seed)
        flats, darks = frames(g, 4000 * gain, gain, read, dark), frames(g, 0.0, gain, read, dark)
        one = photon_transfer(flats, TIMES, darks, TIMES, 4095)
        found.append([(one.gain - gain) / one.gain_std, (one.read_noise - read) / one.read_noise_std,
                      (one.dark - dark) / one.dark_std])  # fmt: skip
        assert one.gain == pytest.approx(gain, rel=0.1)
        assert one.offset == pytest.approx(12.0, abs=0.5)
    found = np.array(found)
    assert np.all(np.abs(found.mean(0)) < 4 / np.sqrt(20))
    assert np.all((found**2).mean(0) < 1 + 4 * np.sqrt(2 / 20))
    assert np.all((found**2).mean(0) > 0.2)


def test_saturated_flats_do_not_count():
    g = np.random.default_rng(0)
    times = np.array([0.05, 0.1, 0.2, 2.0])
    flats = frames(g, 8000, 2.0, 6.0, 0.0, times=times)
    assert flats[-1].max() == 4095
    found = photon_transfer(flats, times, frames(g, 0.0, 2.0, 6.0, 0.0), TIMES, 4095)
    assert found.gain == pytest.approx(2.0, abs=4 * found.gain_std)
    assert isinstance(found.rule(), InverseVariance)
    assert found.rule().gain == found.gain


@pytest.mark.parametrize(("change", "error", "text"), [
    ({"flats": np.zeros((3, 2, 4, 4))}, TypeError, "flats must be raw integer"),
    ({"flats": np.zeros((3, 3, 4, 4), int)}, ValueError, "flats must have shape"),
    ({"darks": np.zeros((1, 2, 4, 4), int)}, ValueError, "darks must have shape"),
    ({"exposures": [1.0, 2.0]}, ValueError, "exposures"),
    ({"dark_exposures": [1.0, 1.0, 1.0]}, ValueError, "dark_exposures must differ"),
    ({"flats": np.full((3, 2, 4, 4), 255)}, ValueError, "not saturated"),
])  # fmt: skip
def test_wrong_arguments_are_named(change, error, text):
    good = {"flats": np.arange(96).reshape(3, 2, 4, 4), "exposures": [1.0, 2.0, 3.0],
            "darks": np.arange(96).reshape(3, 2, 4, 4) % 3, "dark_exposures": [1.0, 2.0, 3.0],
            "full_scale": 255}  # fmt: skip
    with pytest.raises(error, match=text):
        photon_transfer(**(good | change))
