"""The simulated bench keeps the contract, shows what physics says, and has only the effects that were declared."""

import json
from dataclasses import replace

import numpy as np
import pytest

from acquisition import AnyBench, Bracket, CameraModel, Scene, SimulatedBench, Step, Views
from fibre import Bundle
from polinfer import RetarderFirst, phantoms
from polinfer.precision import double_precision
from tests.acquisition.benches import BUNDLE, CAMERA, PLAN, SAMPLE, SCENE, VIEWS, bench

SPOTS = PLAN.captures[1]
BLANK, OTHER = Step("blank-state-1", "blank", (), 1), Step("sample-state-1", "sample", (), 1)
IDEAL = {"shot_noise": False, "read_noise": 0.0, "gain": 1e-2, "bits": 16}


def frame(b, step=SPOTS, view=1, exposure=4e-3, views=VIEWS):
    b.prepare(step, views, PLAN.illumination, PLAN.points)
    return b.expose(view, exposure).counts


def distal(step, scene=SCENE):
    """Light launched into the fibrelets, (2, m), from the scene's description and nothing else."""
    reference = scene.bundle.launch(np.array([scene.reference]), scene.spot_waist).toarray()[:, 0]
    light = scene.reference_amplitude * np.stack([reference, reference]) / np.sqrt(2) + 0j
    state = PLAN.illumination[:, step.state]
    if step.kind == "spots":
        for point in step.points:
            light += np.outer(state, scene.bundle.launch(PLAN.points[[point]], scene.spot_waist).toarray()[:, 0])
    if step.kind in ("blank", "sample"):
        for i, place in enumerate(PLAN.points):
            field = scene.illumination * np.exp(-(place @ place) / scene.illumination_waist**2) * state
            if step.kind == "sample":
                y, x = np.unravel_index(i, (4, 4))
                parameters = type(scene.phantom.parameters)(*(p[y, x] for p in scene.phantom.parameters))
                field = scene.phantom.gain[y, x] * np.asarray(RetarderFirst().jones(parameters)) @ field
            light += np.outer(field, scene.bundle.launch(place[None], scene.spot_waist).toarray()[:, 0])
    return light


@pytest.mark.parametrize("step", [PLAN.captures[0], SPOTS, BLANK, OTHER], ids=lambda s: s.kind)
def test_an_ideal_camera_counts_the_squared_field(step):
    b = bench(camera=IDEAL)
    b.prepare(step, VIEWS, PLAN.illumination, PLAN.points)
    proximal = (BUNDLE.transfer @ distal(step).ravel()).reshape(2, -1)
    seen = BUNDLE.image(proximal, (64, 64), CAMERA.pixel_size, [0.0, *VIEWS.diversity])
    rate = SCENE.spot_power * CAMERA.pixel_size**2
    views = [*(np.abs(seen[1 + i, 0]) ** 2 for i in range(3))]
    views += [np.abs(seen[0, 0] + np.exp(1j * d) * seen[0, 1]) ** 2 / 2 for d in VIEWS.steps]
    for view, intensity in enumerate(views):
        exposure = 500 / (rate * intensity.max())  # 50 000 of 65 535 counts at the peak
        counts = b.expose(view, exposure).counts.astype(float)
        assert np.abs(counts * 1e-2 - rate * intensity * exposure).max() <= 0.005 + 1e-4 * 500


def test_power_on_the_camera_is_what_the_scene_says():
    """A spot that is the mode of one core puts spot_power on a camera that sees all of the facet."""
    bundle = Bundle.hexagonal(radius=20e-6, rng=0, mode_spread=0.0, coupling=0.0, birefringence=0.0, jitter=0.0)
    centre = bundle.centres[np.argmin(np.hypot(*bundle.centres.T))]
    scene = Scene(bundle, SCENE.phantom, CameraModel((96, 96), 0.5e-6, gain=1e-2, read_noise=0.0, bits=16,
                  shot_noise=False), spot_power=1e6, spot_waist=1.6e-6, reference=tuple(centre))  # fmt: skip
    b = SimulatedBench(scene, rng=0)
    b.prepare(Step("reference-0", "reference"), VIEWS, PLAN.illumination, None)
    # H alone, in focus: half of the power of the neighbours-and-all amplitude at 45 degrees
    launched = float((bundle.launch(centre[None], 1.6e-6).toarray() ** 2).sum())
    assert b.expose(1, 1e-3).counts.sum() * 1e-2 == pytest.approx(0.5 * launched * 1e6 * 1e-3, rel=0.01)


