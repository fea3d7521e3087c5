"""Captures that are simulated when they are read: calibrations larger than a disk would hold as raw frames."""

from __future__ import annotations

import numpy as np

from acquisition import GridPlan, SimulatedBench
from acquisition.images import Exposed, expose, merged_images
from fibre import Calibration


class _Live:
    """Raw captures of a bench, exposed when they are asked for; the last one is remembered."""

    def __init__(self, bench: SimulatedBench, plan: GridPlan) -> None:
        self.bench, self.plan = bench, plan
        self.steps = {step.id: step for step in plan.captures}
        self.last: tuple[str, Exposed] | None = None

    def load(self, identity: str) -> tuple[list[np.ndarray], list[list[float]]]:
        if self.last is None or self.last[0] != identity:
            plan = self.plan
            self.last = identity, expose(self.bench, self.steps[identity], plan.views, plan.illumination, plan.points)
        return self.last[1].counts, self.last[1].exposures


def calibration(bench: SimulatedBench, plan: GridPlan) -> Calibration:
    """As :func:`acquisition.calibrate` would make it, without a folder."""
    raw = _Live(bench, plan)
    spots, references = (
        merged_images(bench, plan.views, raw, {s.id: float(i) for i, s in enumerate(plan.captures) if s.kind == kind})
        for kind in ("spots", "reference")
    )
    return Calibration(spots, plan.inputs, plan.points, plan.grid, references, bench.registration)
