"""The command line does what the library does, and mistakes end in one line."""

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from polinfer import ComplexGain, Fit, Measurement, Model, Parameters, PolariserFirst, phantoms
from polinfer.cli import main
from tests.oracles import jones as oracle
from tests.polinfer.scenes import UNBALANCED

# with the states of the measurement below a model that other tests fit too: code is compiled for each
SHARED = ("--ordering", "polariser_first", "--gain", "complex", "--gain-scale", "0.8")


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture
def measurement(tmp_path):
    scene = phantoms.lesion((4, 5), rng=1)
    data = polinfer.simulate(Model(gain=ComplexGain(1.0)), scene.parameters, UNBALANCED, 0.03, rng=1, gain=scene.gain)
    return polinfer.save(data, tmp_path / "data.nc")


def test_fit_writes_the_same_result_as_the_library_and_a_picture(measurement, tmp_path):
    out, picture = tmp_path / "fit.nc", tmp_path / "map.png"
    result = run("fit", measurement, out, *SHARED,
                 "--picture", picture, "--smooth-gauge", "--pixel-size", "9", "--no-progress")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "20 pixels" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    expected = polinfer.fit(Model(PolariserFirst(), gain=ComplexGain(0.8)), polinfer.load(measurement))
    np.testing.assert_array_equal(polinfer.load(out).parameters.retardance, expected.parameters.retardance)


def test_fit_from_disk_writes_the_same_result(measurement, tmp_path):
    source, out = polinfer.save(polinfer.load(measurement), tmp_path / "data.zarr"), tmp_path / "fit.zarr"
    result = run("fit", source, out, *SHARED, "--pixels-at-a-time", "10", "--no-progress")
    assert result.exit_code == 0, result.output
    expected = polinfer.fit(Model(PolariserFirst(), gain=ComplexGain(0.8)), polinfer.load(measurement))
    found = polinfer.load(out)
    np.testing.assert_allclose(found.parameters.retardance, expected.parameters.retardance, rtol=1e-6)
    for options in (("--picture", tmp_path / "a.png"), ("--tilt", "plane")):
        refused = run("fit", source, tmp_path / "b.zarr", "--pixels-at-a-time", "10", *options)
        assert refused.exit_code == 2
        assert "pixels" in refused.output


def test_sample_writes_the_draws_of_the_library_and_says_what_they_hold(measurement, tmp_path):
    out, picture = tmp_path / "draws.nc", tmp_path / "posterior.png"
    sizes = ("--chains", "2", "--draws", "40", "--seed", "3")
    result = run("sample", measurement, out, *SHARED, *sizes, "--picture", picture, "--no-progress")
    assert result.exit_code == 0, result.output
    assert "seed 3; 2 chains of 40 draws; 20 pixels" in result.output
    assert "log evidence: sum" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    model = Model(PolariserFirst(), gain=ComplexGain(0.8))
    expected = polinfer.sample(model, polinfer.load(measurement), chains=2, draws=40, rng=3)
    found = polinfer.load(out)
    np.testing.assert_array_equal(found.parameters.retardance, expected.parameters.retardance)
    np.testing.assert_array_equal(found.log_evidence, expected.log_evidence)
    again = run("sample", measurement, out, *SHARED)
    assert again.exit_code != 0
    assert "exists" in again.output


def declared(monkeypatch, measurement, out, *options):
    """The model and the data that the command hands to ``fit``; nothing is fitted."""
    seen = []

    def stand_in(model, data, progress):
        seen.extend([model, data])
        raise ValueError("enough")

    monkeypatch.setattr("polinfer.fitting.fit", stand_in)
    result = run("fit", measurement, out, *options)
    assert "enough" in result.output, result.output
    return seen


