"""A run can be cut off anywhere and resumed: nothing is lost, nothing taken twice, nothing foreign believed."""

import hashlib
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from acquisition import (
    CalibrationPlan,
    DeviceLost,
    SamplePlan,
    SimulatedBench,
    calibrate,
    capture,
    merge_exposures,
)
from acquisition.recording import Folder
from fibre import Calibration, Recording
from tests.acquisition.benches import PLAN, SAMPLE, SCENE, VIEWS, bench


class Interrupted(Exception):
    pass


class Flaky:
    """A bench that counts its exposures and breaks after so many of them."""

    def __init__(self, inner, limit=None):
        self.inner, self.limit, self.exposed = inner, limit, []

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def expose(self, view, exposure):
        if self.limit is not None and len(self.exposed) >= self.limit:
            raise Interrupted
        self.exposed.append((self.inner._step.id, view, exposure))
        return self.inner.expose(view, exposure)


def raw_files(folder):
    """Those of the plan; references that an interruption has added are apart."""
    return {p.name: p.read_bytes() for p in folder.glob("*.npz") if not p.name.startswith(ADDED)}


def added(folder):
    return sorted(p.stem for p in folder.glob("*.npz") if p.name.startswith(ADDED))


ADDED = ("reference-again", "reference-after", "reference-clock")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted calibration: its folder, its record and its exposures."""
    folder, b = tmp_path_factory.mktemp("whole"), Flaky(bench())
    record = calibrate(b, PLAN, folder)
    return folder, record, b.exposed


def test_a_run_makes_the_record_that_the_plan_describes(whole):
    _, record, _ = whole
    assert isinstance(record, Calibration)
    spots = [step for step in PLAN.captures if step.kind == "spots"]
    assert record.images.radiance.shape == (len(spots), len(VIEWS), 64, 64)
    assert record.references.captures == len(PLAN.captures) - len(spots)
    np.testing.assert_array_equal(record.inputs.toarray(), PLAN.inputs.toarray())
    np.testing.assert_array_equal(record.points, PLAN.points)
    np.testing.assert_array_equal(record.images.diversity, VIEWS.diversity)
    assert np.all(np.diff(record.images.times) > 0)


def test_a_bracket_stops_at_the_first_exposure_without_saturation(whole):
    folder, _, exposed = whole
    saturated = 0
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as stored:
            for name in stored.files:
                peaks = stored[name].max((1, 2))
                assert np.all(peaks[:-1] == 4095)
                saturated += len(peaks) - 1
    assert saturated > 0
    assert len(exposed) == len(set(exposed)) == len(PLAN.captures) * len(VIEWS) + saturated


@pytest.mark.parametrize("fraction", [0.0, 0.13, 0.5, 0.99])
def test_an_interrupted_run_resumes_with_the_same_bytes_and_takes_nothing_twice(whole, fraction, tmp_path):
    folder, record, exposed = whole
    first = Flaky(bench(), limit=int(fraction * len(exposed)))
    with pytest.raises(Interrupted):
        calibrate(first, PLAN, tmp_path)
    kept = set(raw_files(tmp_path))
    second = Flaky(bench())
    resumed = calibrate(second, PLAN, tmp_path)
    assert raw_files(tmp_path) == raw_files(folder)
    # what was complete before the last reference is not exposed again; only what lies after it is
    done = [step.id for step in PLAN.captures if f"{step.id}.npz" in kept]
    last = max((i for i, name in enumerate(done) if name.startswith("reference")), default=-1)
    assert not {step for step, _, _ in second.exposed} & set(done[: last + 1])
    assert {step for step, _, _ in second.exposed} >= set(done[last + 1 :])
    # a reference comes first
    assert second.exposed[0][0].startswith("reference")
    assert resumed.references.captures == record.references.captures + len(added(tmp_path))
    assert np.all(np.diff(resumed.references.times) > 0)
    np.testing.assert_array_equal(np.asarray(resumed.images.radiance), np.asarray(record.images.radiance))
    np.testing.assert_array_equal(resumed.images.times.shape, record.images.times.shape)


def test_a_resumed_run_never_interpolates_drift_over_the_gap(tmp_path):
    """Between any capture and the references around it lies no interruption."""
    moving = replace(SCENE, piston_walk=0.3, tilt_walk=2e4, image_time=1.0)
    with pytest.raises(Interrupted):
        calibrate(Flaky(SimulatedBench(moving, rng=1), limit=40), PLAN, tmp_path)
    record = calibrate(SimulatedBench(moving, rng=1), PLAN, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "manifest.jsonl").read_text().splitlines()[1:]]
    valid = {}
    for line in lines:
        valid.pop(line["id"], None)
        if not line.get("void"):
            valid[line["id"]] = line
    order = sorted(valid.values(), key=lambda line: line["time"])
    assert {line["segment"] for line in order} == {0, 1}
    for before, after in itertools.pairwise(order):
        if before["segment"] != after["segment"]:
            assert before["id"].startswith("reference")
            assert after["id"].startswith("reference")
    assert order[0]["id"].startswith("reference")
    assert order[-1]["id"].startswith("reference")
    assert len(record.references.times) == len(added(tmp_path)) + sum(s.kind == "reference" for s in PLAN.captures)


def test_a_reference_is_taken_when_the_last_is_too_old(tmp_path):
    slow = replace(SCENE, image_time=1.0)
    record = calibrate(SimulatedBench(slow, rng=1), PLAN, tmp_path, reference_seconds=12.0)
    extra = [name for name in added(tmp_path) if name.startswith("reference-clock")]
    assert extra
    times = np.sort(np.concatenate([record.references.times, record.images.times]))
    gaps = np.diff(record.references.times)
    assert gaps.max() < 12.0 + 2 * np.diff(times).max()
    with pytest.raises(ValueError, match="reference_seconds"):
        calibrate(bench(), PLAN, tmp_path / "b", reference_seconds=0.0)


def test_the_bench_is_made_safe_on_every_way_out(tmp_path):
    class Watched(Flaky):
        safe = 0

        def make_safe(self):
            self.safe += 1

    good = Watched(bench())
    capture(good, SAMPLE, tmp_path / "good")
    assert good.safe == 1
    bad = Watched(bench(), limit=5)
    with pytest.raises(Interrupted):
        capture(bad, SAMPLE, tmp_path / "bad")
    assert bad.safe == 1

    class Dark(Flaky):
        def make_safe(self):
            raise DeviceLost("the laser does not answer")

    with pytest.raises(Interrupted) as caught:
        capture(Dark(bench(), limit=5), SAMPLE, tmp_path / "dark")
    assert "laser" in caught.value.__notes__[0]
    with pytest.raises(DeviceLost):
        capture(Dark(bench()), SAMPLE, tmp_path / "dark")


def test_a_capture_in_which_a_device_was_lost_is_taken_anew(whole, tmp_path, monkeypatch):
    monkeypatch.setattr("acquisition.run.WAITS", (0.0, 0.0))

    class Loose(Flaky):
        losses = 2

        def expose(self, view, exposure):
            if self.losses and len(self.exposed) == 17:
                self.losses -= 1
                raise DeviceLost("unplugged")
            return super().expose(view, exposure)

    calibrate(Loose(bench()), PLAN, tmp_path / "twice")
    assert raw_files(tmp_path / "twice") == raw_files(whole[0])
    often = Loose(bench())
    often.losses = 10
    with pytest.raises(DeviceLost):
        calibrate(often, PLAN, tmp_path / "often")
    assert often.losses == 7


def test_many_interruptions_are_survived(whole, tmp_path):
    folder, _, exposed = whole
    for limit in range(1, len(exposed)):
        try:
            calibrate(Flaky(bench(), limit=20 + limit), PLAN, tmp_path)
        except Interrupted:
            continue
        break
    assert limit > 3
    assert raw_files(tmp_path) == raw_files(folder)


def copy(whole, tmp_path):
    for name, raw in raw_files(whole[0]).items():
        (tmp_path / name).write_bytes(raw)
    (tmp_path / "manifest.jsonl").write_bytes((whole[0] / "manifest.jsonl").read_bytes())
    return tmp_path / "manifest.jsonl"


def test_a_finished_run_takes_nothing_again(whole, tmp_path):
    copy(whole, tmp_path)
    again = Flaky(bench(), limit=0)
    calibrate(again, PLAN, tmp_path)
    assert again.exposed == []


@pytest.mark.parametrize("cut", [1, 30])
def test_a_torn_last_line_is_dropped_and_that_capture_retaken(whole, cut, tmp_path):
    manifest = copy(whole, tmp_path)
    manifest.write_bytes(manifest.read_bytes()[:-cut])
    again = Flaky(bench())
    calibrate(again, PLAN, tmp_path)
    # with what lies after the reference before it
    last = max(i for i, step in enumerate(PLAN.captures[:-1]) if step.kind == "reference")
    again_for = {step.id for step in PLAN.captures[last + 1 :]}
    assert {step for step, _, _ in again.exposed} - set(added(tmp_path)) == again_for
    assert raw_files(tmp_path) == raw_files(whole[0])
    assert all(json.loads(line) for line in manifest.read_text().splitlines())


def test_a_torn_header_starts_anew(tmp_path):
    (tmp_path / "manifest.jsonl").write_bytes(b'{"plan": "a')
    record = capture(bench(), SAMPLE, tmp_path)
    assert isinstance(record, Recording)


@pytest.mark.parametrize("damage", ["flip", "remove"])
def test_a_damaged_raw_file_is_named_when_it_is_read(whole, damage, tmp_path):
    copy(whole, tmp_path)
    record = calibrate(bench(), PLAN, tmp_path)
    name = [step.id for step in PLAN.captures if step.kind == "spots"][2] + ".npz"
    raw = bytearray((tmp_path / name).read_bytes())
    raw[len(raw) // 2] ^= 1
    (tmp_path / name).write_bytes(raw)
    if damage == "remove":
        (tmp_path / name).unlink()
    np.asarray(record.images.radiance[1])
    with pytest.raises(ValueError, match=f"{name} is damaged or missing"):
        record.images.radiance[2]


def test_a_file_of_another_size_or_a_missing_one_is_taken_again(whole, tmp_path):
    copy(whole, tmp_path)
    cut, gone = (PLAN.captures[i].id for i in (2, 5))
    (tmp_path / f"{cut}.npz").write_bytes(b"short")
    (tmp_path / f"{gone}.npz").unlink()
    again = Flaky(bench())
    calibrate(again, PLAN, tmp_path)
    assert {step for step, _, _ in again.exposed} == {cut, gone, *added(tmp_path)}
    assert [name.rsplit("-", 1)[0] for name in added(tmp_path)] == ["reference-after", "reference-again"]
    assert raw_files(tmp_path) == raw_files(whole[0])


def test_another_plan_or_bench_in_the_same_folder_is_refused(whole, tmp_path):
    copy(whole, tmp_path)
    before = raw_files(tmp_path)
    other = CalibrationPlan((4, 4), stride=2, reference_every=6, views=VIEWS)
    with pytest.raises(ValueError, match=r"another run \(plan differ\)"):
        calibrate(bench(), other, tmp_path)
    with pytest.raises(ValueError, match=r"another run \(bench differ\)"):
        calibrate(bench(seed=8), PLAN, tmp_path)
    with pytest.raises(ValueError, match=r"another run \(bench, plan differ\)"):
        capture(bench(seed=8), SAMPLE, tmp_path)
    assert raw_files(tmp_path) == before


@pytest.mark.parametrize(
    "content",
    [b"hello\n", b'{"some": 1}\n', b"[1]\n", b"3\n", b"\x80\x81\n", b"{}\n\n", b'{"plan": 1}\n{"file": "a"}\n'],
)
def test_a_foreign_manifest_is_refused_and_names_the_folder(content, tmp_path):
    (tmp_path / "manifest.jsonl").write_bytes(content)
    with pytest.raises(ValueError, match=f"folder {tmp_path}"):
        capture(bench(), SAMPLE, tmp_path)
    assert (tmp_path / "manifest.jsonl").read_bytes() == content


def test_a_manifest_line_that_lacks_a_part_is_refused(whole, tmp_path):
    manifest = copy(whole, tmp_path)
    lines = manifest.read_text().splitlines()
    for missing in ("bytes", "sha256", "exposures", "time", "ended"):
        line = json.loads(lines[3])
        del line[missing]
        manifest.write_text("\n".join([*lines[:3], json.dumps(line), *lines[4:]]) + "\n")
        with pytest.raises(ValueError, match=f"folder {tmp_path}"):
            calibrate(bench(), PLAN, tmp_path)


def test_a_damaged_line_in_the_middle_is_refused(whole, tmp_path):
    manifest = copy(whole, tmp_path)
    lines = manifest.read_bytes().splitlines(keepends=True)
    lines[3] = lines[3][:20] + b"\n"
    manifest.write_bytes(b"".join(lines))
    with pytest.raises(ValueError, match=r"damaged manifest\.jsonl"):
        calibrate(bench(), PLAN, tmp_path)


def test_an_object_array_in_a_raw_file_is_not_unpickled(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    header = {"plan": "a", "bench": "b"}
    folder = Folder(tmp_path, header)
    np.savez(tmp_path / "step.npz", image_000=np.array([Bomb()], dtype=object))
    raw = (tmp_path / "step.npz").read_bytes()
    line = {"id": "step", "file": "step.npz", "bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest(),
            "exposures": [[0.1]], "time": 0.0, "ended": 0.1}  # fmt: skip
    folder._append(line)
    again = Folder(tmp_path, header)
    assert again.complete("step")
    with pytest.raises(ValueError, match="allow_pickle=False"):
        again.load("step")


def test_the_lazy_stack_is_the_eager_merge(whole):
    folder, record, _ = whole
    b = bench()
    spots = [step.id for step in PLAN.captures if step.kind == "spots"]
    manifest = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()[1:]]
    exposures = {line["id"]: line["exposures"] for line in manifest}
    stacks = {name: np.asarray(getattr(record.images, name)) for name in ("radiance", "variance", "saturated")}
    for i in (0, 7, len(spots) - 1):
        with np.load(folder / f"{spots[i]}.npz") as stored:
            for v in range(len(VIEWS)):
                merged = merge_exposures(stored[f"image_{v:03d}"], exposures[spots[i]][v], 4095, b.merge_rule)
                for name, stack in stacks.items():
                    np.testing.assert_array_equal(stack[i, v], getattr(merged, name).astype(stack.dtype))
    assert record.images.radiance.dtype == stacks["radiance"].dtype == np.float32
    assert len(record.images.radiance) == len(spots)
    with pytest.raises(ValueError, match="without a copy"):
        np.asarray(record.images.radiance, copy=False)


def test_a_sample_run_has_one_capture_per_state_with_and_without_the_sample(tmp_path):
    record = capture(bench(), SAMPLE, tmp_path)
    assert record.images.captures == record.blank.captures == 3
    np.testing.assert_array_equal(record.illumination, SAMPLE.illumination)
    assert not np.array_equal(np.asarray(record.images.radiance), np.asarray(record.blank.radiance))


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda folder: calibrate(bench(), SAMPLE, folder), TypeError, "plan must be GridPlan.*pass CalibrationPlan"),
        (lambda folder: capture(bench(), PLAN, folder), TypeError, "plan must be SamplePlan"),
        (lambda folder: capture(bench(), SamplePlan(blank=False), folder), ValueError, "plan must have a blank"),
        (lambda folder: capture(bench(), SamplePlan(references=0), folder), ValueError, "plan must have a blank"),
    ],
)
def test_wrong_plans_are_named_and_nothing_is_made(call, error, text, tmp_path):
    with pytest.raises(error, match=text):
        call(tmp_path / "run")
    assert not (tmp_path / "run").exists()
