"""What a scene may declare of its camera, its arms and its modulators, against limits that are known without it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from acquisition import ModulatorModel, Step
from acquisition.bench.modulators import defocused, shown_spots
from polinfer import RetarderFirst, phantoms
from polinfer.tilting import tilted
from tests.acquisition.benches import BUNDLE, PLAN, SCENE, VIEWS, bench

IDEAL = {"shot_noise": False, "read_noise": 0.0, "gain": 1e-2, "bits": 16}
SPOTS = PLAN.captures[1]
BLANK, SAMPLE = Step("blank-state-1", "blank", (), 1), Step("sample-state-1", "sample", (), 1)


def views_of(b, step=SAMPLE, illumination=PLAN.illumination):
    b.prepare(step, VIEWS, illumination, PLAN.points)
    return np.stack([b.expose(v, 1e-4).counts for v in range(len(VIEWS))]).astype(float)


def test_of_photons_that_come_the_camera_counts_its_share():
    whole, half = (views_of(bench(camera=IDEAL | {"quantum_efficiency": q})) for q in (1.0, 0.5))
    assert whole.max() > 100
    np.testing.assert_allclose(half, whole / 2, atol=1.0)


@pytest.mark.parametrize("step", [SPOTS, BLANK], ids=lambda s: s.kind)
def test_arms_out_of_step_are_another_state_of_light(step):
    """A phase between the arms that is the same everywhere is that of the states; the reference spot has its own."""
    dark = {"reference_amplitude": 0.0}
    turned = np.diag([1, np.exp(0.7j)]) @ PLAN.illumination
    expected = views_of(bench(camera=IDEAL, **dark), step, turned)
    found = views_of(bench(camera=IDEAL, misalignment=(0.7, 0.0, 0.0), **dark), step)
    assert expected.max() > 100
    np.testing.assert_array_equal(found, expected)


def test_tilted_arms_measure_a_matrix_between_their_phases():
    """Behind arms of phase T a sample J makes the light T (T^-1 J T) u: that of arms in step with T^-1 J T, but for a
    phase of V, which intensities of H in a bundle that does not couple cannot see."""
    bundle = type(BUNDLE).hexagonal(radius=20e-6, rng=0, coupling=0.0, birefringence=0.0)
    common = {"camera": IDEAL, "bundle": bundle, "reference_amplitude": 0.0}
    tilt = (0.4, 3e4, -5e4)
    found = views_of(bench(misalignment=tilt, **common))
    phase = SCENE.__class__(bundle, SCENE.phantom, misalignment=tilt).between_arms(PLAN.points).reshape(4, 4)
    assert np.ptp(phase) > 0.5
    np.testing.assert_allclose(phase.ravel(), 0.4 + PLAN.points @ [3e4, -5e4])
    jones = np.asarray(RetarderFirst().jones(SCENE.phantom.parameters))
    still = bench(**common)
    measured = tilted(jones, phase) * np.asarray(SCENE.phantom.gain)[..., None, None]
    still._sample = (*still._sample[:2], measured.reshape(-1, 2, 2), still._sample[3])
    expected = views_of(still)
    np.testing.assert_allclose(found[:3], expected[:3], atol=1.0 + 1e-5 * expected.max())
    assert np.abs(found[3:] - expected[3:]).max() > 50  # H against V shows it


def test_a_perfect_modulator_makes_the_spots_that_are_wanted():
    light = np.zeros((2, len(PLAN.points)), complex)
    light[:, [0, 6, 11]] = np.outer([1, 0.5j], [1.0, 1j, -0.7])
    np.testing.assert_allclose(shown_spots(ModulatorModel(), PLAN.points, light, 4.2e-6, 850e-9, 0.0), light, atol=1e-9)


@pytest.mark.parametrize("levels", [4, 8, 16])
def test_few_levels_keep_the_share_of_a_blazed_grating(levels):
    """sinc^2(1 / n) of the light of a spot, far off the axis and in no step with the pixels."""
    points = np.array([[0.0, 0.0], [11.37 * 4.2e-6, 7.21 * 4.2e-6]])
    light = np.array([[0, 1.0], [0, 1.0]], complex)
    found = shown_spots(ModulatorModel(levels, pixels=512), points, light, 4.2e-6, 850e-9, 0.0)
    np.testing.assert_allclose(np.abs(found[:, 1]) ** 2, np.sinc(1 / levels) ** 2, rtol=0.01)


def test_a_modulator_that_has_not_settled_shows_both_patterns():
    model = ModulatorModel(settling=0.1)
    shown = model.shown(np.array([[1.0, 2.0]]), np.array([[3.0, 0.0]]), wait=0.1)
    np.testing.assert_allclose(shown, [[1 + 2 / np.e, 2 - 2 / np.e]])
    assert model.left(1e3) == 0.0
    # a spot whose phases lack a share e of their stroke: sinc(e)^2 of its light, the mean of exp(-i e phase)
    light = np.array([[0, 1.0], [0, 0.0]], complex)
    points = np.array([[0.0, 0.0], [11.37 * 4.2e-6, 7.21 * 4.2e-6]])
    found = shown_spots(ModulatorModel(settling=1.0, pixels=512), points, light, 4.2e-6, 850e-9, wait=2.0)
    np.testing.assert_allclose(np.abs(found[0, 1]) ** 2, np.sinc(np.exp(-2)) ** 2, rtol=0.01)


def test_phase_steps_lag_behind_by_what_has_not_settled():
    b = bench(camera=IDEAL, lens=ModulatorModel(settling=0.5), image_time=1.0)
    left = np.exp(-2)
    first, second, third = VIEWS.steps
    one = first * (1 - left)
    two = second + left * (one - second)
    np.testing.assert_allclose(b._steps(VIEWS), [one, two, third + left * (two - third)])
    np.testing.assert_array_equal(bench()._steps(VIEWS), VIEWS.steps)
    assert b._steps(replace(VIEWS, steps=(0.0, 0.1, 6.0)))[0] == 0.0


def test_a_perfect_lens_is_free_space_and_one_of_few_levels_loses_light_to_other_orders():
    launched = BUNDLE.transmit(np.ones((2, BUNDLE.cores)) + 0j)
    distances = np.array([-4e-5, 0.0, 4e-5])
    expected = BUNDLE.image(launched, (64, 64), 0.72e-6, distances, padding=1)
    focus = BUNDLE.image(launched, (64, 64), 0.72e-6)
    found = defocused(ModulatorModel(), focus, distances, BUNDLE.wavelength, 0.72e-6, 0.0)
    # free space leaves out what would come back around the frame; the modulator does not
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)
    coarse = defocused(ModulatorModel(levels=8), focus, distances, BUNDLE.wavelength, 0.72e-6, 0.0)
    for z in (0, 2):
        overlap = abs(np.vdot(coarse[z], found[z])) / np.linalg.norm(found[z]) ** 2
        assert overlap == pytest.approx(np.sinc(1 / 8), abs=0.01)
    np.testing.assert_allclose(coarse[1], found[1], atol=1e-4 * np.abs(focus).max())  # flat in focus
    smeared = defocused(ModulatorModel(crosstalk=0.7), focus, distances, BUNDLE.wavelength, 0.72e-6, 0.0)
    assert 0.002 < np.linalg.norm(smeared[0] - found[0]) / np.linalg.norm(found[0]) < 0.7


@pytest.mark.parametrize("name", ["hologram", "lens"])
def test_modulators_err_only_where_declared(name):
    plain, perfect, coarse = (
        views_of(bench(camera=IDEAL, **({name: m} if m else {})), SPOTS)
        for m in (None, ModulatorModel(), ModulatorModel(levels=4))
    )
    inner = (slice(None), slice(12, -12), slice(12, -12))
    assert np.linalg.norm((perfect - plain)[inner]) < 0.02 * np.linalg.norm(plain[inner])
    assert np.linalg.norm(coarse - plain) > 0.05 * np.linalg.norm(plain)
    described = bench(**{name: ModulatorModel(levels=4)}).describe()
    assert json.loads(json.dumps(described)) == described
    assert described["scene"][name]["levels"] == 4


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: ModulatorModel(levels=1), ValueError, "levels must be"),
        (lambda: ModulatorModel(crosstalk=-1.0), ValueError, "crosstalk must be >= 0"),
        (lambda: bench(lens=3), TypeError, "lens must be ModulatorModel"),
        (lambda: bench(hologram=ModulatorModel(settling=1.0)), ValueError, "hologram settles, but image_time is 0"),
        (lambda: bench(misalignment=(1.0, 2.0)), ValueError, "misalignment"),
        (
            lambda: bench(phantom=phantoms.half_wave_plate((4, 4), tilt=np.ones((4, 4)))),
            ValueError,
            "phantom has a tilt of its own",
        ),
    ],
)
def test_wrong_declarations_are_named(call, error, text):
    with pytest.raises(error, match=text):
        call()
