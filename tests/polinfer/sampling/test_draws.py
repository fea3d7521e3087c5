"""Draws can be kept, labelled, handed to others, drawn, and asked whether the data look like the model's."""

import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import polinfer
from polinfer import ComplexGain, InferredNoise, Measurement, Model, Parameters, PhaseGain, Status, Window
from polinfer.plots import plot_summary
from polinfer.sampling.corner import plot_pixel
from polinfer.sampling.draws import Draws
from polinfer.sampling.export import groups
from polinfer.sampling.predictive import Predictive
from polinfer.sampling.summaries import Summary
from tests.polinfer.sampling.made import around, draws_of

FULL = Model(gain=ComplexGain(1.0), noise=InferredNoise(2.0, 0.1, "pixel"), neighbours=Window(1, 3))


def full(shape=(2, 3), dtype=float):
    """Draws with a gain, a sigma and a masked pixel."""
    rng = np.random.default_rng(1)
    gain = (1 + 0.1 * rng.normal(size=(4, 250, *shape))) * np.exp(0.1j * rng.normal(size=(4, 250, *shape)))
    status = np.zeros(shape, np.int32)
    status[(0,) * len(shape)] = Status.MASKED if status.size > 1 else 0
    lost = status == Status.MASKED
    parameters = Parameters(*(np.where(lost, np.nan, x).astype(dtype) for x in around(shape)))
    gain = np.where(lost, np.nan, gain).astype(np.result_type(dtype, np.complex64))
    sigma = np.where(lost, np.nan, np.exp(0.1 * rng.normal(size=(4, 250, *shape)))).astype(dtype)
    return draws_of(FULL, shape, parameters=parameters, gain=gain, sigma=sigma, status=status)


def same(a, b):
    assert type(a) is type(b)
    if isinstance(a, Parameters | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, Draws | Summary | Predictive | Measurement):
        for field in fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b


RECORDS = {
    "draws": lambda: full(),
    "single precision": lambda: full(dtype=np.float32),
    "one pixel, nothing else": lambda: draws_of(count=20),
    "summary": lambda: full().summary(0.9),
    "check": lambda: draws_of(shape=(2,)).predictive(1, 10),
    "check with responses": lambda: draws_of(shape=(2, 3)).predictive(1, 10, responses=True),
}


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
@pytest.mark.parametrize("name", RECORDS)
def test_round_trip(name, ending, tmp_path):
    record = RECORDS[name]()
    same(polinfer.load(polinfer.save(record, tmp_path / f"record{ending}")), record)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"parameters": around((3, 2))}, r"parameters must have shape \(chain, draw, \*\(2, 3\)\)"),
        ({"parameters": around((2, 3), count=3)}, "with at least 4 draws"),
        ({"parameters": around((2, 3))._replace(retardance=np.zeros(3))}, "parameters.retardance must have shape"),
        ({"status": np.zeros(3)}, r"status must have shape \(2, 3\), got \(3,\)"),
        ({"gain": np.ones((4, 250))}, "gain must have shape"),
        ({"log_evidence": np.zeros(())}, "log_evidence must have shape"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(change, text):
    with pytest.raises(ValueError, match=text):
        replace(full(), **change)


def test_draws_of_something_else_are_refused():
    with pytest.raises(TypeError, match="model must be Model"):
        replace(full(), model=None)
    with pytest.raises(TypeError, match="parameters must be Parameters"):
        replace(full(), parameters=np.zeros((5, 4, 10, 2, 3)))


def test_a_dataset_has_names_coordinates_and_units():
    dataset = full().to_dataset()
    assert dataset["parameters.retardance"].dims == ("chain", "draw", "y", "x")
    assert dataset["parameters.retardance"].attrs["units"] == "rad"
    assert dataset["parameters.diattenuation"].attrs["units"] == "1"
    assert dataset["gain.real"].dims == dataset["sigma"].dims == ("chain", "draw", "y", "x")
    for axis, size in (("chain", 4), ("draw", 250), ("y", 2), ("x", 3)):
        np.testing.assert_array_equal(dataset.coords[axis], np.arange(size))
    flat = draws_of(shape=(5,)).to_dataset()["parameters.retardance"]
    assert flat.dims == ("chain", "draw", "pixel_0")
    assert full().summary().to_dataset()["high.retardance"].dims == ("y", "x")


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_what_is_handed_to_others_are_the_free_parameters_and_the_data(shape):
    model = Model(gain=PhaseGain(), fixed={"retardance_angle": 0.0})
    draws = draws_of(model, shape, gain=np.ones((4, 250, *shape)) * np.exp(0.3j))
    found = groups(draws)
    posterior, observed = found["posterior"], found["observed_data"]
    # neither the fixed parameter nor the one that drops out
    assert set(posterior) == {"diattenuation", "diattenuation_angle", "retardance", "gain_real", "gain_imag"}
    np.testing.assert_array_equal(posterior["retardance"], draws.parameters.retardance)
    np.testing.assert_array_equal(posterior["gain_imag"], draws.gain.imag)
    assert posterior["retardance"].attrs["units"] == "rad"
    assert posterior["retardance"].dims == ("chain", "draw", "y", "x")[: 2 + len(shape)]
    np.testing.assert_array_equal(observed["response_real"], draws.measurement.response.real)
    assert set(groups(full())["posterior"]) == {*Parameters._fields, "gain_real", "gain_imag", "sigma"}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_arviz_understands_the_draws(shape):
    arviz = pytest.importorskip("arviz")
    model = Model(fixed={"retardance_angle": 0.0})
    draws = draws_of(model, shape, gain=np.ones((4, 250, *shape)) * np.exp(0.3j))
    data = draws.to_arviz()
    posterior = data["posterior"]
    names = {"diattenuation", "diattenuation_angle", "retardance", "gain_real", "gain_imag"}
    assert set(posterior.data_vars) == names  # neither the fixed parameter nor the one that drops out
    np.testing.assert_array_equal(posterior["retardance"].values, draws.parameters.retardance)
    assert data["observed_data"]["response_real"].shape == (*shape, 2, 2)
    table = arviz.summary(data, var_names=["retardance", "diattenuation"])
    assert len(table) == 2 * int(np.prod(shape))
    assert float(np.asarray(arviz.ess(data, var_names="retardance")["retardance"]).min()) > 500


def test_without_arviz_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ImportError, match=r"polinfer\[arviz\]"):
        draws_of().to_arviz()