def test_options_declare_the_model_in_degrees_and_fit_gets_it(monkeypatch, measurement, tmp_path):
    out = tmp_path / "out.nc"
    model, data = declared(monkeypatch, measurement, out, "--gain", "phase", "--window", "3", "5", "--fix",
                           "diattenuation=0.25", "--fix", "retardance_angle=-30")  # fmt: skip
    expected = Model(
        gain=polinfer.PhaseGain(),
        neighbours=polinfer.Window(3, 5),
        fixed={"diattenuation": 0.25, "retardance_angle": -np.pi / 6},
    )
    assert model == expected
    assert data.sigma is not None
    model, _ = declared(monkeypatch, measurement, out, "--fix", "retardance=180", "--ordering", "polariser_first")
    assert model == Model(PolariserFirst(), fixed={"retardance": np.pi})
    noise = ("--infer-noise", "frame", "--noise-shape", "2", "--noise-scale", "0.002")
    model, data = declared(monkeypatch, measurement, out, *noise)
    assert model == Model(noise=polinfer.InferredNoise(2.0, 0.002, "frame"))
    assert data.sigma is None
    assert "sigma of the measurement is not used" in run("fit", measurement, out, *noise).output


ANGLES = Parameters(
    diattenuation=np.array([0.2, -0.6, 0.7, np.nan]),
    diattenuation_angle=np.array([85.0, -88.0, 89.0, np.nan]),  # on both sides of 90
    retardance=np.array([170.0, -175.0, -178.0, np.nan]),
    retardance_angle=np.array([40.0, 42.0, 70.0, np.nan]),
    circularity=np.array([-20.0, 10.0, 30.0, np.nan]),
)


def fit_of_angles(model, data, progress):
    """Stands in for ``fit``: ANGLES in degrees, widths of 0.1, three pixels in order."""
    radians = Parameters(ANGLES[0], *(np.radians(x) for x in ANGLES[1:]))
    flat = np.ones(4)
    return Fit(model, radians, Parameters(*(0.1 * flat,) * 5), np.ones((4, 5, 5)), flat, flat, flat, None,
               np.array([0, 0, 0, 1]), flat, flat)  # fmt: skip


@pytest.mark.parametrize("gain", ["none", "phase"])
def test_angles_are_summarised_across_the_wrap_and_a_bounded_retardance_is_not(
    gain, monkeypatch, measurement, tmp_path
):
    monkeypatch.setattr("polinfer.fitting.fit", fit_of_angles)
    result = run("fit", measurement, tmp_path / "out.nc", "--gain", gain)
    assert result.exit_code == 0, result.output
    told = dict(line.strip().split(": ") for line in result.output.splitlines() if "standard deviation" in line)
    grid = np.linspace(-180, 180, 36001)
    for name, period in (("diattenuation_angle", 180), ("retardance", 360), ("retardance_angle", 180),
                         ("circularity", 360)):  # fmt: skip
        if gain == "none" and name == "retardance":
            continue
        # the circular mean is the angle from which the mean cosine is largest
        values = getattr(ANGLES, name)[:3]
        best = grid[np.cos(2 * np.pi * (grid[:, None] - values) / period).sum(axis=1).argmax()]
        kind, number = told[name].split(", ")[0].rsplit(" ", 1)
        assert kind == "circular mean"
        assert abs((float(number) - best + period / 2) % period - period / 2) < 0.06
        assert told[name].endswith("median standard deviation 5.7 degrees")
    assert told["diattenuation"] == "median 0.2, median standard deviation 0.1"
    if gain == "none":
        assert told["retardance"].startswith("median -175,")


@pytest.mark.parametrize(
    ("options", "smooth", "size"), [([], False, None), (["--smooth-gauge", "--pixel-size", "9"], True, 9e-6)]
)
def test_the_picture_has_the_gauge_and_the_scale_that_are_asked_for(
    options, smooth, size, monkeypatch, measurement, tmp_path
):
    from matplotlib.figure import Figure

    seen = []

    def draw(fit, smooth, pixel_size):
        seen.append((fit.status.tolist(), smooth, pixel_size))
        return Figure()

    monkeypatch.setattr("polinfer.fitting.fit", fit_of_angles)
    monkeypatch.setattr("polinfer.plots.plot_fit", draw)
    result = run("fit", measurement, tmp_path / "out.nc", "--picture", tmp_path / "map.png", *options)
    assert result.exit_code == 0, result.output
    assert seen == [([0, 0, 0, 1], smooth, size if size is None else pytest.approx(size))]