def test_shot_noise_has_the_mean_and_variance_of_photons():
    settings = {"read_noise": 0.0, "gain": 1.0, "bits": 16}
    b, ideal = bench(camera=settings), bench(camera=settings | {"shot_noise": False, "gain": 1e-2})
    per_second = frame(ideal, exposure=1e-5).max() * 1e-2 / 1e-5
    for peak in (40, 600):  # below and above the limit of the exact Poisson generator
        exposure = peak / per_second
        mean = frame(ideal, exposure=exposure) * 1e-2
        mean = mean[lit := mean > 1]
        b.prepare(SPOTS, VIEWS, PLAN.illumination, PLAN.points)
        stack = np.stack([b.expose(1, exposure * (1 + 1e-9 * k)).counts[lit] for k in range(200)]).astype(float)
        assert abs((stack.mean(0) - mean).sum()) < 4 * np.sqrt(mean.sum() / 200) + 0.005 * mean.size
        # a sum of a normal variable and its rounding has 1/12 more variance; Poisson numbers are whole already
        ratio = (stack.var(0, ddof=1) - (mean > 50) / 12) / mean
        assert ratio.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / (200 * mean.size)) + 0.005)


def test_read_noise_has_its_standard_deviation():
    b = bench(camera={"shot_noise": False, "read_noise": 6.0, "gain": 0.5, "bits": 16})
    clean = bench(camera={"shot_noise": False, "read_noise": 0.0, "gain": 0.5, "bits": 16})
    mean = frame(clean).astype(float)
    error = (frame(b) - mean)[mean > 100] * 0.5
    assert error.std() == pytest.approx(6.0, rel=4 / np.sqrt(2 * error.size) + 0.01)


def test_the_same_seed_is_the_same_frame_whatever_was_taken_before():
    first = bench()
    alone = frame(bench())
    frame(first, BLANK, 0)
    frame(first, SPOTS, 2)
    np.testing.assert_array_equal(frame(first), alone)
    assert not np.array_equal(frame(bench(seed=8)), alone)
    assert not np.array_equal(frame(first, exposure=4.001e-3), alone)  # another exposure, other photons


def test_counts_saturate_at_full_scale_and_are_whole():
    for bits, kind in ((8, np.uint8), (12, np.uint16), (16, np.uint16)):
        counts = frame(bench(camera={"bits": bits}), exposure=10.0)
        assert counts.dtype == kind
        assert counts.max() == 2**bits - 1 == bench(camera={"bits": bits}).full_scale


DECLARED = {
    "focus_error": 0.02, "focus_offset": 2e-6, "step_error": 0.1, "oversampling": 2, "sample_oversampling": 2,
    "illumination": 0.4, "illumination_waist": 2e-5, "reference_amplitude": 0.5, "reference": (0.0, 12e-6),
    "spot_waist": 2.0e-6, "spot_power": 1e7,
}  # fmt: skip


def views_of(b):
    b.prepare(OTHER, VIEWS, PLAN.illumination, PLAN.points)
    return np.stack([b.expose(v, 1e-3).counts for v in range(len(VIEWS))])


@pytest.mark.parametrize("name", DECLARED)
def test_an_effect_is_there_only_when_declared(name):
    settings = {"shot_noise": False, "read_noise": 0.0, "gain": 0.01, "bits": 16}
    plain, changed = views_of(bench(camera=settings)), views_of(bench(camera=settings, **{name: DECLARED[name]}))
    assert not np.array_equal(plain, changed)
    if name == "step_error":  # touches the interference alone
        np.testing.assert_array_equal(plain[:3], changed[:3])
    if name == "focus_error":  # touches nothing in focus
        np.testing.assert_array_equal(plain[[1, 3, 4, 5]], changed[[1, 3, 4, 5]])
    absent = {f: SCENE.__dataclass_fields__[f].default for f in ("focus_error", "focus_offset", "step_error")}
    np.testing.assert_array_equal(views_of(bench(camera=settings, **absent)), plain)


def test_a_finer_sample_of_a_flat_scene_makes_the_same_field():
    flat = phantoms.Phantom(
        type(SCENE.phantom.parameters)(*(np.full((8, 8), x) for x in (0.2, 0.3, 1.0, 0.4, 0.1))),
        np.full((8, 8), 0.7 + 0.2j),
    )  # fmt: skip
    settings = {"shot_noise": False, "read_noise": 0.0, "gain": 0.01, "bits": 16}
    coarse, fine = (
        views_of(bench(camera=settings, phantom=flat, sample_oversampling=n, pitch=2.5e-6, illumination_waist=1e-3))
        for n in (1, 2)
    )
    middle = (slice(None), slice(26, 38), slice(26, 38))  # away from the sample's edge
    coarse, fine = coarse[middle].astype(float), fine[middle].astype(float)
    assert np.linalg.norm(fine - coarse) < 0.1 * np.linalg.norm(coarse)


def test_the_bench_keeps_the_contract_and_describes_itself_in_json():
    b = bench()
    assert isinstance(b, AnyBench)
    described = b.describe()
    assert json.loads(json.dumps(described)) == described == bench().describe()
    with double_precision(False):  # Jones matrices in other digits, as another compiler's: the same bench, to resume
        assert bench().describe() == described
    before = b.time()
    frame(b, exposure=0.5)
    assert b.time() >= before + 0.5
    with pytest.raises(RuntimeError, match="prepare a step"):
        bench().expose(0, 0.1)
    with pytest.raises(ValueError, match="points must be given"):
        b.prepare(SPOTS, VIEWS, PLAN.illumination, None)


