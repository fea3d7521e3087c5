"""Frames as they come: latency, drops, and whether the maps are those of a fit at leisure.

A sample that turns in front of an instrument that gives Jones data at once (no fibre), 27 x 36 pixels, three states,
sigma 0.02: 600 frames at a declared rate with a stated budget; then the same where Jones data take longer than a
period. Then through a fibre: raw brackets of the demo's camera, 200 x 200 pixels of 8 bits, to maps of 10 x 10 points.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import fibre
import polinfer
from acquisition import FibreImager, SamplePlan, SimulatedBench, calibrate, stream
from acquisition.demo import demo_setup
from benchmarks.results import Results
from fibre import Images
from polinfer import ComplexGain, Measurement, Model, RetarderFirst, phantoms
from polinfer.orderings.on_host import jones_on_host
from polinfer.validation import jones_chi_square

SHAPE, SIGMA = (27, 36), 0.02
STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)


class Turning:
    """A half-wave plate that turns by a hundredth of a radian a frame; ``work`` seconds until its data are there."""

    def __init__(self, count: int, work: float) -> None:
        model, self.work, self.number = Model(), work, 0
        self.frames = []
        for k in range(count):
            plate = phantoms.half_wave_plate(SHAPE, angles=0.3 + 0.01 * k)
            self.frames.append(polinfer.simulate(model, plate.parameters, STATES, SIGMA, rng=k))

    def expose(self, plan: SamplePlan) -> int:  # noqa: ARG002
        """See :class:`acquisition.Imager`."""
        self.number += 1
        return self.number - 1

    def measurement(self, raw: int) -> Measurement:
        """See :class:`acquisition.Imager`."""
        time.sleep(self.work)
        return self.frames[raw]


def off_by(found: polinfer.Fit, offline: polinfer.Fit) -> float:
    """Largest difference of identified parameters, in posterior standard deviations."""
    worst = 0.0
    parts = zip(found.parameters._fields, found.parameters, offline.parameters, offline.std, strict=True)
    for name, ours, theirs, std in parts:
        told = (np.asarray(offline.status) & int(polinfer.Status.unidentified(name))) == 0
        apart = np.angle(np.exp(2j * (np.asarray(ours) - np.asarray(theirs)))) / 2
        told &= np.isfinite(std) & (np.asarray(std) > 0)
        worst = max(worst, float(np.abs(apart[told] / np.asarray(std)[told]).max(initial=0)))
    return worst


def run(results: Results, count: int, period: float, work: float, budget: float) -> None:
    """One stream; the first ten frames, which compile, are left out of the latencies."""
    bench = Turning(count, work)
    start = time.perf_counter()
    found = list(stream(bench, SamplePlan(), Model(), budget, period, count))
    spent = time.perf_counter() - start
    latencies = np.array([f.latency for f in found[10:]])
    dropped = sum(f.dropped for f in found)
    looked_at = found[10 :: max(len(found) // 60, 1)]
    apart = [off_by(f.fit, polinfer.fit(Model(), bench.frames[f.number])) for f in looked_at]
    binds = max({f.binds for f in found}, key=[f.binds for f in found].count)
    results.add(frames=count, period_ms=1e3 * period, work_ms=1e3 * work, budget_ms=1e3 * budget, fitted=len(found),
                dropped=dropped, late=sum(f.late for f in found[10:]), median_ms=1e3 * float(np.median(latencies)),
                percentile_99_ms=1e3 * float(np.quantile(latencies, 0.99)), seconds=spent, binds=binds,
                off_by_std=max(apart))  # fmt: skip
    if work < period:
        results.bar("median latency over the budget", float(np.median(latencies)) / budget, 1.0)
    results.bar("frames fitted or counted as dropped", len(found) + dropped, count, at_least=True)
    results.bar("maps off the offline fit's, standard deviations", max(apart), 0.1)


class Replayed(FibreImager):
    """Raw frames of several benches, one each, taken before: the simulator takes no time from the stream."""

    def __init__(self, benches: Sequence[SimulatedBench], inverse: fibre.Inverse, plan: SamplePlan) -> None:
        super().__init__(benches[0], inverse, fibre.Modal(inverse.calibration.fibrelets))
        self.frames, self.number = [], 0
        for self.bench in benches:
            self.frames.append(super().expose(plan))

    def expose(self, plan: SamplePlan) -> Images:  # noqa: ARG002
        """See :class:`acquisition.Imager`."""
        self.number += 1
        return self.frames[self.number - 1]


def behind_a_fibre(results: Results, count: int, period: float) -> None:
    """A plate that turns behind the demo's fibre; everything is compiled before."""
    setup, model = demo_setup(0, (10, 10)), Model(gain=ComplexGain(1.0))
    with tempfile.TemporaryDirectory() as folder:
        calibration = calibrate(SimulatedBench(setup.scene, rng=0), setup.calibration, folder)
        fields = fibre.retrieve_fields(calibration, setup.method(None), fibre.fibrelets_of(calibration))
    inverse = fibre.recover(fields, fibre.ForwardInverse())
    plates = [phantoms.half_wave_plate((10, 10), angles=0.3 + 0.02 * k) for k in range(count)]
    benches = [SimulatedBench(replace(setup.scene, phantom=plate), rng=k) for k, plate in enumerate(plates)]
    imager, last = Replayed(benches, inverse, setup.sample), None
    for raw in imager.frames[:2]:
        last = polinfer.fit(model, imager.measurement(raw), start=last)
    found = list(stream(imager, setup.sample, model, period, period, count))
    dropped = sum(f.dropped for f in found)
    latencies = np.array([f.latency for f in found])
    inside = np.zeros((10, 10), bool)
    inside[1:-1, 1:-1] = True
    parts = [jones_chi_square(f.fit, jones_on_host(RetarderFirst(), plates[f.number].parameters)) for f in found]
    value, freedom = (np.nansum(part, axis=0) for part in zip(*parts, strict=True))
    apart = max(off_by(f.fit, polinfer.fit(model, f.measurement)) for f in found)
    results.add(fibre_frames=count, period_ms=1e3 * period, budget_ms=1e3 * period, fitted=len(found), dropped=dropped,
                late=sum(f.late for f in found), median_ms=1e3 * float(np.median(latencies)),
                percentile_99_ms=1e3 * float(np.quantile(latencies, 0.99)),
                measurement_ms=1e3 * float(np.median([f.seconds["measurement"] for f in found])),
                fit_ms=1e3 * float(np.median([f.seconds["fit"] for f in found])), binds=found[-1].binds,
                chi_square_inside=value[inside].sum() / freedom[inside].sum(),
                chi_square_edge=value[~inside].sum() / freedom[~inside].sum(), off_by_std=apart)  # fmt: skip
    results.bar("fibre: median latency over the budget", float(np.median(latencies)) / period, 1.0)
    results.bar("fibre: frames fitted or counted as dropped", len(found) + dropped, count, at_least=True)
    results.bar("fibre: maps off the offline fit's, standard deviations", apart, 0.1)


def main(full: bool = False) -> None:
    """Print the table."""
    results = Results("streaming")
    count = 600 if full else 200
    run(results, count, period=0.05, work=0.0, budget=0.05)
    run(results, count, period=0.02, work=0.05, budget=0.1)
    behind_a_fibre(results, 60 if full else 12, period=1.0)
    results.save()


if __name__ == "__main__":
    main()