def noisy(model, truth, sigma, gain=1.0, states=None, seed=3, **kwargs):
    """Data of known parameters in every pixel, and draws that know them, too."""
    states = np.eye(2) if states is None else states
    rng = np.random.default_rng(seed)
    clean = gain * (np.asarray(model.jones(truth)) @ states)
    noise = rng.normal(size=(2, *clean.shape)) * np.reshape(sigma, (-1, 1, 1)) / 2**0.5
    told = kwargs.pop("told", sigma)
    return Measurement(states, clean + noise[0] + 1j * noise[1], told, **kwargs)


def exact(model, measurement, truth, gain=None, sigma=None):
    count = (2, 20, *measurement.shape)
    spread = Parameters(*(np.broadcast_to(x, count).copy() for x in truth))
    gain, sigma = (None if x is None else np.broadcast_to(x, count).copy() for x in (gain, sigma))
    return draws_of(model, measurement.shape, parameters=spread, measurement=measurement, gain=gain, sigma=sigma)


TRUTH = Parameters(*np.tile(np.array([0.3, 0.5, 1.2, 0.4, 0.7])[:, None], 400))


def test_at_the_true_parameters_p_values_are_uniform_and_chi_square_has_its_mean():
    """The only case in which a predictive p-value is uniform: nothing was fitted. 400 pixels, Kolmogorov-Smirnov."""
    from scipy.stats import kstest

    states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    check = exact(Model(), noisy(Model(), TRUTH, 0.1, states=states), TRUTH).predictive(1)
    assert np.all(check.degrees_of_freedom == 12)
    assert kstest(check.p_value, "uniform").pvalue > 1e-3
    # the mean of 400 has a standard error of sqrt(24 / 400)
    assert abs(check.chi_square.mean() - 12) < 4 * (24 / 400) ** 0.5


