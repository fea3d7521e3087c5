"""Columns of A are found as well as the noise allows, and the calibration knows how well that is."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from fibre.calibration import columns, response_covariance, unmeasured
from fibre.coupling import clean_fibrelets, coupling_profile, positions_on_camera
from tests.fibre.scenes import complex_noise, scene, without_noise

NOISE = 0.01


def clean(fields):
    """Rows of A that are determined: fibrelets without the reference spot, h then v."""
    return np.tile(clean_fibrelets(fields), 2)


@pytest.fixture(scope="module")
def repeats(standard):
    """Columns from eight noise realisations of one calibration."""
    return [columns(standard.calibration(NOISE, seed)) for seed in range(8)]


def test_the_columns_are_dense_bayesian_regression(standard):
    fields = standard.calibration(NOISE, 0)
    found, profile = columns(fields), coupling_profile(fields)
    x, count, m = standard.plan.inputs.toarray(), 64, standard.bundle.cores
    row = int(np.flatnonzero(clean(fields))[30])
    centre = standard.bundle.centres[row % m]
    distance = np.hypot(*(standard.plan.points - centre).T)
    prior = np.where(distance <= profile.reach(1e-5), profile(distance), 0)
    prior = np.diag(np.tile(prior, 2))
    y = fields.fields[:, row // m, row % m]
    system = x.conj().T @ prior @ x + NOISE**2 * np.eye(x.shape[1])
    expected = y @ np.linalg.solve(system, x.conj().T @ prior)
    covariance = prior - prior @ x @ np.linalg.solve(system, x.conj().T @ prior)
    np.testing.assert_allclose(found.values.toarray()[row], expected, atol=1e-10)
    np.testing.assert_allclose(found.variance.toarray()[row], np.diag(covariance).real, atol=1e-12)
    assert found.values.shape == (2 * m, 2 * count)


def test_the_stated_variance_of_the_columns_is_the_mean_squared_error(standard, repeats):
    """The prior is the bundle's mean profile, not each fibrelet's own: true on average, within 25 %."""
    stated, squared = [], []
    for found in repeats:
        place = found.variance.tocoo()
        squared.append(np.abs(found.values.toarray() - standard.matrix)[place.row, place.col] ** 2)
        stated.append(place.data)
    stated, squared = np.concatenate(stated), np.concatenate(squared)
    assert 0.75 < squared.sum() / stated.sum() < 1.25
    order = np.argsort(stated)  # and so it is where the variance is large and where it is small
    for part in np.array_split(order, 4)[1:]:
        assert 0.4 < squared[part].sum() / stated[part].sum() < 1.5


def test_what_is_left_out_is_next_to_nothing(standard, repeats):
    fields = standard.calibration(NOISE, 0)
    kept = repeats[0].variance.toarray() > 0
    power = np.abs(standard.matrix) ** 2 * clean(fields)[:, None]
    assert power[~kept].sum() < 1e-3 * power.sum()


def test_more_noise_is_more_variance_and_more_error(standard):
    errors = []
    for noise in (0.003, 0.01, 0.03):
        fields = standard.calibration(noise, 1)
        found, rows = columns(fields), clean(fields)
        errors.append(np.linalg.norm((found.values.toarray() - standard.matrix)[rows]))
    assert errors[0] < 0.7 * errors[1] < 0.49 * errors[2]


def test_one_spot_at_a_time_without_noise_gives_the_columns_exactly():
    alone = scene(grid=(3, 4), stride=4)  # every point its own translation
    fields = alone.calibration(1e-9, 0)
    found, rows = columns(without_noise(fields)), clean(fields)
    place = np.zeros(found.values.shape, bool)
    place[found.variance.tocoo().row, found.variance.tocoo().col] = True
    place &= rows[:, None]
    assert np.abs(found.values.toarray() - alone.matrix)[place].max() < 1e-6


def test_response_covariance_of_a_unit_input_is_the_variance_of_its_column(standard):
    fields = standard.calibration(NOISE, 0)
    units = np.eye(128)[:, [5, 30, 100]]
    covariance = response_covariance(fields, units)
    stated = columns(fields).variance.toarray()[:, [5, 30, 100]]
    np.testing.assert_allclose(np.einsum("iss->is", covariance).real, stated, atol=1e-14)
    np.testing.assert_allclose(covariance, covariance.conj().swapaxes(1, 2), atol=1e-14)


@pytest.mark.parametrize("kind", ["rough", "smooth"])
def test_response_covariance_is_that_of_repeated_calibrations(standard, repeats, kind):
    if kind == "rough":
        z = complex_noise(np.random.default_rng(0), (128, 3))
    else:
        field = standard.smooth_sample() @ standard.plan.illumination
        z = field.swapaxes(0, 1).reshape(128, 3)
    fields = standard.calibration(NOISE, 0)
    rows = clean(fields)
    covariance = response_covariance(fields, z)
    assert np.all(covariance[~rows] == 0)
    errors = np.stack([(found.values @ z - standard.matrix @ z)[rows] for found in repeats])
    sampled = np.einsum("kis,kit->st", errors.conj(), errors) / len(repeats)
    stated = covariance[rows].sum(0)
    np.testing.assert_allclose(np.diag(sampled).real, np.diag(stated).real, rtol=0.35)
    # the errors of the states are correlated as stated, not only as large
    assert np.linalg.norm(sampled - stated) < 0.35 * np.linalg.norm(stated)


def test_the_chunk_and_the_unit_do_not_matter(standard):
    fields = standard.calibration(NOISE, 0)
    found = columns(fields)
    np.testing.assert_allclose(columns(fields, chunk=7).values.toarray(), found.values.toarray(), atol=1e-12)
    scaled = replace(fields, fields=1e4 * fields.fields, variance=1e8 * fields.variance)
    np.testing.assert_allclose(columns(scaled).values.toarray(), 1e4 * found.values.toarray(), atol=1e-7)


def test_fibrelets_that_carry_the_reference_get_no_columns(standard):
    fields = standard.calibration(NOISE, 0)
    found, rows = columns(fields), clean(fields)
    assert 0 < np.count_nonzero(~rows) < 30
    assert found.values[np.flatnonzero(~rows)].nnz == 0
    assert np.all(np.diff(found.values.indptr)[rows] > 0)


def test_the_coupling_profile_is_the_mean_power_against_distance(standard):
    profile = coupling_profile(standard.calibration(1e-4, 0))
    m = standard.bundle.cores
    distance = np.hypot(*(standard.bundle.centres[:, None] - standard.plan.points).transpose(2, 0, 1))
    power = (np.abs(standard.matrix.reshape(2, m, 2, 64)) ** 2).mean((0, 2))
    for low, high in ((0, 1.5e-6), (2e-6, 4e-6), (4e-6, 6e-6)):
        inside = (distance >= low) & (distance < high)
        assert profile(distance[inside]).mean() == pytest.approx(power[inside].mean(), rel=0.35)
    assert np.all(np.diff(profile(np.linspace(0, 5e-5, 100))) <= 0)
    reach = profile.reach(1e-3)
    assert profile(np.array([reach * 1.001]))[0] <= 1e-3 * profile.power[0]


def test_spots_far_apart_have_the_same_coupling_profile(standard):
    """One spot for the whole bundle: most fibrelets see nothing, and must not blur what the near ones say."""
    far = scene(grid=(3, 3), stride=3, radius=100e-6, reference=(0.0, 95e-6), pitch=60e-6)
    profile, near = coupling_profile(far.calibration(1e-3, 0)), coupling_profile(standard.calibration(1e-4, 0))
    at = np.array([0.5e-6, 2e-6, 4e-6, 6e-6])
    # nine spots against sixty-four: their mean power in a bin scatters
    np.testing.assert_allclose(np.log(profile(at)), np.log(near(at)), atol=0.5)
    assert profile.reach(1e-3) < 20e-6


def test_what_light_between_the_points_puts_on_fibrelets_is_the_sum_of_the_profile_over_the_facet(standard):
    sparse = scene(grid=(6, 6), pitch=7.6e-6, radius=34e-6, reference=(0.0, 31e-6)).calibration(1e-3, 1)
    profile, centres = coupling_profile(sparse), sparse.fibrelets.centres
    apart = np.hypot(*np.moveaxis(centres[:, None] - centres, -1, 0))
    near = apart <= profile.reach(1e-5)
    total = np.where(near, profile(apart), 0).sum(1)
    away = np.hypot(*np.moveaxis(sparse.points[:, None] - centres, -1, 0))
    cell = np.count_nonzero(away < 7.6e-6 / np.sqrt(np.pi)) / 36
    assert cell == pytest.approx(7.6**2 / (np.sqrt(3) / 2 * 4.5**2), rel=0.1)
    np.testing.assert_allclose(unmeasured(sparse), (1 - 1 / cell) / cell**2 * total, rtol=1e-6)
    # a fibrelet to a point: all is measured
    assert np.max(unmeasured(standard.calibration(1e-3, 0))) < 0.05 * total.max()
    assert np.all(unmeasured(one_point(standard)) == 0)


def test_an_even_light_made_of_spots_at_all_points_falls_as_their_density_on_every_fibrelet(standard):
    bundle, powers, pitches = standard.bundle, [], np.array([2.0e-6, 2.5e-6])
    inner = np.hypot(*bundle.centres.T) < 8e-6
    for pitch in pitches:
        side = np.arange(-20, 21) * pitch
        places = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        powers.append(np.asarray(bundle.launch(places, 2.5e-6).sum(1)).ravel()[inner] ** 2)
    np.testing.assert_allclose(powers[0] / powers[1], (pitches[1] / pitches[0]) ** 4, rtol=0.01)


def one_point(standard):
    fields = standard.calibration(1e-3, 0)
    inputs = fields.inputs.tocsr()[[0, 64]]
    return replace(fields, points=fields.points[:1], inputs=inputs, grid=(1, 1))


def test_the_registration_maps_points_to_the_camera(standard):
    fields = standard.calibration(NOISE, 0)
    map_ = np.array([[0.0, 2.0, 1e-6], [-1.0, 0.0, 3e-6]])
    moved = positions_on_camera(replace(fields, registration=map_))
    for point, place in zip(fields.points, moved, strict=True):
        np.testing.assert_allclose(place, map_ @ [*point, 1.0])


def test_a_calibration_on_a_turned_camera_is_the_same_calibration(standard):
    fields = standard.calibration(NOISE, 0)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    centres = standard.bundle.centres @ turn.T + [2e-6, -3e-6]
    turned = replace(
        fields,
        registration=np.column_stack([turn, [2e-6, -3e-6]]),
        fibrelets=replace(fields.fibrelets, centres=centres),
    )
    np.testing.assert_allclose(columns(turned).values.toarray(), columns(fields).values.toarray(), atol=1e-9)


def test_a_calibration_that_leaves_points_dark_or_misses_the_fibre_is_an_error(standard):
    fields = standard.calibration(NOISE, 0)
    inputs = fields.inputs.toarray()
    inputs[[9, 64 + 9]] = 0
    with pytest.raises(ValueError, match="inputs must light every point, but never light 1 of them, first 9"):
        columns(replace(fields, inputs=scipy.sparse.csr_array(inputs)))
    inputs = fields.inputs.toarray()
    inputs[5], inputs[64 + 5] = 1.0 * (inputs[5] != 0), 1j * (inputs[5] != 0)
    with pytest.raises(ValueError, match="in two states of polarisation or more, but 1 points have one, first 5"):
        columns(replace(fields, inputs=scipy.sparse.csr_array(inputs)))
    noise = complex_noise(np.random.default_rng(0), fields.fields.shape) * NOISE
    with pytest.raises(ValueError, match="too few lit fibrelets"):
        columns(replace(fields, fields=noise))
