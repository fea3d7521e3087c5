"""A plan lights everything once, says so in its input matrix, and its hash knows every setting."""

from dataclasses import replace

import numpy as np
import pytest

from acquisition import (
    Bracket,
    CalibrationPlan,
    PatternPlan,
    SamplePlan,
    Timing,
    Views,
    elliptical_states,
    upgrades,
)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_states_are_balanced_and_of_unit_power(count):
    u = elliptical_states(count)
    np.testing.assert_allclose(u @ u.conj().T, count / 2 * np.eye(2), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(u, axis=0), 1)


@pytest.mark.parametrize(
    ("grid", "stride", "states"), [((4, 6), 2, 3), ((18, 18), 4, 3), ((7, 5), 3, 2), ((2, 3), 4, 4), ((1, 1), 1, 2)]
)
def test_every_point_is_lit_in_every_state_exactly_once(grid, stride, states):
    plan = CalibrationPlan(grid, stride=stride, states=states)
    count = np.zeros((grid[0] * grid[1], states), int)
    for step in plan.captures:
        assert step.kind in ("spots", "reference")
        np.add.at(count, (list(step.points), step.state), step.kind == "spots")
    np.testing.assert_array_equal(count, 1)
    assert len({step.id for step in plan.captures}) == len(plan.captures)


def test_spots_of_one_capture_are_a_stride_apart():
    plan = CalibrationPlan((9, 11), stride=3, pitch=4e-6)
    for step in plan.captures:
        if len(step.points) > 1:
            lit = plan.points[list(step.points)]
            apart = np.abs(lit[:, None] - lit) / (3 * 4e-6)
            np.testing.assert_allclose(apart, np.rint(apart), atol=1e-9)
            np.testing.assert_array_equal(apart.sum(-1) > 0.5, ~np.eye(len(lit), dtype=bool))


def test_the_input_matrix_is_what_the_captures_light():
    plan = CalibrationPlan((5, 4), stride=2)
    spots = [step for step in plan.captures if step.kind == "spots"]
    expected = np.zeros((2, 20, len(spots)), complex)
    for c, step in enumerate(spots):
        for point in step.points:
            expected[:, point, c] = elliptical_states(3)[:, step.state]
    np.testing.assert_array_equal(plan.inputs.toarray(), expected.reshape(40, -1))
    # every column of A is seen through balanced states: inputs are a tight frame over the two polarisations
    gram = plan.inputs.toarray() @ plan.inputs.toarray().conj().T
    np.testing.assert_allclose(np.diag(gram), 1.5)
    np.testing.assert_allclose([gram[p, 20 + p] for p in range(20)], 0, atol=1e-14)


def test_points_are_centred_row_by_row_at_the_pitch():
    points = CalibrationPlan((3, 4), pitch=5e-6).points.reshape(3, 4, 2)
    np.testing.assert_allclose(points.mean((0, 1)), 0, atol=1e-18)
    np.testing.assert_allclose(np.diff(points[..., 0], axis=0), 5e-6)
    np.testing.assert_allclose(np.diff(points[..., 1], axis=1), 5e-6)


@pytest.mark.parametrize("every", [1, 7, 100])
def test_a_reference_comes_first_last_and_at_least_every_so_often(every):
    kinds = [step.kind for step in CalibrationPlan((6, 6), reference_every=every).captures]
    references = np.flatnonzero(np.array(kinds) == "reference")
    assert references[0] == 0
    assert references[-1] == len(kinds) - 1
    assert np.diff(references).max() <= every + 1


CHANGES = {
    "grid": (6, 5), "pitch": 4.3e-6, "stride": 3, "states": 4, "reference_every": 6,
    "views": Views(diversity=(0.0, 1e-5)),
}  # fmt: skip
VIEWS = [
    Views(steps=(0.0, 1.0, 2.0)),
    Views(bracket=Bracket(0.05)),
    Views(bracket=Bracket(64e-3, 3.0, 0.25e-3)),
    Views(bracket=Bracket(64e-3, 2.0, 0.5e-3)),
]