def test_the_discrepancy_is_that_of_the_definition_with_weights_gain_and_sigma():
    rng = np.random.default_rng(4)
    weight = np.array([1.0, 4.0, 0.0])
    states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    model = Model(gain=ComplexGain(1.0), noise=InferredNoise(2.0, 0.1, "pixel"))
    truth = Parameters(*(x[:3] for x in TRUTH))
    data = noisy(model, truth, 0.1, 1.3j, states, weight=weight, told=None)
    shape = (2, 10, 3)
    parameters = around((3,), chains=2, count=10)
    gain = 1.3j + 0.1 * rng.normal(size=shape)
    sigma = np.exp(0.1 * rng.normal(size=shape)) * 0.1
    draws = draws_of(model, (3,), parameters=parameters, measurement=data, gain=gain, sigma=sigma)
    check = draws.predictive(1, draws=1000)
    seen = gain[..., None, None] * (np.asarray(model.jones(parameters)) @ states)
    square = np.sum(weight * np.abs(data.response - seen) ** 2, axis=(-1, -2))
    np.testing.assert_allclose(check.chi_square, (2 * square / sigma**2).mean(axis=(0, 1)), rtol=1e-4)
    assert check.degrees_of_freedom.tolist() == [8, 8, 8]
    # the tail probability, from replicated data instead of the formula
    made = rng.normal(size=(2000, *shape, 2, 2, 2))
    replicated = np.sum(made**2, axis=(-1, -2, -3))
    found = (replicated >= 2 * square / sigma**2).mean(axis=(0, 1, 2))
    np.testing.assert_allclose(check.p_value, found, atol=4 * 0.5 / 2000**0.5)


def test_a_sigma_that_is_too_small_or_too_large_shows():
    data = noisy(Model(), TRUTH, 0.1)
    for told, low, high in ((0.05, 0, 1e-2), (0.1, 0.3, 0.7), (0.3, 0.99, 1)):
        check = exact(Model(), replace(data, sigma=np.array(told)), TRUTH).predictive(1)
        assert low <= np.median(check.p_value) <= high


def test_predicted_responses_have_the_mean_and_the_noise_of_the_model():
    weight = np.array([1.0, 4.0, 0.0])
    states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    model = Model(gain=PhaseGain())
    data = noisy(model, TRUTH, 0.1, 1j, states, weight=weight, mask=np.arange(400) > 0)
    status = np.where(np.arange(400) > 0, 0, int(Status.MASKED))
    draws = replace(exact(model, data, TRUTH, gain=1j), status=status.astype(np.int32))
    check = draws.predictive(5, draws=40, responses=True)
    assert check.response.shape == (40, 400, 2, 3)
    assert np.isnan(check.response[:, 0]).all()
    assert np.isnan(check.response[..., 2]).all()
    error = check.response[:, 1:] - 1j * (np.asarray(model.jones(TRUTH)) @ states)[1:]
    # 31 920 complex numbers for each state
    assert np.mean(np.abs(error[..., 0]) ** 2) == pytest.approx(0.01, rel=0.03)
    assert np.mean(np.abs(error[..., 1]) ** 2) == pytest.approx(0.0025, rel=0.03)
    assert abs(np.mean(error[..., 0])) < 4 * 0.1 / 31_920**0.5
    again = draws.predictive(check.seed, draws=40, responses=True)
    np.testing.assert_array_equal(again.response, check.response)
    fresh = draws.predictive(draws=2, responses=True)
    np.testing.assert_array_equal(draws.predictive(fresh.seed, 2, True).response, fresh.response)
    assert draws.predictive(1).response is None


def test_checks_have_no_answer_where_there_are_no_draws_and_a_trivial_one_where_there_are_no_data():
    truth = Parameters(*(x[:3] for x in TRUTH))
    weight = np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    data = noisy(Model(), truth, 0.1, weight=weight)
    draws = replace(exact(Model(), data, truth), status=np.array([0, 2, 0], np.int32))
    check = draws.predictive(1)
    assert np.isnan(check.p_value).tolist() == np.isnan(check.chi_square).tolist() == [False, True, False]
    assert check.p_value[2] == 1
    assert check.chi_square[2] == 0
    assert check.degrees_of_freedom.tolist() == [8, 8, 0]


def test_checks_refuse_draws_that_lack_the_nuisances():
    with pytest.raises(ValueError, match="draws have no gain"):
        draws_of(Model(gain=PhaseGain())).predictive(1)
    unknown = Model(noise=InferredNoise(2.0, 0.1, "pixel"))
    with pytest.raises(ValueError, match="draws have no sigma"):
        draws_of(unknown, measurement=Measurement(np.eye(2), np.eye(2))).predictive(1)
    with pytest.raises(ValueError, match="draws must be >= 1"):
        draws_of().predictive(1, draws=0)