def test_drift_turns_and_tilts_the_light_by_a_walk_of_the_stated_rate():
    still, moving = bench(), bench(piston_walk=0.2, tilt_walk=500.0, image_time=2.0)
    assert still.drift(100.0) == (0.0, (0.0, 0.0))
    # intensities of H in focus know of neither, those of H against V neither: both polarisations turn alike
    before = moving.time()
    np.testing.assert_array_equal(frame(moving, view=0, exposure=0.01), frame(still, view=0, exposure=0.01))
    assert moving.time() == pytest.approx(before + 2.01)
    assert moving.drift(300.0) == bench(piston_walk=0.2, tilt_walk=500.0).drift(300.0)
    walks = [bench(piston_walk=0.2, tilt_walk=500.0, seed=seed) for seed in range(60)]
    ends = np.array([(w.drift(130.5)[0], *w.drift(130.5)[1]) for w in walks])
    starts = np.array([(w.drift(30.25)[0], *w.drift(30.25)[1]) for w in walks])
    rate = ((ends - starts) ** 2).mean(0) / 100.25
    # chi-square of 60: within 3 sigma
    np.testing.assert_allclose(rate / np.array([0.2, 500, 500]) ** 2, 1, atol=3 * np.sqrt(2 / 60))


def test_drift_is_a_ramp_of_the_phase_over_the_camera():
    b = bench(camera=IDEAL, piston_walk=0.2, tilt_walk=1e3)
    b.continue_from(80.0)
    piston, tilt = b.drift(80.0)
    b.prepare(SPOTS, VIEWS, PLAN.illumination, PLAN.points)
    ramp = np.exp(1j * (piston + BUNDLE.centres @ tilt))
    assert np.ptp(BUNDLE.centres @ tilt) > 0.1
    proximal = (BUNDLE.transfer @ distal(SPOTS).ravel()).reshape(2, -1) * ramp
    seen = np.abs(BUNDLE.image(proximal, (64, 64), CAMERA.pixel_size, VIEWS.diversity)[:, 0]) ** 2
    rate = SCENE.spot_power * CAMERA.pixel_size**2
    for view, intensity in enumerate(seen):
        exposure = 500 / (rate * intensity.max())
        assert np.abs(b.expose(view, exposure).counts * 1e-2 - rate * intensity * exposure).max() <= 0.005 + 1e-4 * 500


OTHERS = {
    "seed": lambda: bench(seed=8),
    "camera": lambda: bench(camera={"gain": 5.0}),
    "light": lambda: bench(illumination=0.3),
    "sample": lambda: bench(phantom=phantoms.lesion((4, 4), rng=1)),
    "gain": lambda: bench(phantom=replace(SCENE.phantom, gain=1.1 * SCENE.phantom.gain)),
    "bundle": lambda: bench(bundle=Bundle.hexagonal(radius=20e-6, rng=1)),
    "mode radius": lambda: bench(bundle=replace(BUNDLE, mode_radius=BUNDLE.mode_radius * 1.1)),
    "centres": lambda: bench(bundle=replace(BUNDLE, centres=BUNDLE.centres + 1e-7)),
    "wavelength": lambda: bench(bundle=replace(BUNDLE, wavelength=800e-9)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_benches_that_make_other_frames_describe_themselves_otherwise(name):
    other = OTHERS[name]()
    assert not np.array_equal(views_of(other), views_of(bench()))
    assert other.describe() != bench().describe()


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: SimulatedBench(BUNDLE), TypeError, "scene must be Scene"),
        (lambda: bench(phantom=3), TypeError, "phantom must be Phantom"),
        (lambda: bench(spot_power=0.0), ValueError, "spot_power must be > 0"),
        (lambda: bench(step_error=-0.1), ValueError, "step_error must be >= 0"),
        (lambda: bench(oversampling=0), ValueError, "oversampling must be >= 1"),
        (lambda: bench(camera={"bits": 17}), ValueError, "bits must be from 1 to 16"),
        (lambda: bench(camera={"gain": 0.0}), ValueError, "gain must be > 0"),
        (lambda: bench(camera={"quantum_efficiency": 1.2}), ValueError, "quantum_efficiency must be <= 1"),
        (lambda: bench(camera={"read_noise": -1.0}), ValueError, "read_noise must be >= 0"),
    ],
)
def test_wrong_settings_are_named(call, error, text):
    with pytest.raises(error, match=text):
        call()


def test_the_sample_plan_shares_the_bench():
    assert [step.kind for step in SAMPLE.captures] == ["reference", *["blank"] * 3, *["sample"] * 3]
    assert list(Views(bracket=Bracket(0.1, 2.0, 0.1)).bracket.times()) == [0.1]
