"""The whole chain, from a simulated bench to fitted parameters, ends at the truth within the stated noise."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
from click.testing import CliRunner

import fibre
from acquisition import CalibrationPlan, SimulatedBench, demo
from acquisition.demo import demo_setup, full_setup, report, run_demo, stages
from acquisition.run import Folder
from polinfer import Parameters
from polinfer.cli import main

GRID = (10, 10)


@pytest.fixture(scope="module", params=[3, pytest.param(4, marks=pytest.mark.slow)])
def setup(request):
    """The demo's bench, spots that are lit together so many points apart: its own 4 make 51 captures, 3 make 30."""
    return replace(demo_setup(0, GRID), calibration=CalibrationPlan(GRID, stride=request.param, reference_every=24))


@pytest.fixture(scope="module")
def folder(setup, tmp_path_factory):
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def result(setup, folder):
    return run_demo(folder, 0, setup=setup)


def test_the_fitted_jones_matrices_are_true_within_the_noise(result):
    chi_square, freedom, pixels = result.chi_square
    assert pixels >= 90
    assert 0.7 < chi_square / freedom < 1.4


def test_every_file_is_there_and_loads(result, folder):
    names = {path.name for path in result.files}
    assert {"phantom.nc", "inverse.nc", "measurement.nc", "fit.nc", "maps.png"} <= names
    for path in result.files:
        assert path.parent == folder
        if path.suffix == ".nc":
            fibre.load(path)
        else:
            assert path.read_bytes()[:4] == b"\x89PNG"
    np.testing.assert_array_equal(fibre.load(folder / "fit.nc").parameters.retardance, result.fit.parameters.retardance)


def test_a_second_run_takes_no_new_capture(setup, result, folder, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/*.npz")}
    assert len(before) >= len(setup.calibration.captures) + len(setup.sample.captures)

    class Enough(Exception):
        pass

    def stop(*arguments, **keywords):
        raise Enough

    monkeypatch.setattr(Folder, "store", lambda *arguments: pytest.fail("a capture was taken again"))
    monkeypatch.setattr(fibre, "retrieve_fields", stop)  # both captures are done when the first fields are asked for
    with pytest.raises(Enough):
        run_demo(folder, 0, setup=setup)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/*.npz")} == before


def test_the_report_names_every_parameter_and_the_chi_square(result):
    lines = []
    report(result, lines.append)
    text = "\n".join(lines)
    for name in Parameters._fields:
        assert name in text
    assert f"{result.chi_square[0] / result.chi_square[1]:.2f}" in text


def test_every_stage_is_near_the_truth_and_stands_beside_the_published_figure(result):
    lines = []
    stages(result, lines.append)
    text = "\n".join(lines)
    for name in result.seconds:
        assert name in text
    for published in ("50.8 min", "67 s a field", "9.5 h", "24 min"):
        assert published in text
    assert 0 < float(result.errors["fields of the calibration"]) < 0.05
    assert 0 < float(result.errors["fields of the sample"]) < 0.05
    assert 0 < float(result.errors["inverse matrix"]) < 0.15


def test_the_full_size_is_the_published_one():
    full = full_setup(0)
    assert full.scene.camera.shape == (1200, 1200)
    assert np.prod(full.calibration.grid) == 972
    assert len(full.sample.views) * 3 == 33
    assert 8500 < full.scene.bundle.cores < 9500


@pytest.mark.slow
def test_the_setup_of_the_full_size_runs_small(tmp_path):
    setup = full_setup(0, (6, 6), 240)
    small = run_demo(tmp_path, 0, setup=setup)
    chi_square, freedom, pixels = small.chi_square
    assert pixels == 36
    assert 0.1 < chi_square / freedom < 2
    assert float(small.errors["inverse matrix"]) < 0.2
    calibration, sample = (fibre.load(tmp_path / f"{name}-fields.nc") for name in ("calibration", "sample"))
    # beside the spot, in whose light half of the fibrelets are not found, the stated error tells how far it is off
    assert float(small.errors["fields of the sample"]) < 1.5 * sample.relative_error
    # all of the light, the spot's included
    bundle, bench = setup.scene.bundle, SimulatedBench(setup.scene, rng=0)
    steps = [step for step in setup.sample.captures if step.kind == "sample"]
    core = scipy.spatial.cKDTree(bundle.centres).query(sample.fibrelets.centres)[1]
    unit = np.sqrt(setup.scene.spot_power * setup.scene.camera.quantum_efficiency)
    true = unit * np.stack([bench.amplitudes(s, setup.sample.illumination, None)[:, core] for s in steps])
    i, j = scipy.spatial.cKDTree(sample.fibrelets.centres).query_pairs(6e-6, output_type="ndarray").T
    found, true = (f[..., i] * f[..., j].conj() for f in (sample.fields + calibration.reference, true))
    assert np.linalg.norm(found - true) < 0.06 * np.linalg.norm(true)


def test_the_bench_of_the_demo_is_not_what_the_recovery_believes():
    scene = demo.demo_scene(0)
    assert scene.focus_error
    assert scene.step_error
    assert scene.sample_oversampling > 1


def test_the_command_explains_itself():
    shown = CliRunner().invoke(main, ["demo", "--help"])
    assert shown.exit_code == 0
    assert "Example: polinfer demo" in shown.output
    assert "--seed" in shown.output
    assert CliRunner().invoke(main, ["demo", "--seed", "-1"]).exit_code == 2
