"""Frames as they come are the frames fitted at leisure; what is dropped is counted, and errors come out."""

import time

import numpy as np
import pytest

import polinfer
from acquisition import FibreImager, SamplePlan, SimulatedBench, capture, stream
from fibre import ForwardInverse, reconstruct, recover, retrieve_fields
from polinfer import ComplexGain, Model, phantoms
from tests.fibre.benches import METHOD, SAMPLE

STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)


class Series:
    """A sample that turns, measured in no time; ``work`` seconds to make Jones data of a frame."""

    def __init__(self, work=0.0, exposure=0.0, fails_at=None):
        self.work, self.exposure, self.fails_at, self.count = work, exposure, fails_at, 0

    def truth(self, number):
        frame = phantoms.half_wave_plate((6, 7), angles=0.3 + 0.01 * number)
        return polinfer.simulate(Model(), frame.parameters, STATES, 0.02, rng=number)

    def expose(self, plan):
        if self.count == self.fails_at:
            raise RuntimeError("the light went out")
        time.sleep(self.exposure)
        self.count += 1
        return self.count - 1

    def measurement(self, raw):
        time.sleep(self.work)
        return self.truth(raw)


def test_streamed_fits_are_the_offline_fits():
    series = Series(exposure=0.02)
    found = list(stream(series, SamplePlan(), Model(), budget=10.0, period=0.05, frames=30))
    assert [f.number for f in found] == sorted({f.number for f in found})
    assert len(found) + sum(f.dropped for f in found) == 30
    for frame in found[3:]:
        offline = polinfer.fit(Model(), series.truth(frame.number))
        for ours, theirs, std in zip(frame.fit.parameters, offline.parameters, offline.std, strict=True):
            off = np.angle(np.exp(2j * (ours - theirs))) / 2  # modulo pi: equivalent sets and wraps
            known = np.isfinite(std) & (std < 0.3)
            assert np.abs(off[known] / std[known]).max(initial=0) < 0.1
        assert not frame.late
        assert frame.latency >= frame.seconds["measurement"] + frame.seconds["fit"]
        assert frame.binds in frame.seconds


def test_overload_drops_are_counted_and_late_frames_marked():
    series = Series(work=0.05)
    found = list(stream(series, SamplePlan(), Model(), budget=0.01, period=0.01, frames=60))
    dropped = sum(f.dropped for f in found)
    assert dropped > 10
    assert len(found) + dropped == 60
    assert found[-1].number == 59  # the newest is never the one that is dropped
    assert all(f.late for f in found)
    # latency is that of the work on two frames at most, however long the stream
    work = [f.seconds["measurement"] + f.seconds["fit"] for f in found]
    assert all(f.latency < work[i] + work[i - 1] + 0.5 for i, f in enumerate(found) if i > 0)


def test_an_error_of_the_bench_comes_out_after_the_frames_before_it():
    found = []
    with pytest.raises(RuntimeError, match="light went out"):
        for frame in stream(Series(fails_at=3, exposure=0.3), SamplePlan(), Model(), budget=1.0):
            found.append(frame.number)
    assert found[-1] == 2
    assert found == sorted(found)


def test_a_stream_that_is_left_stops_its_bench():
    series = Series(exposure=0.01)
    running = stream(series, SamplePlan(), Model(), budget=1.0)
    next(running)
    running.close()
    count = series.count
    time.sleep(0.1)
    assert series.count == count


def test_a_fibre_is_streamed_as_its_recordings_are_reconstructed(bench, tmp_path):
    """Through images, retrieval and inverse matrix; the later frames retrieve the sample alone."""
    inverse = recover(bench.calibration_fields, ForwardInverse())
    imager = FibreImager(SimulatedBench(bench.scene, rng=3), inverse, METHOD)
    model = Model(gain=ComplexGain(1.0))
    found = list(stream(imager, SAMPLE, model, budget=60.0, period=0.0, frames=2))
    fields = retrieve_fields(capture(SimulatedBench(bench.scene, rng=3), SAMPLE, tmp_path / "run"), METHOD,
                             bench.calibration_fields.fibrelets)  # fmt: skip
    offline = reconstruct(inverse, fields)
    first = next(f for f in found if f.number == 0) if found[0].number == 0 else None
    if first is not None:
        np.testing.assert_allclose(first.measurement.response, offline.response, rtol=1e-5)
    later = found[-1].measurement
    scale = np.vdot(later.response, offline.response) / np.vdot(later.response, later.response)
    assert abs(abs(scale) - 1) < 0.02
    error = np.linalg.norm(scale * later.response - offline.response) / np.linalg.norm(offline.response)
    assert error < 0.05
    np.testing.assert_allclose(later.illumination, offline.illumination, rtol=1e-5)


@pytest.mark.parametrize(("change", "error", "text"), [
    ({"bench": 3}, TypeError, "bench must measure"), ({"plan": None}, TypeError, "plan"),
    ({"model": None}, TypeError, "model"), ({"budget": 0}, ValueError, "budget"),
    ({"period": -1}, ValueError, "period"), ({"frames": 0}, ValueError, "frames"),
])  # fmt: skip
def test_wrong_arguments_are_named_at_once(change, error, text):
    good = {"bench": Series(), "plan": SamplePlan(), "model": Model(), "budget": 1.0}
    with pytest.raises(error, match=text):
        stream(**(good | change))
