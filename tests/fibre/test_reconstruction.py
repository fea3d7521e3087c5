"""Jones data at the distal facet: right where there is nothing to see, and as uncertain as stated."""

from dataclasses import replace

import numpy as np
import pytest

from fibre import Fibrelets, ForwardInverse, reconstruct, recover
from polinfer import Parameters
from tests.fibre.scenes import scene
from tests.oracles import jones as oracle

NOISE = 0.003


@pytest.fixture(scope="module")
def inverse(standard):
    return recover(standard.calibration(NOISE, 0), ForwardInverse())


def jones_of(measurement):
    u = measurement.illumination.reshape(-1, *measurement.illumination.shape[-2:])
    v = measurement.response.reshape(u.shape)
    return v @ np.linalg.pinv(u), u


def weighted_error(measurement, jones):
    """tr[dJ U U^H dJ^H] / 4 of every point: sigma^2 if its expectation is that of independent errors."""
    found, u = jones_of(measurement)
    difference = (found - jones) @ u
    return np.sum(np.abs(difference) ** 2, axis=(1, 2)) / 4


def repeats(standard, calibration_noise, noise, count=8):
    """Mean squared errors and stated variances over new calibrations and new recordings, (count, p)."""
    jones, light = standard.smooth_sample(), standard.light()
    squared, stated = [], []
    for k in range(count):
        found = recover(standard.calibration(calibration_noise, 100 + k), ForwardInverse())
        data = reconstruct(found, standard.recording(jones, light, noise, 1000 + k))
        squared.append(weighted_error(data, jones))
        stated.append(data.sigma.ravel() ** 2)
    return np.array(squared), np.array(stated)


@pytest.mark.parametrize(("calibration_noise", "noise"), [(0.003, 0.003), (0.003, 3e-4), (0.003, 0.01)])
def test_sigma_is_the_true_error_of_the_jones_matrices(standard, calibration_noise, noise):
    squared, stated = repeats(standard, calibration_noise, noise)
    assert 0.75 < squared.mean() / stated.mean() < 1.25
    ratio = squared.mean(0) / stated.mean(0)
    assert 0.7 < np.median(ratio) < 1.3
    assert np.mean((ratio > 1 / 3) & (ratio < 3)) > 0.85  # the mean of eight errors of four numbers each


def test_blank_and_sample_alike_give_exactly_the_identity(standard, inverse):
    fields = standard.recording(standard.smooth_sample(), standard.light(), NOISE, 0)
    data = reconstruct(inverse, replace(fields, fields=fields.blank))
    np.testing.assert_array_equal(data.response, data.illumination)
    found, _ = jones_of(data)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(2), found.shape), atol=1e-9)


def test_without_a_sample_the_jones_matrices_are_the_identity_within_sigma(standard, inverse):
    nothing = np.broadcast_to(np.eye(2), (64, 2, 2))
    data = reconstruct(inverse, standard.recording(nothing, standard.light(), NOISE, 5))
    # chi-square with 8 degrees of freedom a point: four complex components; neighbours share noise
    chi_square = weighted_error(data, nothing) / data.sigma.ravel() ** 2
    assert 0.6 < chi_square.mean() < 1.4


def test_the_common_error_of_the_calibration_cancels_without_a_sample(standard):
    """A calibration error enters sample and blank alike: where they are alike, only the recording's noise is left."""
    nothing = np.broadcast_to(np.eye(2), (64, 2, 2))
    sample = standard.smooth_sample()
    inverse = recover(standard.calibration(0.02, 0), ForwardInverse())
    quiet = reconstruct(inverse, standard.recording(nothing, standard.light(), 1e-5, 5))
    changed = reconstruct(inverse, standard.recording(sample, standard.light(), 1e-5, 5))
    assert np.median(quiet.sigma) < 0.05 * np.median(changed.sigma)
    assert weighted_error(quiet, nothing).mean() < 1e-3 * weighted_error(changed, sample).mean()


def test_a_common_jones_matrix_is_recovered_whatever_the_calibration_got_wrong(standard, inverse):
    one = np.broadcast_to([[0.9, 0.2j], [-0.1, 0.5 + 0.3j]], (64, 2, 2))
    found, _ = jones_of(reconstruct(inverse, standard.recording(one, standard.light(), 1e-6, 5)))
    assert np.median(np.linalg.norm(found - one, axis=(1, 2))) < 0.1


def test_fields_are_on_the_grid_in_the_order_of_the_points(standard, inverse):
    light = standard.light()
    light[19] = 0.0  # a dark point at row 2, column 3
    nothing = np.broadcast_to(np.eye(2), (64, 2, 2))
    data = reconstruct(inverse, standard.recording(nothing, light, 1e-5, 5))
    assert data.shape == (8, 8)
    assert data.states == 3
    power = np.sum(np.abs(data.illumination) ** 2, axis=(-2, -1))
    assert np.unravel_index(np.argmin(power), (8, 8)) == (2, 3)
    np.testing.assert_allclose(np.delete(power.ravel(), 19), np.delete(3 * light**2, 19), atol=0.5 * power.max())


