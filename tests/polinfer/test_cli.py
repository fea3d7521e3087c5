"""The command line does what the library does, and mistakes end in one line."""

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from polinfer import ComplexGain, Measurement, Model, PolariserFirst, phantoms
from polinfer.cli import main


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture
def measurement(tmp_path):
    scene = phantoms.lesion((4, 5), rng=1)
    data = polinfer.simulate(Model(gain=ComplexGain(1.0)), scene.parameters, np.eye(2), 0.03, rng=1, gain=scene.gain)
    return polinfer.save(data, tmp_path / "data.nc")


def test_fit_writes_the_same_result_as_the_library_and_a_picture(measurement, tmp_path):
    out, picture = tmp_path / "fit.nc", tmp_path / "map.png"
    result = run("fit", measurement, out, "--ordering", "polariser_first", "--gain", "complex", "--gain-scale", "1.0",
                 "--picture", picture, "--no-progress")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "20 pixels" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    expected = polinfer.fit(Model(PolariserFirst(), gain=ComplexGain(1.0)), polinfer.load(measurement))
    np.testing.assert_array_equal(polinfer.load(out).parameters.retardance, expected.parameters.retardance)


def test_help_and_version_are_there_with_an_example():
    assert "Example: polinfer fit" in run("fit", "--help").output
    assert "fit" in run("--help").output
    assert "0." in run("--version").output


def test_mistakes_end_in_one_line_and_exit_code_2(measurement, tmp_path):
    unknown_sigma = polinfer.save(Measurement(np.eye(2), np.eye(2)), tmp_path / "unknown.nc")
    scene = polinfer.save(phantoms.lesion((2, 2), rng=1), tmp_path / "scene.nc")
    broken = tmp_path / "broken.nc"
    broken.write_bytes(b"nothing")
    out = tmp_path / "out.nc"
    cases = [
        (("fit", tmp_path / "missing.nc", out), "does not exist"),
        (("fit", broken, out), "cannot be read"),
        (("fit", unknown_sigma, out), "sigma None"),
        (("fit", scene, out), "holds a Phantom, not a Measurement"),
        (("fit", measurement, tmp_path / "out.txt", "--no-progress"), "must end in .nc"),
        (("fit", measurement, measurement), "exists"),
        (("fit", measurement, out, "--gain", "complex"), "needs --gain-scale"),
        (("fit", measurement, out, "--gain", "complex", "--gain-scale", "-1"), "scale must be > 0"),
        (("fit", measurement, out, "--gain", "some"), "Invalid value for '--gain'"),
        (("fly",), "No such command"),
    ]
    for arguments, text in cases:
        result = run(*arguments)
        assert result.exit_code == 2, (arguments, result.output)
        assert text in result.output
        assert "Traceback" not in result.output
        assert isinstance(result.exception, SystemExit)


def test_importing_the_package_does_not_import_the_slow_ones():
    import subprocess
    import sys

    code = (
        "import sys, polinfer; "
        "print([m for m in ('matplotlib', 'xarray', 'emcee', 'scipy.stats', 'zarr', 'tqdm') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
