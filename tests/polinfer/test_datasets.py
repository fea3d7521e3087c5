"""The measured fibre is read as it was published, and damaged copies are refused."""

import os

import numpy as np
import pytest

import polinfer
from polinfer import datasets


def fibre_folder():
    """The folder with the data; without it the test is skipped, or fails where POLINFER_REQUIRE_DATA=1."""
    try:
        folder = datasets.data_directory()
        datasets.multimode_fibre("5.0", folder)
    except FileNotFoundError as error:
        if os.environ.get("POLINFER_REQUIRE_DATA") == "1":
            pytest.fail(f"POLINFER_REQUIRE_DATA=1, but {error}")
        pytest.skip(f"measured data are not here: {error}")
    return folder


def test_blocks_are_the_four_quadrants_and_hold_the_published_share_of_energy():
    folder = fibre_folder()
    fibre = datasets.multimode_fibre("5.0", folder)
    matrix = np.load(folder / "mmf_tm_measured" / "TM_modes_5.0.npz", allow_pickle=False)["TM_corr_modes"]
    np.testing.assert_array_equal(fibre.jones[3, 7], [[matrix[3, 7], matrix[3, 62]], [matrix[58, 7], matrix[58, 62]]])
    energy = np.sum(np.abs(fibre.jones) ** 2, axis=(-1, -2))
    assert energy[fibre.near_degenerate].sum() / energy.sum() == pytest.approx(0.91, abs=0.01)
    assert fibre.near_degenerate.mean() == pytest.approx(0.127, abs=0.001)


def test_two_near_states_bound_the_noise_at_seven_percent():
    folder = fibre_folder()
    first, second = (datasets.multimode_fibre(state, folder) for state in ("5.04", "5.044"))
    sigma, per_pair = datasets.noise_upper_bound(first, second)
    signal = np.sqrt(np.mean(np.abs(first.jones) ** 2))
    assert np.sqrt(2) * sigma / signal == pytest.approx(0.074, abs=0.003)
    near = first.near_degenerate
    assert np.sum(per_pair[near] ** 2) / np.sum(per_pair**2) > 0.75  # it sits where the light is


def test_measured_matrices_are_fitted_and_the_residual_is_the_forbidden_part():
    """A product of a linear polariser and a retarder has Im (J J^H)_01 = 0: that is the one number left over."""
    jones = datasets.multimode_fibre("5.04", fibre_folder()).jones
    signal = float(np.sqrt(np.mean(np.abs(jones) ** 2)))
    sigma = 0.05 * signal
    model = polinfer.Model(gain=polinfer.ComplexGain(signal))
    result = polinfer.fit(model, polinfer.Measurement.from_jones(jones, sigma))
    assert np.mean((result.status & int(polinfer.Status.NOT_CONVERGED)) != 0) == 0
    assert (result.degrees_of_freedom == 1).all()
    product = jones @ np.conj(np.swapaxes(jones, -1, -2))
    size = np.linalg.norm(jones, axis=(-1, -2))
    forbidden = np.abs(product[..., 0, 1].imag) / (sigma * size)  # in units of about its own noise
    bad = (result.status & int(polinfer.Status.BAD_FIT)) != 0
    bright = size > 10 * sigma
    assert bad[bright & (forbidden > 6)].mean() > 0.95
    assert bad[bright & (forbidden < 1)].mean() < 0.02
    # an evidence is a mean of the likelihood over the prior and cannot exceed its maximum
    highest = result.log_posterior - np.asarray(model.log_prior(result.parameters))
    unidentified = sum(int(polinfer.Status.unidentified(name)) for name in polinfer.Parameters._fields)
    sure = (result.status & (unidentified | int(polinfer.Status.AT_EDGE))) == 0
    assert (result.log_evidence < highest + np.where(sure, 0, 4)).all()


def test_missing_and_wrong_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; set POLINFER_DATA"):
        datasets.multimode_fibre("5.0", tmp_path / "nowhere")
    folder = tmp_path / "mmf_tm_measured"
    folder.mkdir()
    with pytest.raises(FileNotFoundError, match=r"has no TM_modes_5\.0\.npz"):
        datasets.multimode_fibre("5.0", tmp_path)
    path = folder / "TM_modes_5.0.npz"
    np.savez(path, other=np.ones(3))
    with pytest.raises(ValueError, match="no array 'TM_corr_modes'"):
        datasets.multimode_fibre("5.0", tmp_path)
    np.savez(path, TM_corr_modes=np.ones((110, 110)))
    with pytest.raises(ValueError, match="expected kind 'c'"):
        datasets.multimode_fibre("5.0", tmp_path)
    np.savez(path, TM_corr_modes=np.full((110, 110), np.nan + 0j))
    with pytest.raises(ValueError, match="not finite"):
        datasets.multimode_fibre("5.0", tmp_path)
    np.savez(path, TM_corr_modes=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        datasets.multimode_fibre("5.0", tmp_path)
