"""A fit of any shape can be drawn, and grey is where no answer is."""

import numpy as np
import pytest

from polinfer import Measurement, Model, Parameters, PhaseGain, fit, phantoms, simulate


@pytest.mark.parametrize("shape", [(), (7,), (3, 4)])
def test_any_pixel_shape_is_drawn(shape):
    truth = Parameters(*(np.full(shape, x) for x in (0.3, 0.4, 1.3, 0.6, 0.2)))
    figure = fit(Model(), simulate(Model(), truth, np.eye(2), 0.02, rng=1)).plot()
    titles = [a.get_title() for a in figure.axes if a.get_title()]
    assert titles[:2] == ["diattenuation", "diattenuation angle (°)"]
    assert len(titles) == 10


def test_masked_pixels_are_grey_and_angles_have_their_period_in_degrees():
    scene = phantoms.lesion((4, 5), rng=1)
    mask = np.ones((4, 5), bool)
    mask[1, 2] = False
    data = simulate(Model(gain=PhaseGain()), scene.parameters, np.eye(2), 0.02, rng=1)
    result = fit(Model(gain=PhaseGain()), Measurement(data.illumination, data.response, 0.02, mask=mask))
    maps = {
        a.get_title(): a.images[0] for a in result.plot().axes if a.images and a.get_title() != "± standard deviation"
    }
    assert maps["retardance (°)"].get_clim() == (-180, 180)
    assert maps["retardance angle (°)"].get_clim() == (-90, 90)
    assert maps["amplitude"].get_array().mask[1, 2]
    shown = maps["retardance (°)"].get_array()
    assert shown.mask[1, 2]
    assert shown[0, 0] == pytest.approx(np.degrees(result.parameters.retardance[0, 0]))


def test_a_figure_can_be_drawn_when_nothing_has_an_answer(tmp_path):
    result = fit(Model(), Measurement.from_jones(np.full((2, 2, 2, 2), np.nan), 0.1))
    result.plot().savefig(tmp_path / "nothing.png")
