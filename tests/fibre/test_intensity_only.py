"""Rows and whole calibrations from intensities: the true ones, up to the phases that no intensity tells."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from acquisition import PatternPlan, SimulatedBench, calibrate
from fibre import (
    CalibrationFields,
    ForwardInverse,
    IntensityOnly,
    RowStatus,
    recover,
    rows_from_intensities,
)
from fibre.coupling import coupling_profile
from tests.fibre import benches
from tests.fibre.scenes import complex_noise


def overlap(a, b):
    """Of rows, up to a phase of each."""
    return np.abs((a.conj() * b).sum(1)) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


def measured(rows, count, seed, level=0.01):
    """Gaussian inputs, intensities with 40 dB of noise unless told otherwise, and its variance."""
    generator = np.random.default_rng(seed)
    x = complex_noise(generator, (rows.shape[1], count))
    clean = np.abs(rows @ x) ** 2
    noise = level * np.sqrt((clean**2).mean())
    return x, clean + noise * generator.standard_normal(clean.shape), noise**2


def banded(m, n, width, seed=0):
    rows = complex_noise(np.random.default_rng(seed), (m, n))
    return rows * (np.abs(np.arange(m)[:, None] * n / m - np.arange(n)) <= width)


@pytest.mark.parametrize(
    "algorithm",
    ["variational", pytest.param("message_passing", marks=pytest.mark.slow)],  # sparse rows below
)
def test_gaussian_rows_are_found_from_eight_intensities_an_unknown(algorithm):
    rows = complex_noise(np.random.default_rng(0), (64, 64))
    found = rows_from_intensities(*measured(rows, 512, 1), algorithm=algorithm)
    assert overlap(rows, found.values).min() > 0.99
    assert not found.status.any()
    np.testing.assert_allclose(np.linalg.norm(found.values, axis=1), np.linalg.norm(rows, axis=1), rtol=0.02)


def test_the_spectral_start_is_what_theory_says_and_no_more():
    """Without noise and with many unknowns the optimal weight has a squared overlap of about 0.85 at 8 an unknown."""
    rows = complex_noise(np.random.default_rng(0), (64, 64))
    found = overlap(rows, rows_from_intensities(*measured(rows, 512, 1), algorithm="spectral").values) ** 2
    assert 0.78 < found.mean() < 0.92
    few = overlap(rows, rows_from_intensities(*measured(rows, 96, 1), algorithm="spectral").values) ** 2
    assert few.mean() < 0.3


def test_the_stated_variance_is_the_mean_squared_error():
    rows = complex_noise(np.random.default_rng(2), (40, 30))
    found = rows_from_intensities(*measured(rows, 300, 3, 0.02))
    turned = found.values * np.exp(1j * np.angle((found.values.conj() * rows).sum(1)))[:, None]
    error = (np.abs(turned - rows) ** 2).mean()
    assert error / found.variance.mean() == pytest.approx(1, abs=0.1)
    assert found.chi_square.mean() == pytest.approx(1, abs=0.05)


def test_sparse_rows_need_fewer_intensities_by_message_passing():
    rows = banded(24, 64, 2)
    x, intensities, variance = measured(rows, 80, 4)
    sparse = rows_from_intensities(x, intensities, variance, algorithm="message_passing")
    plain = rows_from_intensities(x, intensities, variance)
    good = overlap(rows, sparse.values) > 0.99
    assert good.mean() > 0.7
    assert (overlap(rows, plain.values) < 0.9).all()
    # what was not found says so
    assert (sparse.status[~good] != 0).all()
    assert (plain.status & RowStatus.UNDETERMINED != 0).all()


def test_a_prior_that_knows_the_band_does_too():
    rows = banded(24, 64, 4)
    x, intensities, variance = measured(rows, 80, 4)
    found = rows_from_intensities(x, intensities, variance, prior=(np.abs(rows) > 0).astype(float))
    assert overlap(rows, found.values).min() > 0.999
    assert np.all(found.values[rows == 0] == 0)


def test_the_unit_and_missing_intensities_do_not_matter():
    rows = complex_noise(np.random.default_rng(5), (3, 10))
    x, intensities, variance = measured(rows, 80, 6)
    found = rows_from_intensities(x, intensities, variance).values
    scaled = rows_from_intensities(1e-6 * x, 1e8 * intensities, 1e16 * variance).values
    np.testing.assert_allclose(scaled, 1e10 * found, rtol=1e-5)
    spread = np.full(intensities.shape, variance)
    broken, spread[:, :5] = intensities.copy(), np.inf
    broken[:, :5] = 1e6
    left_out = rows_from_intensities(x, broken, spread).values
    without = rows_from_intensities(x[:, 5:], intensities[:, 5:], variance).values
    np.testing.assert_allclose(left_out, without, rtol=1e-6)


def test_rows_may_have_inputs_of_their_own():
    rows = complex_noise(np.random.default_rng(7), (2, 8))
    one, other = measured(rows[:1], 64, 8), measured(rows[1:], 64, 9)
    both = rows_from_intensities(np.stack([one[0], other[0]]), np.concatenate([one[1], other[1]]),
                                 np.repeat([[one[2]], [other[2]]], 64, 1))  # fmt: skip
    assert overlap(rows, both.values).min() > 0.999


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"algorithm": "magic"}, "algorithm must be one of"),
        ({"starts": 0}, "starts must be >= 1"),
        ({"prior": np.ones(3)}, "prior must have shape"),
        ({"variance": 0.0}, "variance must be > 0"),
        ({"intensities": np.full((2, 9), np.nan)}, "intensities must be finite"),
    ],
)
def test_wrong_arguments_are_named(change, text):
    call = {"inputs": np.ones((4, 9)), "intensities": np.ones((2, 9)), "variance": 1.0} | change
    with pytest.raises(ValueError, match=text):
        rows_from_intensities(**call)


@pytest.fixture(scope="module")
def patterns(bench, tmp_path_factory):
    """A calibration of random patterns on the small bench."""
    plan = PatternPlan((4, 4), pitch=benches.PLAN.pitch, patterns=24, reference_every=36, views=benches.VIEWS)
    return calibrate(SimulatedBench(bench.scene, rng=4), plan, tmp_path_factory.mktemp("patterns"))


@pytest.fixture(scope="module")
def inverse(bench, patterns):
    method = IntensityOnly(retrieval=benches.METHOD, fibrelets=bench.calibration_fields.fibrelets)
    return recover(patterns, method)


def test_fields_of_a_calibration_need_no_retrieval_but_of_a_few_captures(bench, patterns, inverse):
    fields, inputs = inverse.calibration, patterns.inputs.toarray()
    assert isinstance(fields, CalibrationFields)
    true = np.stack([bench.seen(x.reshape(2, -1)) for x in inputs.T])
    used = np.flatnonzero((np.abs(bench.reference) ** 2).sum(0) < 0.02 * (np.abs(bench.reference) ** 2).sum(0).max())
    found, true = fields.fields[..., used], true[..., used]
    turn = np.exp(1j * np.angle(np.vdot(found, true)))
    assert np.linalg.norm(found * turn - true) < 0.01 * np.linalg.norm(true)


def test_what_is_not_known_is_finite_and_says_so(bench, inverse):
    fields = inverse.calibration
    assert np.all(np.isfinite(fields.variance))
    unknown = np.all(fields.fields == 0, axis=(0, 1))
    assert unknown.any()
    assert np.all(fields.variance[..., unknown] >= np.abs(fields.fields).max() ** 2)
    # and does not bend the coupling profile
    at = np.array([1e-6, 4e-6])
    usual = coupling_profile(bench.calibration_fields)(at)
    np.testing.assert_allclose(np.log(coupling_profile(fields)(at)), np.log(usual), atol=0.7)


def test_held_out_fields_are_recovered(bench, inverse):
    z = complex_noise(np.random.default_rng(1), (32, 20))
    seen = np.stack([bench.seen(column.reshape(2, -1)).ravel() for column in z.T], 1)
    found = inverse.matrix @ seen
    turn = np.exp(1j * np.angle(np.vdot(found, z)))
    assert np.linalg.norm(found * turn - z) < 0.12 * np.linalg.norm(z)


def test_a_plan_of_single_spots_is_refused(bench):
    with pytest.raises(ValueError, match="several points within reach of each"):
        recover(bench.calibration, IntensityOnly(fibrelets=bench.calibration_fields.fibrelets))


def test_the_right_record_is_asked_for(bench):
    with pytest.raises(TypeError, match="IntensityOnly retrieves no fields"):
        recover(bench.calibration_fields, IntensityOnly())
    with pytest.raises(TypeError, match="calibration_fields must be CalibrationFields"):
        recover(bench.calibration, ForwardInverse())
    with pytest.raises(ValueError, match="tie must be >= 1"):
        IntensityOnly(tie=0)
    for algorithm in ("magic", "spectral"):
        with pytest.raises(ValueError, match="algorithm must be"):
            IntensityOnly(algorithm=algorithm)


@pytest.mark.slow  # twice the time of the other algorithm
def test_message_passing_finds_the_same_calibration(bench, patterns, inverse):
    fibrelets = bench.calibration_fields.fibrelets
    method = IntensityOnly("message_passing", retrieval=benches.METHOD, fibrelets=fibrelets)
    found, other = method.fields(patterns).fields, inverse.calibration.fields
    turn = np.exp(1j * np.angle(np.vdot(found, other)))
    assert np.linalg.norm(found * turn - other) < 0.02 * np.linalg.norm(other)


def test_images_out_of_focus_are_refused(patterns):
    moved = replace(patterns, images=replace(patterns.images, diversity=patterns.images.diversity + 1e-5))
    with pytest.raises(ValueError, match="no image in focus"):
        recover(moved, IntensityOnly(fibrelets=None))


def test_the_coupling_profile_of_patterns_is_that_of_spots(standard):
    """Half of the points lit at once with random phases, against spots far apart."""
    generator = np.random.default_rng(0)
    inputs = complex_noise(generator, (128, 60)) * np.tile(generator.random((64, 60)) < 0.5, (2, 1))
    fields = standard.calibration(1e-4, 0)
    clean = (standard.matrix @ inputs).T.reshape(60, 2, -1)
    many = replace(fields, fields=clean, variance=np.full(clean.shape, 1e-8), inputs=scipy.sparse.csr_array(inputs))
    at = np.array([1e-6, 3e-6, 5e-6, 7e-6])
    np.testing.assert_allclose(np.log(coupling_profile(many)(at)), np.log(coupling_profile(fields)(at)), atol=0.7)