def test_the_hash_changes_with_any_setting():
    base = CalibrationPlan((5, 6))
    changed = [replace(base, **{name: value}) for name, value in CHANGES.items()]
    changed += [replace(base, views=views) for views in VIEWS]
    samples = [SamplePlan(), SamplePlan(states=4), SamplePlan(blank=False), SamplePlan(references=1)]
    hashes = [plan.hash for plan in (base, *changed, *samples)]
    assert len(set(hashes)) == len(hashes)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (CalibrationPlan((5, 6)), CalibrationPlan([5, 6])),
        (CalibrationPlan((5, 6)), CalibrationPlan((np.int64(5), np.int32(6)))),
        (CalibrationPlan((5, 6), pitch=4.2e-6), CalibrationPlan((5, 6), pitch=np.float64(4.2e-6))),
        (CalibrationPlan((5, 6), stride=3), CalibrationPlan((5, 6), stride=np.int64(3))),
        (SamplePlan(states=3), SamplePlan(states=np.int64(3))),
        (SamplePlan(), SamplePlan(views=Views(diversity=np.linspace(-120e-6, 120e-6, 7)))),
        (SamplePlan(views=Views(bracket=Bracket(1))), SamplePlan(views=Views(bracket=Bracket(np.float64(1.0))))),
    ],
)
def test_equal_plans_have_equal_hashes_whatever_made_their_numbers(one, other):
    assert one == other
    assert one.hash == other.hash


def test_the_hash_is_the_same_in_another_process():
    import subprocess
    import sys

    code = "from acquisition import CalibrationPlan; print(CalibrationPlan((5, 6)).hash)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == CalibrationPlan((5, 6)).hash


def test_durations_are_the_papers():
    sample = SamplePlan(blank=False, references=0)
    assert sample.duration(Timing()) == pytest.approx(24.9, abs=0.05)
    # 243 inputs of 11 images, 293 captures with references: 40.5 minutes of images (the paper's 50.8 is overhead)
    grid = CalibrationPlan((27, 36), stride=9, reference_every=5)
    assert sum(step.kind == "spots" for step in grid.captures) == 243
    assert len(grid.captures) == 293
    assert grid.duration(Timing()) / 60 == pytest.approx(40.5, abs=0.05)
    assert sample.duration(Timing(image=1 / 60)) == pytest.approx(33 / 60)


def test_a_sample_plan_has_sample_and_blank_in_every_state():
    kinds = [(step.kind, step.state) for step in SamplePlan(states=4, references=1).captures]
    expected = [("reference", 0), *(("blank", k) for k in range(4)), *(("sample", k) for k in range(4))]
    assert kinds == expected


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: CalibrationPlan((0, 3)), ValueError, "grid must be >= 1"),
        (lambda: CalibrationPlan((2.0, 3)), TypeError, "grid must be an integer"),
        (lambda: CalibrationPlan((2, 3), pitch=0.0), ValueError, "pitch must be > 0"),
        (lambda: CalibrationPlan((2, 3), stride=0), ValueError, "stride must be >= 1"),
        (lambda: CalibrationPlan((2, 3), states=1), ValueError, "states must be >= 2"),
        (lambda: CalibrationPlan((2, 3), reference_every=0), ValueError, "reference_every must be >= 1"),
        (lambda: CalibrationPlan((2, 3), views=3), TypeError, "views must be Views"),
        (lambda: SamplePlan(states=1), ValueError, "states must be >= 2"),
        (lambda: SamplePlan(references=-1), ValueError, "references must be >= 0"),
        (lambda: SamplePlan().duration(8.3), TypeError, "timing must be Timing"),
        (lambda: Views(steps=(0.0, np.nan)), ValueError, "steps must be finite"),
        (lambda: Views(diversity=1e-5), ValueError, "diversity must have shape"),
        (lambda: Views(bracket=0.1), TypeError, "bracket must be Bracket"),
        (lambda: elliptical_states(1), ValueError, "count must be >= 2"),
    ],
)
def test_wrong_settings_are_named(call, error, text):
    with pytest.raises(error, match=text):
        call()


