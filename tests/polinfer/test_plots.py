"""A fit of any shape can be drawn, its colours say what they mean, and no colour is where no answer is."""

from dataclasses import fields, replace

import numpy as np
import pytest

from polinfer import ComplexGain, Measurement, Model, Parameters, Status, fit, simulate, smooth_gauge
from polinfer.plots import colour_circle, plot_fit

PARAMETERS = dict(
    zip(
        ("diattenuation", "diattenuation angle (°)", "retardance (°)", "retardance angle (°)", "circularity (°)"),
        Parameters._fields,
        strict=True,
    )
)
ANGLES = {"diattenuation angle (°)": 90, "retardance (°)": 180, "retardance angle (°)": 90, "circularity (°)": 180}


def maps(figure):
    """Axes of the maps by parameter, those of their uncertainty, and the rest by title."""
    titled = [axes for axes in figure.axes if axes.get_title()]
    values = {axes.get_title(): axes for axes in titled if not axes.get_title().startswith("±")}
    below = [axes for axes in titled if axes.get_title().startswith("±")]
    return values, dict(zip(PARAMETERS, below, strict=True))


def spread(result, shape):
    """A fit of pixel shape ``shape``, every pixel the first one of ``result``."""

    def cut(values):
        pixel = np.asarray(values)[0, 0]
        return np.broadcast_to(pixel, shape + pixel.shape)

    arrays = {f.name: getattr(result, f.name) for f in fields(result)}
    parts = {name: Parameters(*map(cut, value)) for name, value in arrays.items() if isinstance(value, Parameters)}
    parts |= {name: cut(value) for name, value in arrays.items() if isinstance(value, np.ndarray)}
    return replace(result, **parts)


@pytest.fixture(scope="module")
def result():
    """A masked pixel, one that is not finite, axes that are not identified, D of both signs."""
    x = np.linspace(-0.3, 0.3, 8)
    truth = Parameters(np.tile(x, (6, 1)), 0.5, 1.2, 0.6, 0.2)
    data = simulate(Model(gain=ComplexGain(1.0)), truth, np.eye(2), 0.05, rng=3, gain=np.exp(1j * x))
    mask = np.ones((6, 8), bool)
    mask[1, 2] = False
    response = data.response.copy()
    response[4, 5, 0, 0] = np.nan
    found = fit(Model(gain=ComplexGain(1.0)), Measurement(np.eye(2), response, 0.05, mask=mask))
    assert np.any(found.status & Status.UNIDENTIFIED_DIATTENUATION_ANGLE)
    return found


@pytest.mark.parametrize("shape", [(), (7,), (1, 1), (1, 30), (30, 1), (3, 4), (2, 3, 4)])
def test_any_pixel_shape_is_drawn_with_all_its_maps(result, shape, tmp_path):
    figure = plot_fit(spread(result, shape), smooth=True, pixel_size=9e-6)
    values, below = maps(figure)
    assert set(values) == {"amplitude", "phase (°)", "χ² / degrees of freedom", "log evidence (nat)", *PARAMETERS}
    for axes in (*values.values(), *below.values()):
        assert axes.images[0].get_array().size == np.prod(shape)
    figure.savefig(tmp_path / "map.png", dpi=30)


def test_the_colours_of_angles_close_in_even_steps_and_none_is_grey():
    colours = np.array([colour_circle()(k)[:3] for k in range(256)])
    steps = np.linalg.norm(np.diff(colours, axis=0, append=colours[:1]), axis=1)
    assert steps[-1] < 1.5 * np.median(steps)  # the wrap is a step like any other
    assert steps.max() < 3 * steps.min()
    assert (colours.max(axis=1) - colours.min(axis=1)).min() > 0.2
    opposite = np.linalg.norm(colours - np.roll(colours, 128, axis=0), axis=1)
    assert opposite.min() > 0.35
    # relative luminance by the definition of sRGB: dark text and lines stay visible on every colour
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    assert luminance.min() > 0.15
    assert luminance.max() < 0.7


def test_the_scale_of_an_angle_is_its_period_in_degrees_and_shows_the_fit(result):
    values, _ = maps(result.plot())
    for title, half in ANGLES.items():
        image = values[title].images[0]
        assert image.get_clim() == (-half, half)
        assert image.get_cmap().name == "colour_circle"
        shown = image.get_array()
        known = ~np.ma.getmaskarray(shown)
        np.testing.assert_allclose(
            shown[known], np.degrees(getattr(result.parameters, PARAMETERS[title]))[known], atol=1e-9
        )
        assert half in values[title].images[0].colorbar.get_ticks()
    assert values["phase (°)"].images[0].get_clim() == (-180, 180)
    assert values["amplitude"].images[0].get_cmap().name == "viridis"


def test_a_signed_diattenuation_has_zero_in_the_middle_of_its_colours(result):
    low, high = maps(plot_fit(result, smooth=True))[0]["diattenuation"].images[0].get_clim()
    assert low == -high
    positive = result.parameters._replace(diattenuation=np.abs(result.parameters.diattenuation))
    low, high = maps(plot_fit(replace(result, parameters=positive)))[0]["diattenuation"].images[0].get_clim()
    assert 0 <= low < high


