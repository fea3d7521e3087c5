"""The command compare prints the table of the library, and mistakes end in one line."""

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from polinfer import Model, Parameters, PolariserFirst
from polinfer.cli.comparison import compare_command
from polinfer.comparison import compare

ORDERINGS = {"retarder_first": Model(), "polariser_first": Model(PolariserFirst())}


def run(*arguments):
    return CliRunner().invoke(compare_command, [str(a) for a in arguments])


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(1)
    truth = Parameters(np.full((4, 16), 0.4), *(rng.uniform(-1.5, 1.5, (4, 4, 16))))
    states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    data = polinfer.simulate(Model(PolariserFirst()), truth, states, 0.05, rng=1)
    fits = {name: polinfer.fit(model, data) for name, model in ORDERINGS.items()}
    paths = [polinfer.save(fit, tmp_path / f"{name}.nc") for name, fit in fits.items()]
    return polinfer.save(data, tmp_path / "data.nc"), *paths, compare(fits).table()


def test_saved_fits_and_a_measurement_give_the_table_of_the_library(files, tmp_path):
    data, first, second, table = files
    result = run(first, second, "--picture", tmp_path / "evidence.png")
    assert result.exit_code == 0, result.output
    assert result.output.strip() == table
    assert "verdict: polariser_first" in table
    assert (tmp_path / "evidence.png").read_bytes()[:4] == b"\x89PNG"
    both = [line.split()[:5] for line in table.splitlines() if line.startswith("scene")]
    fitted = run(data)
    assert fitted.exit_code == 0, fitted.output
    three = [line.split()[:5] for line in fitted.output.splitlines() if line.startswith("scene")]
    assert three[:2] == both
    assert three[2][1] == "no_diattenuation"
    assert "verdict: polariser_first" in fitted.output
    assert "no_diattenuation" not in run(data, "--fix", "diattenuation=0.4").output


@pytest.mark.parametrize(("arguments", "message"), [
    (("first",), "two or more results"),
    (("first", "first"), "twice"),
    (("first", "data"), "holds a Measurement"),
    (("first", "second", "--gain", "phase"), "--gain is only for a measurement"),
    (("data", "--ordering", "retarder_first"), "leave out --ordering"),
])  # fmt: skip
def test_mistakes_end_in_one_line(files, arguments, message):
    paths = dict(zip(("data", "first", "second"), files, strict=False))
    result = run(*(paths.get(a, a) for a in arguments))
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())
