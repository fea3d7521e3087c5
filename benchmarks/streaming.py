"""Frames as they come: latency, drops, and whether the maps are those of a fit at leisure.

A sample that turns in front of an instrument that gives Jones data at once (no fibre), 27 x 36 pixels, three states,
sigma 0.02: 600 frames at a declared rate with a stated budget; then the same where Jones data take longer than a
period.
"""

from __future__ import annotations

import time

import numpy as np

import polinfer
from acquisition import SamplePlan, stream
from benchmarks.results import Results
from polinfer import Measurement, Model, phantoms

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
    results.bar("frames fitted or counted as dropped", len(found) + dropped, count, at_least=True)
    results.bar("maps off the offline fit's, standard deviations", max(apart), 0.1)


def main(full: bool = False) -> None:
    """Print the table."""
    results = Results("streaming")
    count = 600 if full else 200
    run(results, count, period=0.05, work=0.0, budget=0.05)
    run(results, count, period=0.02, work=0.05, budget=0.1)
    results.save()


if __name__ == "__main__":
    main()