def test_the_unit_of_the_light_and_a_common_phase_do_not_matter(standard, inverse):
    fields = standard.recording(standard.smooth_sample(), standard.light(), NOISE, 1)
    turned = replace(
        fields, fields=7j * fields.fields, blank=7j * fields.blank, variance=49 * fields.variance,
        blank_variance=49 * fields.blank_variance,
    )  # fmt: skip
    one, other = reconstruct(inverse, fields), reconstruct(inverse, turned)
    np.testing.assert_allclose(7j * one.response, other.response, rtol=1e-9)
    # the calibration's own share scales with the light as the recording's does
    np.testing.assert_allclose(7 * one.sigma, other.sigma, rtol=1e-6)


def test_more_noise_in_the_recording_is_a_larger_sigma(standard, inverse):
    jones, light = standard.smooth_sample(), standard.light()
    sigmas = [reconstruct(inverse, standard.recording(jones, light, n, 2)).sigma for n in (1e-4, 3e-3, 1e-2)]
    assert np.median(sigmas[0]) < np.median(sigmas[1]) < np.median(sigmas[2])
    ratio = np.median(sigmas[2] / reconstruct(inverse, standard.recording(jones, light, 3e-2, 2)).sigma)
    assert ratio == pytest.approx(1 / 3, rel=0.15)  # where the recording's noise dominates


def waves(period):
    """Jones matrices at places (q, 2) that repeat themselves after ``period`` metres."""

    def at(places):
        y, x = (2 * np.pi * places / period).T
        values = Parameters(
            0.3 + 0.1 * np.sin(y + x),
            0.5 + 0.1 * np.cos(x),
            1.2 + 0.2 * np.sin(x),
            0.4 + 0.1 * np.cos(y),
            0.1 * np.sin(y),
        )
        return np.array([oracle.jones(point) for point in np.stack(values, 1)])

    return at


@pytest.fixture(scope="module")
def sparse():
    """A scene of three fibrelets to a point, and its inverse, whose calibration has next to no noise."""
    few = scene(grid=(9, 9), radius=45e-6, reference=(0.0, 41e-6), pitch=7.6e-6)
    return few, recover(few.calibration(1e-3, 0), ForwardInverse())


@pytest.mark.parametrize("period", [30e-6, 45e-6, 60e-6])
def test_what_lies_between_the_points_is_in_sigma(sparse, period):
    few, inverse = sparse
    measurement = reconstruct(inverse, few.recording_between(waves(period), 1e-6))
    inside = np.zeros(few.plan.grid, bool)
    inside[1:-1, 1:-1] = True
    squared = weighted_error(measurement, waves(period)(few.plan.points))[inside.ravel()]
    stated = measurement.sigma[inside] ** 2
    assert 0.6 < squared.mean() / stated.mean() < 1.7
    assert 0.6 < np.median(squared / stated) < 1.7


def test_where_the_sample_is_even_nothing_is_stated_for_light_between_the_points(sparse):
    few, inverse = sparse
    even, uneven = (
        reconstruct(inverse, few.recording_between(waves(period), 1e-6)).sigma[1:-1, 1:-1] for period in (1.0, 45e-6)
    )
    assert np.median(even / uneven) < 0.5


def test_noise_is_not_taken_for_a_sample_that_changes_between_the_points(sparse, monkeypatch):
    few, inverse = sparse
    even = np.broadcast_to(np.eye(2), (81, 2, 2))
    fields = few.recording(even, few.light(), 0.01, 0)
    sigma = reconstruct(inverse, fields).sigma
    monkeypatch.setattr("fibre.reconstruction.SECOND_MOMENT", 0.0)
    without = reconstruct(inverse, fields).sigma
    assert 1 <= np.mean((sigma / without) ** 2) < 1.05


def test_other_fibrelets_and_other_records_are_refused(standard, inverse):
    fields = standard.recording(standard.smooth_sample(), standard.light(), NOISE, 0)
    moved = replace(fields, fibrelets=Fibrelets(standard.bundle.centres + 1e-7, 1.6e-6))
    with pytest.raises(ValueError, match="recording_fields must be in the fibrelets of the inverse"):
        reconstruct(inverse, moved)
    with pytest.raises(TypeError, match="inverse must be Inverse"):
        reconstruct(fields, fields)
    with pytest.raises(TypeError, match="recording_fields must be RecordingFields"):
        reconstruct(inverse, inverse.calibration)
