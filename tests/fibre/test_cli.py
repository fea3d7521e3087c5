"""The commands go from captured frames to Jones data, as the library does, and mistakes end in one line."""

import numpy as np
import pytest
import scipy.spatial
from click.testing import CliRunner

from fibre import (
    BasisPursuit,
    CalibrationFields,
    ForwardInverse,
    RecordingFields,
    Ridge,
    WeightedSum,
    load,
    reconstruct,
    recover,
    save,
)
from polinfer.cli import main


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_frames_become_jones_data_by_four_commands(bench, tmp_path):
    calibration, sample = tmp_path / "calibration.nc", tmp_path / "sample.nc"
    save(bench.calibration, calibration)
    save(bench.recording, sample)
    fields, inverse = tmp_path / "calibration-fields.nc", tmp_path / "inverse.nc"
    sample_fields, measurement = tmp_path / "sample-fields.nc", tmp_path / "measurement.nc"
    for arguments in (
        ("retrieve", calibration, fields, "--iterations", 60),
        ("recover", fields, inverse, "--window", 30),
        ("retrieve", sample, sample_fields, "--fibrelets", fields, "--iterations", 60),
        ("reconstruct", inverse, sample_fields, measurement),
    ):
        result = run(*arguments)
        assert result.exit_code == 0, result.output
        assert "wrote" in result.output
    assert "(4, 4) points, 3 states" in result.output
    found = load(fields)
    assert isinstance(found, CalibrationFields)
    assert isinstance(load(sample_fields), RecordingFields)
    # the calibration has found its own fibrelets: those that were lit, each where it is
    distance, core = scipy.spatial.cKDTree(bench.scene.bundle.centres).query(found.fibrelets.centres)
    assert distance.max() < 0.5e-6
    assert len(set(core)) == len(core) > 25
    assert found.fibrelets.mode_radius.mean() == pytest.approx(1.6e-6, rel=0.03)
    expected = reconstruct(recover(found, ForwardInverse(window=30e-6)), load(sample_fields))
    np.testing.assert_allclose(load(measurement).response, expected.response, rtol=1e-9)
    np.testing.assert_allclose(load(measurement).sigma, expected.sigma, rtol=1e-9)


@pytest.mark.parametrize("method", ["modal", pytest.param("accelerated", marks=pytest.mark.slow)])
def test_other_methods_of_retrieval_see_the_same_fields(bench, tmp_path, method):
    """From 8-bit frames of the bench, through fibrelets that were found in them."""
    calibration, out = save(bench.calibration, tmp_path / "calibration.nc"), tmp_path / "fields.nc"
    known = save(bench.calibration_fields, tmp_path / "known.nc")
    kept = tmp_path / "kept"
    arguments = ("retrieve", calibration, out, "--method", method, "--fibrelets", known, "--resume", kept)
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    found, usual = load(out), bench.calibration_fields
    assert not found.status.any()
    for one, other in zip(found.fields, usual.fields, strict=True):  # modulo the piston of the reference spot
        turned = one * np.exp(1j * np.angle(np.vdot(one, other)))
        assert np.linalg.norm(turned - other) < 0.03 * np.linalg.norm(other)
    # all captures are in the folder: the second time none is retrieved
    again = run(*arguments, "--overwrite")
    assert again.exit_code == 0, again.output
    np.testing.assert_array_equal(load(out).fields, found.fields)
    other = run("retrieve", calibration, out, "--fibrelets", known, "--resume", kept, "--overwrite")
    assert other.exit_code == 2
    assert "belongs to another record, method" in other.output


def test_methods_of_recovery_are_those_of_the_library(bench, tmp_path):
    fields = save(bench.calibration_fields, tmp_path / "fields.nc")
    for name, method in {"ridge": Ridge(), "basis-pursuit": BasisPursuit(), "weighted-sum": WeightedSum()}.items():
        result = run("recover", fields, tmp_path / f"{name}.nc", "--method", name, "--resume", tmp_path / name)
        assert result.exit_code == 0, result.output
        expected = recover(bench.calibration_fields, method).matrix.toarray()
        np.testing.assert_allclose(load(tmp_path / f"{name}.nc").matrix.toarray(), expected, rtol=1e-6, atol=1e-12)
    other = run("recover", fields, tmp_path / "other.nc", "--resume", tmp_path / "ridge")
    assert other.exit_code == 2
    assert "belongs to another calibration or method" in other.output


@pytest.mark.parametrize("command", ["retrieve", "recover", "reconstruct"])
def test_every_command_has_help_with_an_example(command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert f"Example: polinfer {command}" in result.output
    assert command in run("--help").output


def test_mistakes_end_in_one_line_and_exit_code_2(bench, tmp_path):
    fields = save(bench.calibration_fields, tmp_path / "fields.nc")
    sample = save(bench.recording, tmp_path / "sample.nc")
    broken, out = tmp_path / "broken.nc", tmp_path / "out.nc"
    broken.write_bytes(b"nothing")
    cases = [
        (("retrieve", tmp_path / "missing.nc", out), "does not exist"),
        (("retrieve", broken, out), "cannot be read"),
        (("retrieve", fields, out), "holds a CalibrationFields, not a Calibration or Recording"),
        (("retrieve", sample, out), "fibrelets must be given"),
        (("retrieve", sample, out, "--fibrelets", sample), "holds a Recording, not a CalibrationFields"),
        (("retrieve", sample, out, "--fibrelets", fields, "--iterations", 0), "iterations must be >= 1"),
        (("recover", sample, out), "holds a Recording, not a CalibrationFields"),
        (("recover", fields, out, "--window", -1), "window must be > 0"),
        (("recover", fields, fields), "exists"),
        (("reconstruct", fields, fields, out), "holds a CalibrationFields, not a Inverse"),
    ]
    for arguments, text in cases:
        result = run(*arguments)
        assert result.exit_code == 2, (arguments, result.output)
        assert text in result.output
        assert "Traceback" not in result.output
    assert not out.exists()