def test_pixels_without_answer_have_no_colour_and_unidentified_ones_are_grey(result):
    values, below = maps(result.plot())
    lost = np.zeros((6, 8), bool)
    lost[1, 2] = lost[4, 5] = True
    for title, name in PARAMETERS.items():
        axes = values[title]
        unknown = ~lost & ((result.status & int(Status.unidentified(name))) != 0)
        np.testing.assert_array_equal(np.ma.getmaskarray(axes.images[0].get_array()), lost | unknown)
        assert axes.patch.get_hatch()
        assert len(axes.images) == (2 if unknown.any() else 1)
        if unknown.any():
            cover = axes.images[1]
            np.testing.assert_array_equal(np.ma.getmaskarray(cover.get_array()), ~unknown)
            red, green, blue, _ = cover.cmap(0)
            assert red == green == blue
        np.testing.assert_array_equal(np.ma.getmaskarray(below[title].images[0].get_array()), lost)
    for title in ("amplitude", "phase (°)", "χ² / degrees of freedom", "log evidence (nat)"):
        np.testing.assert_array_equal(np.ma.getmaskarray(values[title].images[0].get_array()), lost)
    words = [text.get_text() for text in result.plot().legends[0].get_texts()]
    assert words == ["not identified", "no answer"]


def test_uncertainties_have_units_and_a_scale_from_zero_that_one_outlier_does_not_spoil(result):
    _, below = maps(result.plot())
    for title, name in PARAMETERS.items():
        axes, unit = below[title], 1.0 if name == "diattenuation" else 180 / np.pi
        assert axes.get_title() == "± standard deviation" + ("" if name == "diattenuation" else " (°)")
        shown = axes.images[0].get_array()
        known = ~np.ma.getmaskarray(shown)
        std = unit * getattr(result.std, name)[known]
        np.testing.assert_allclose(shown[known], std)
        low, high = axes.images[0].get_clim()
        assert low == 0
        assert high <= np.sort(std)[-1]
        # of 46 values the largest, 2 %, may lie beyond the end, which then is pointed
        assert np.sum(std > high) <= 1 or high == pytest.approx(ANGLES.get(title, 1) * 2 / 12**0.5)
        assert (axes.images[0].colorbar.extend == "max") == bool(np.any(std > high))


def test_the_smooth_gauge_is_shown_on_request_and_named(result):
    figure = plot_fit(result, smooth=True)
    smooth = smooth_gauge(result.parameters, result.status)
    assert np.any(smooth.diattenuation[~np.isnan(smooth.diattenuation)] != result.parameters.diattenuation[
        ~np.isnan(smooth.diattenuation)])  # fmt: skip
    shown = maps(figure)[0]["diattenuation"].images[0].get_array()
    np.testing.assert_allclose(shown.compressed(), smooth.diattenuation[~np.ma.getmaskarray(shown)])
    assert "smooth gauge" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize(("pixel_size", "length", "label"), [(9e-6, 20 / 9, "20 µm"), (1e-7, 2, "0.2 µm")])
def test_every_map_has_the_same_scale_bar_of_a_round_length(result, pixel_size, length, label):
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    figure = plot_fit(result, pixel_size=pixel_size)
    bars = [[a for a in axes.artists if isinstance(a, AnchoredSizeBar)] for axes in figure.axes if axes.get_title()]
    assert all(len(bar) == 1 for bar in bars)
    for (bar,) in bars:
        assert bar.size_bar.get_children()[0].get_width() == pytest.approx(length)
        assert bar.txt_label.get_text() == label


def test_numbers_beside_a_map_reach_neither_the_next_one_nor_the_end_of_the_figure(result):
    wide = replace(result, log_evidence=30 * result.log_evidence - 123456.7, chi_square=1e6 * result.chi_square)
    figure = plot_fit(wide)
    figure.draw_without_rendering()
    titled = [axes for axes in figure.axes if axes.get_title()]
    ends = [axes.images[0].colorbar.ax.get_tightbbox().x1 for axes in titled]
    for axes, end in zip(titled, ends, strict=True):
        assert end > axes.bbox.x1
        assert end < min([other.bbox.x0 for other in titled if other.bbox.x0 > axes.bbox.x1], default=figure.bbox.x1)
    legend = figure.legends[0].get_tightbbox()
    assert legend.y0 >= 0
    assert legend.y1 <= min(axes.bbox.y0 for axes in titled)


def test_a_parameter_that_drops_out_of_the_matrix_is_grey_with_its_uncertainty(result):
    nothing, flag = np.full((6, 8), np.nan), int(Status.UNIDENTIFIED_DIATTENUATION_ANGLE)
    dropped = replace(
        result,
        status=np.full((6, 8), flag, np.int32),
        parameters=result.parameters._replace(diattenuation_angle=nothing),
        std=result.std._replace(diattenuation_angle=nothing),
    )
    values, below = maps(dropped.plot())
    for axes in values["diattenuation angle (°)"], below["diattenuation angle (°)"]:
        assert np.ma.getmaskarray(axes.images[0].get_array()).all()
        assert not np.ma.getmaskarray(axes.images[1].get_array()).any()


def test_a_figure_can_be_drawn_without_a_gain_and_when_nothing_has_an_answer(tmp_path):
    result = fit(Model(), Measurement.from_jones(np.full((2, 2, 2, 2), np.nan), 0.1))
    figure = plot_fit(result, smooth=True)
    assert set(maps(figure)[0]) == {"χ² / degrees of freedom", "log evidence (nat)", *PARAMETERS}
    figure.savefig(tmp_path / "nothing.png", dpi=30)


def test_wrong_arguments_are_refused(result):
    with pytest.raises(TypeError, match="fit must be Fit, got Parameters"):
        plot_fit(result.parameters)
    with pytest.raises(ValueError, match="pixel_size must be > 0"):
        plot_fit(result, pixel_size=0.0)
