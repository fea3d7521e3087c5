"""The bound is the inverse of the Fisher matrix that finite differences of the plain matrix products give."""

import numpy as np
import pytest

from polinfer import ComplexGain, Model, Parameters, PhaseGain, RetarderFirst, cramer_rao_bound
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED, ORDERINGS, UNBALANCED

ONE_STATE = UNBALANCED[:, 1:2]
GAINS = {"none": None, "phase": PhaseGain(), "complex": ComplexGain(1.0)}
EVERYWHERE = (0.3, 0.4, 1.3, 0.6, 0.3)


def expected_bound(x, u, sigma, ordering="retarder_first", gain="none", fixed=(), size=1.0):
    """Square roots of the diagonal of the inverse Fisher matrix; inf where a null direction moves the parameter."""
    names = [name for name in Parameters._fields if name not in fixed]
    places = [Parameters._fields.index(name) for name in names]
    nuisances = {"none": 0, "phase": 1, "complex": 2}[gain]

    def data(y):
        values = np.array(x, float)
        values[places] = y[: len(places)]
        rest = y[len(places) :]
        factor = {
            "none": lambda: 1.0,
            "phase": lambda: np.exp(1j * rest[0]),
            "complex": lambda: 1 + rest[0] + 1j * rest[1],
        }
        return size * factor[gain]() * (oracle.jones(values, ordering) @ u).ravel()

    start, step = np.concatenate([np.array(x, float)[places], np.zeros(nuisances)]), 1e-5
    slopes = [(data(start + step * e) - data(start - step * e)) / (2 * step) for e in np.eye(len(start))]
    fisher = 2 / sigma**2 * np.real(np.conj(slopes) @ np.transpose(slopes))
    values, axes = np.linalg.eigh(fisher)
    null = values < 1e-8 * values.max()
    variance = np.sum(axes[:, ~null] ** 2 / values[~null], axis=1)
    std = np.where(np.sum(axes[:, null] ** 2, axis=1) > 1e-6, np.inf, np.sqrt(variance))
    return Parameters(**(dict.fromkeys(Parameters._fields, 0.0) | dict(zip(names, std, strict=False))))


@pytest.mark.parametrize(
    ("ordering", "gain", "u", "fixed"),
    [
        ("retarder_first", "none", UNBALANCED, ()),
        ("retarder_first", "phase", BALANCED, ("diattenuation",)),
        ("retarder_first", "complex", UNBALANCED, ("circularity",)),
        ("polariser_first", "none", BALANCED, ("retardance", "circularity")),
        ("polariser_first", "phase", UNBALANCED, ()),
        ("polariser_first", "complex", BALANCED, ("diattenuation_angle",)),
        ("retarder_first", "none", ONE_STATE, ()),
        ("polariser_first", "none", ONE_STATE, ("diattenuation", "circularity")),
    ],
)
def test_the_bound_is_that_of_the_finite_difference_fisher_matrix(ordering, gain, u, fixed):
    points = [EVERYWHERE, (-0.7, -1.2, -2.9, 1.4, 2.0), (0.95, 1.5, 3.0, -0.1, -1.0)]
    if u is not ONE_STATE:
        points += [(0.0, 0.4, 1.3, 0.6, 0.3), (0.3, 0.4, 0.0, 0.6, 0.3), (0.3, 0.4, np.pi, np.pi / 2, 0.3)]
    for x in points:
        known = {name: getattr(Parameters(*x), name) for name in fixed}
        model = Model(ORDERINGS[ordering], gain=GAINS[gain], fixed=known)
        found = cramer_rao_bound(model, Parameters(*x), u, 0.05)
        expected = expected_bound(x, u, 0.05, ordering, gain, fixed)
        for name in set(Parameters._fields) - model.dropped:
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, err_msg=f"{name} {x}")
        for name in model.dropped:
            assert np.isinf(getattr(found, name))


def test_an_amplitude_of_the_gain_divides_sigma():
    found = cramer_rao_bound(Model(gain=ComplexGain(1.0)), Parameters(*EVERYWHERE), BALANCED, 0.05 / 0.3)
    np.testing.assert_allclose(found, expected_bound(EVERYWHERE, BALANCED, 0.05, gain="complex", size=0.3), rtol=1e-6)


def test_every_pixel_has_its_own_point_states_and_sigma():
    generator = np.random.default_rng(5)
    x = generator.uniform(-0.9, 0.9, (5, 2, 3))
    u, sigma = generator.normal(size=(3, 2, 4)) + 1j * generator.normal(size=(3, 2, 4)), np.array([[0.1], [0.3]])
    found = cramer_rao_bound(Model(gain=PhaseGain()), Parameters(*x), u, sigma)
    for i, k in np.ndindex(2, 3):
        expected = expected_bound(x[:, i, k], u[k], sigma[i, 0], gain="phase")
        np.testing.assert_allclose([values[i, k] for values in found], expected, rtol=1e-5)


@pytest.mark.parametrize("ordering", list(ORDERINGS))
@pytest.mark.parametrize("diattenuation", [-0.999, -0.5, 0.0, 0.9, 1 - 1e-8, 1 - 1e-12, 1.0, -1.0])
def test_diattenuation_has_the_bound_of_the_closed_form_at_any_size(ordering, diattenuation):
    for gain in GAINS.values():
        bound = cramer_rao_bound(Model(ORDERINGS[ordering], gain=gain), Parameters(diattenuation, *EVERYWHERE[1:]),
                                 BALANCED, 0.2)  # fmt: skip
        expected = np.sqrt(1 - diattenuation**2) * 0.2 / np.sqrt(1.5)
        assert bound.diattenuation == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("ordering", list(ORDERINGS))
@pytest.mark.parametrize(("eta", "angle"), [(0.1, 0.6), (1.3, 0.1), (3.0, 1.4)])
def test_without_diattenuation_the_retarder_has_the_bounds_of_the_closed_forms(ordering, eta, angle):
    bound = cramer_rao_bound(Model(ORDERINGS[ordering]), Parameters(1e-4, 0.3, eta, angle, 0.2), BALANCED, 0.2)
    length = np.sqrt(6) * abs(np.sin(eta / 2))
    assert bound.retardance == pytest.approx(0.2 / np.sqrt(1.5), rel=1e-3)
    assert bound.retardance_angle == pytest.approx(0.2 / (2 * length), rel=1e-3)
    assert bound.circularity == pytest.approx(0.2 / (length * np.sin(2 * angle)), rel=1e-3)
    assert bound.diattenuation_angle == pytest.approx(0.2 / (np.sqrt(6) * 1e-4), rel=1e-3)


def test_what_does_not_fit_together_is_refused():
    good = (Model(), Parameters(*EVERYWHERE), BALANCED, 0.1)
    for place, value, kind, text in (
        (0, RetarderFirst(), TypeError, "model must be Model"),
        (1, EVERYWHERE, TypeError, "parameters must be Parameters"),
        (1, Parameters(np.nan, 0.0, 1.0, 0.4, 0.2), ValueError, r"parameters\.diattenuation must be finite"),
        (2, BALANCED.T, ValueError, r"illumination must have shape \(\.\.\., 2, any\)"),
        (3, 0.0, ValueError, "sigma must be > 0"),
    ):
        arguments = [value if i == place else x for i, x in enumerate(good)]
        with pytest.raises(kind, match=text):
            cramer_rao_bound(*arguments)
    with pytest.raises(ValueError, match="sigma has pixel shape"):
        cramer_rao_bound(Model(), Parameters(np.zeros(2), *EVERYWHERE[1:]), BALANCED, np.ones(3))