@pytest.mark.parametrize("shape", [(), (7,), (3, 4), (2, 3, 4)])
def test_maps_show_the_summary(shape, tmp_path):
    draws = draws_of(shape=shape, count=20)
    figure = draws.plot(smooth=True, pixel_size=9e-6)
    titled = {axes.get_title(): axes for axes in figure.axes if axes.get_title()}
    assert {"largest R-hat − 1", "fewest effective draws", "retardance (°)", "± standard deviation (°)"} <= set(titled)
    shown = titled["retardance (°)"].images[0]
    assert shown.get_clim() == (-180, 180)
    assert shown.get_cmap().name == "colour_circle"
    figure.savefig(tmp_path / "maps.png", dpi=30)


def test_maps_have_no_colour_where_there_are_no_draws():
    draws = full()
    axes = {axes.get_title(): axes for axes in draws.plot().axes}
    for title in ("largest R-hat − 1", "fewest effective draws", "retardance (°)"):
        np.testing.assert_array_equal(np.ma.getmaskarray(axes[title].images[0].get_array()), draws.status != 0)
    expected = np.degrees(draws.summary().mean.circularity)[draws.status == 0]
    np.testing.assert_allclose(axes["circularity (°)"].images[0].get_array().compressed(), expected)
    with pytest.raises(TypeError, match="summary must be Summary"):
        plot_summary(draws)


def test_the_joint_posterior_of_a_pixel_is_not_cut_by_the_wrap(tmp_path):
    centre = (0.3, np.pi / 2, np.pi, -np.pi / 2, np.pi)
    wrapped = around((2, 3), centre=centre)
    wrapped = wrapped._replace(retardance=np.angle(np.exp(1j * wrapped.retardance)))
    figure = draws_of(shape=(2, 3), parameters=wrapped).plot(pixel=(1, -1))
    assert len(figure.axes) == 15
    corner = next(axes for axes in figure.axes if axes.get_ylabel().startswith("retardance (°)"))
    low, high = corner.get_ylim()
    assert high - low < 45
    # ticks are values of the range, on both sides of the wrap
    labels = [float(corner.yaxis.get_major_formatter()(x).replace("−", "-")) for x in (175.0, 185.0)]
    assert labels == [175.0, -175.0]
    figure.savefig(tmp_path / "corner.png", dpi=30)


def test_the_joint_posterior_shows_gain_and_sigma_and_no_fixed_parameter():
    assert len(plot_pixel(full(), (1, 1)).axes) == 8 * 9 // 2
    model = Model(gain=PhaseGain(), fixed={"retardance_angle": 0.0})
    draws = draws_of(model, gain=np.exp(0.1j * np.random.default_rng(1).normal(size=(4, 250))))
    assert len(plot_pixel(draws, ()).axes) == 4 * 5 // 2  # three parameters and the phase


@pytest.mark.parametrize("spread", [0.1, 1e-5])
def test_no_label_of_the_joint_posterior_is_cut_by_the_margin(spread):
    """The margins are fixed: with narrow clouds the ticks have many digits."""
    generator = np.random.default_rng(2)
    values = Parameters(*generator.normal(0.5, spread, (5, 4, 250)))
    gain, sigma = 1e3 * (1j + generator.normal(0.5, spread, (4, 250))), generator.normal(1e-5, 5e-7, (4, 250))
    figure = plot_pixel(draws_of(Model(gain=ComplexGain(1e3)), parameters=values, gain=gain, sigma=sigma), ())
    box = figure.get_tightbbox(FigureCanvasAgg(figure).get_renderer())  # inches
    assert min(box.x0, box.y0) >= 0
    assert max(box.x1, box.y1) <= figure.get_figwidth() == figure.get_figheight()


@pytest.mark.parametrize(
    ("pixel", "text"), [((0,), "pixel must be a tuple of 2"), ([0, 0], "pixel must be a tuple"), ((0, 3), "pixel"),
                        ((0, 0), "has no draws")],
)  # fmt: skip
def test_pixels_that_cannot_be_shown_are_named(pixel, text):
    with pytest.raises(ValueError, match=text):
        full().plot(pixel=pixel)