def test_patterns_are_lit_in_every_state_and_follow_the_seed():
    plan = PatternPlan((4, 6), patterns=5, share=0.4, seed=3)
    inputs = plan.inputs.toarray().reshape(2, 24, 5, 3)
    lit = np.abs(inputs) > 0
    assert np.all(lit == lit[:1, :, :, :1])
    assert np.all(lit[0, :, :, 0].sum(0) == 10)
    # the field at every point is a phase times the state
    phases = inputs[0] / plan.illumination[0]
    np.testing.assert_allclose(np.abs(phases[lit[0]]), 1)
    np.testing.assert_allclose(inputs[1], phases * plan.illumination[1])
    np.testing.assert_allclose(phases, np.repeat(phases[..., :1], 3, 2))
    assert plan.hash == PatternPlan((4, 6), patterns=5, share=0.4, seed=3).hash
    assert plan.hash != PatternPlan((4, 6), patterns=5, share=0.4, seed=4).hash
    assert [step.kind for step in plan.captures[:2]] == ["reference", "spots"]


@pytest.mark.parametrize(("change", "text"), [({"share": 1.5}, "share must be <= 1"), ({"patterns": 0}, "patterns")])
def test_wrong_settings_of_patterns_are_named(change, text):
    with pytest.raises(ValueError, match=text):
        PatternPlan(**change)


def test_the_papers_times_and_what_its_upgrades_buy():
    """Its own numbers (24.9 s, 40.5 and 50.8 min), and the errata's: 0.50 s and 92 s, 0.17 s and 20 to 24 s."""
    plan = CalibrationPlan((27, 36), stride=9, reference_every=5)
    assert len(plan.captures) == 293
    assert plan.duration(Timing()) / 60 == pytest.approx(40.5, abs=0.05)
    table = {u.name: u for u in upgrades()}
    published = table["as published"]
    assert published.sample == pytest.approx(24.9)
    assert published.calibration / 60 == pytest.approx(50.8)
    together = table["all three"]
    assert together.sample == pytest.approx(0.503, abs=0.001)
    assert together.calibration == pytest.approx(92.4, abs=0.1)
    bound = table["only the 60 Hz modulator binds"]
    assert bound.sample == pytest.approx(1 / 6)
    assert bound.calibration == pytest.approx(24.4, abs=0.05)
    assert table["the same without reference captures"].calibration == pytest.approx(20.25)
    claimed = [u for u in upgrades() if u.claim is not None]
    assert all(published.sample / u.sample == pytest.approx(u.claim) for u in claimed)


def test_a_duration_is_made_of_its_parts():
    bracket = Bracket(0.08, 2.0, 0.02)
    timing = Timing.of_parts(bracket, modulator_rate=50.0, settle=0.1, camera_rate=20.0, overhead=5.0)
    assert timing.image == pytest.approx(0.02 + 0.1 + 0.08 + 0.05 + 0.05)
    assert Timing.of_parts(bracket, exposures=1).image == pytest.approx(1 / 60 + 0.08)
    plan = SamplePlan(references=1)
    assert plan.duration(timing) == pytest.approx(7 * 11 * timing.image + 5)
    for change, name in (({"modulator_rate": 0}, "modulator_rate"), ({"settle": -1}, "settle"),
                         ({"exposures": 0}, "exposures")):  # fmt: skip
        with pytest.raises(ValueError, match=name):
            Timing.of_parts(bracket, **change)
    with pytest.raises(ValueError, match="image"):
        Timing(image=0.0)
