"""A tilt in everything around the fit: draws, bounds, files, pictures, the command line."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from polinfer import Gibbs, Measurement, Model, Parameters, Status, TiltPlane, cramer_rao_bound, fit, tilt_bound, untilt
from polinfer.cli import main
from polinfer.comparison.cross_validation import leave_one_out
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED, UNBALANCED, everywhere
from tests.polinfer.test_files import same
from tests.polinfer.test_tilt import SHAPE, TILTED, plane, plate

SMALL = (8, 9)
SLOPES = (0.3, 1.0, -2.0)


@pytest.fixture(scope="module")
def data():
    return polinfer.simulate(Model(), plate(SMALL, 0.3), BALANCED, 0.05, rng=1, tilt=plane(SMALL, *SLOPES))


@pytest.fixture(scope="module")
def found(data):
    return fit(TILTED, data)


@pytest.fixture(scope="module")
def draws(data):
    return polinfer.sample(TILTED, data, Gibbs(evidence=False), chains=2, draws=1000, rng=3)


def test_draws_have_the_width_of_pixel_and_tilt_together(draws, found, data):
    width = np.std(draws.parameters.circularity, axis=(0, 1))
    given = polinfer.sample(Model(), untilt(data, found.tilt.phase), Gibbs(evidence=False), chains=2, draws=1000, rng=3)
    alone = np.std(given.parameters.circularity, axis=(0, 1))
    expected = np.hypot(alone, found.tilt.phase_std * found.tilt.response[..., 4])
    assert np.median(expected / alone) > 1.02  # the tilt is seen in it
    np.testing.assert_allclose(width, expected, rtol=0.15)
    np.testing.assert_allclose(np.median(width / expected), 1, rtol=0.02)
    covariance = np.cov(draws.tilt.reshape(-1, 3).T)
    np.testing.assert_allclose(covariance, found.tilt.covariance, atol=0.15 * np.max(found.tilt.covariance))


def test_what_the_draws_predict_is_what_was_measured(draws, data):
    check = draws.predictive(rng=1, draws=100, responses=True)
    assert np.mean(check.p_value) > 0.3  # 1e-3 and less without the tilt
    assert np.abs(check.response.mean(axis=0) - data.response).max() < 0.05 * 6
    # what draws foretell of a state falls short of what the truth does, by about the five parameters
    told = Model().log_likelihood(plate(SMALL, 0.3), data, tilt=plane(SMALL, *SLOPES))
    short = np.asarray(told) - leave_one_out(draws).log_density
    assert 2 < np.mean(short) < 10


def test_parts_of_a_frame_share_the_draws_of_its_tilt(draws, data):
    summary = polinfer.summarise(TILTED, data, Gibbs(evidence=False), chains=2, draws=1000, rng=3)
    np.testing.assert_allclose(summary.std.circularity, draws.summary().std.circularity, rtol=1e-6)
    with pytest.raises(ValueError, match="TiltPlane"):
        polinfer.calibration_ranks(TILTED, BALANCED, 0.1, 4)


def test_a_tilt_that_is_not_known_leaves_the_circularity_open():
    data = polinfer.simulate(Model(), plate(SMALL, 0.0, angle=0.0), BALANCED, 0.05, rng=1)
    draws = polinfer.sample(TILTED, data, Gibbs(evidence=False), chains=2, draws=500, rng=3)
    assert np.all(draws.status & int(Status.TILT_UNIDENTIFIED))
    spread = np.abs(np.mean(np.exp(2j * draws.parameters.circularity), axis=(0, 1)))
    assert np.all(spread < 0.25)


def _bound_by_differences(truth, u, sigma, phase):
    """Inverse Fisher information of all pixels and the three coefficients together, plain NumPy, one step a number."""
    rows, columns = phase.shape
    count = rows * columns
    points = np.stack([np.broadcast_to(x, phase.shape).ravel() for x in truth], axis=-1)
    basis = np.stack([plane(phase.shape, *row).ravel() for row in np.eye(3)])

    def field(x, phi):
        turn = np.diag([1, np.exp(1j * phi)])
        response = turn.conj() @ oracle.jones(x) @ turn @ u
        return np.concatenate([response.real.ravel(), response.imag.ravel()])

    size = len(field(points[0], 0.0))
    jacobian = np.zeros((count * size, 5 * count + 3))
    for i, (x, phi) in enumerate(zip(points, phase.ravel(), strict=True)):
        block = slice(i * size, (i + 1) * size)
        for k in range(5):
            step = 1e-6 * np.eye(5)[k]
            jacobian[block, 5 * i + k] = (field(x + step, phi) - field(x - step, phi)) / 2e-6
        by_phase = (field(x, phi + 1e-6) - field(x, phi - 1e-6)) / 2e-6
        jacobian[block, 5 * count :] = by_phase[:, None] * basis[:, i]
    std = np.sqrt(np.diag(np.linalg.inv(2 / sigma**2 * jacobian.T @ jacobian)))
    return std[: 5 * count].reshape(rows, columns, 5), std[5 * count :]


def test_bounds_are_those_of_the_whole_frame_at_once():
    rng, shape = np.random.default_rng(4), (3, 4)
    truth = Parameters(rng.uniform(0.1, 0.5, shape), 0.6, rng.uniform(1, 2, shape), 0.5, rng.normal(0, 0.5, shape))
    phase = plane(shape, 0.4, 2.0, -1.0)
    pixels, coefficients = _bound_by_differences(truth, UNBALANCED, 0.03, phase)
    bound = cramer_rao_bound(TILTED, truth, UNBALANCED, 0.03, tilt=phase)
    np.testing.assert_allclose(np.stack(list(bound), axis=-1), pixels, rtol=1e-4)
    np.testing.assert_allclose(tilt_bound(TILTED, truth, UNBALANCED, 0.03, tilt=phase), coefficients, rtol=1e-4)


def test_without_a_diattenuator_only_the_circularity_has_no_bound():
    truth = plate((4, 5), 0.0)
    bound, plain = (cramer_rao_bound(model, truth, BALANCED, 0.03) for model in (TILTED, Model()))
    assert np.all(np.isinf(bound.circularity))
    assert np.all(np.isinf(tilt_bound(TILTED, truth, BALANCED, 0.03)))
    np.testing.assert_allclose(bound.retardance, plain.retardance)
    np.testing.assert_allclose(bound.retardance_angle, plain.retardance_angle)
    with pytest.raises(ValueError, match="tilt"):
        tilt_bound(Model(), truth, BALANCED, 0.03)


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_saved_and_loaded(found, draws, ending, tmp_path):
    for name, record in (("fit", found), ("draws", draws)):
        same(polinfer.load(polinfer.save(record, tmp_path / f"{name}{ending}")), record)


def test_the_picture_shows_the_tilt(found, tmp_path):
    figure = found.plot()
    titles = [axes.get_title() for axes in figure.axes]
    assert "tilt (°)" in titles
    shown = figure.axes[titles.index("tilt (°)")].images[0].get_array()
    np.testing.assert_allclose(shown, np.degrees(found.tilt.phase))
    lost = replace(found, status=found.status | int(Status.TILT_UNIDENTIFIED))
    lost.plot().savefig(tmp_path / "maps.png")


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_the_command_line_simulates_and_fits_a_tilt(tmp_path):
    data, out = tmp_path / "data.nc", tmp_path / "fit.nc"
    made = run("simulate", data, "--shape", *SHAPE, "--tilt", "20", "90", "-300", "--seed", "1", "--sigma", "0.02")
    assert made.exit_code == 0, made.output
    told = run("fit", data, out, "--tilt", "plane", "--tilt-scale", "900", "--no-progress")
    assert told.exit_code == 0, told.output
    assert "tilt: piston" in told.output
    found = polinfer.load(out)
    assert found.model == Model(misalignment=TiltPlane(np.radians(900)))
    # its mean circularity is not 0, and the piston takes over what the prior would not have
    np.testing.assert_allclose(np.degrees(found.tilt.coefficients[1:]), [90, -300], atol=12)
    for options, message in (
        (("--tilt", "rotated-basis"), "--window"),
        (("--tilt-scale", "3"), "only for --tilt plane"),
    ):
        refused = run("fit", data, tmp_path / "other.nc", *options)
        assert refused.exit_code == 2
        assert message in refused.output


def test_a_measurement_of_one_shape_and_a_tilt_of_another():
    data = Measurement(np.eye(2), np.ones((2, 3, 2, 2)), 0.1)
    for tilt in (np.zeros((3, 2)), np.zeros((4, 2, 3))):
        with pytest.raises(ValueError, match="tilt"):
            Model().log_likelihood(everywhere((2, 3), (0.1, 0.2, 0.3, 0.4, 0.5)), data, tilt=tilt)