@pytest.mark.parametrize(
    ("options", "states", "ordering"),
    [
        (["--gain", "none", "--jones"], 2, "retarder_first"),
        (["--gain", "phase"], 3, "retarder_first"),
        (["--gain", "complex", "--states", "5", "--ordering", "polariser_first"], 5, "polariser_first"),
    ],
)
def test_simulate_writes_what_its_truth_says_and_noise_of_its_sigma(options, states, ordering, tmp_path):
    out, truth = tmp_path / "data.nc", tmp_path / "truth.zarr"
    result = run("simulate", out, "--shape", "7", "9", "--sigma", "0.05", "--seed", "4", "--truth", truth, *options)
    assert result.exit_code == 0, result.output
    assert f"7 x 9 pixels, {states} states, sigma 0.05, seed 4" in result.output
    data, scene = polinfer.load(out), polinfer.load(truth)
    assert data.shape == (7, 9)
    assert (data.sigma == 0.05).all()
    power = data.illumination @ data.illumination.conj().T
    np.testing.assert_allclose(power, np.eye(2) * states / 2, atol=1e-12)
    noise = np.empty_like(data.response)
    for pixel in np.ndindex(7, 9):
        matrix = oracle.jones([float(x[pixel]) for x in scene.parameters], ordering)
        noise[pixel] = data.response[pixel] - scene.gain[pixel] * (matrix @ data.illumination)
    # 63 pixels of 2 components: the mean square has a relative standard deviation of 1 / sqrt(126 states)
    assert np.mean(abs(noise) ** 2) == pytest.approx(0.05**2, rel=5 / np.sqrt(126 * states))
    size, phase = abs(scene.gain), np.angle(scene.gain)
    assert (phase.std() > 0.1) == ("none" not in options)
    assert (size.std() > 0.02) == ("complex" in options)
    np.testing.assert_allclose(size.mean(), 0.8 if "complex" in options else 1, atol=0.1)


def test_simulate_repeats_itself_by_seed_and_tells_a_drawn_one(tmp_path):
    first, again, other = (tmp_path / f"{name}.nc" for name in ("first", "again", "other"))
    told = run("simulate", first, "--shape", "2", "3").output.split()[-1]
    for path, seed in ((again, told), (other, str(int(told) + 1))):
        assert run("simulate", path, "--shape", "2", "3", "--seed", seed).exit_code == 0
    response = [polinfer.load(path).response for path in (first, again, other)]
    np.testing.assert_array_equal(response[0], response[1])
    assert np.all(response[0] != response[2])


def test_help_and_version_are_there_with_an_example():
    for command in ("fit", "simulate"):
        assert f"Example: polinfer {command}" in run(command, "--help").output
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
        (("fit", measurement, tmp_path / "out.txt", "--no-progress", *SHARED), "must end in .nc"),
        (("fit", measurement, measurement), "exists"),
        (("fit", measurement, out, "--gain", "complex"), "needs --gain-scale"),
        (("fit", measurement, out, "--gain", "complex", "--gain-scale", "-1"), "scale must be > 0"),
        (("fit", measurement, out, "--gain-scale", "1"), "only for --gain complex"),
        (("fit", measurement, out, "--fix", "retardance=270"), "must be from -180 to 180 degrees"),
        (("fit", measurement, out, "--fix", "diattenuation=2"), "must be from -1 to 1."),
        (("fit", measurement, out, "--fix", "size=1"), "the parameters are diattenuation,"),
        (("fit", measurement, out, "--fix", "retardance"), "is no number"),
        (("fit", measurement, out, "--fix", "retardance=1", "--fix", "retardance=2"), "twice"),
        (("fit", measurement, out, "--infer-noise", "pixel"), "needs --noise-shape and --noise-scale"),
        (("fit", measurement, out, "--noise-shape", "2"), "only for --infer-noise"),
        (("fit", measurement, out, "--window", "0", "3"), "must be"),
        (("fit", measurement, out, "--smooth-gauge"), "only for --picture"),
        (("fit", measurement, out, "--gain", "some"), "Invalid value for '--gain'"),
        (("fly",), "No such command"),
        (("simulate", out, "--sigma", "0"), "sigma must be > 0"),
        (("simulate", out, "--shape", "0", "3"), "Invalid value for '--shape'"),
        (("simulate", out, "--jones", "--states", "3"), "leave out --states"),
        (("simulate", out, "--truth", out), "is OUT"),
        (("simulate", measurement), "exists"),
        (("simulate", out, "--truth", measurement), "exists"),
        (("simulate", tmp_path / "out.txt"), "must end in .nc"),
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
