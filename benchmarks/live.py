"""Captures that are simulated when they are read: calibrations larger than a disk would hold as raw frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from acquisition import GridPlan, SimulatedBench, Step
from acquisition.contracts import bracketed
from acquisition.exposure import merge_views
from fibre import Calibration, Images


@dataclass
class _Live:
    """One part (radiance, variance, saturated) of a (capture, image, y, x) stack; the last capture is remembered."""

    bench: SimulatedBench
    plan: GridPlan
    steps: list[Step]
    part: str
    cache: dict = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        return (len(self.steps), len(self.plan.views), *self.bench.scene.camera.shape)

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> np.ndarray:
        step, bench = self.steps[index], self.bench
        if step.id not in self.cache:
            bench.prepare(step, self.plan.views, self.plan.illumination, self.plan.points)
            images = [bracketed(bench, view, self.plan.views.bracket) for view in range(len(self.plan.views))]
            counts = [np.stack([frame.counts for frame in image]) for image in images]
            times = [[frame.exposure for frame in image] for image in images]
            self.cache.clear()
            self.cache[step.id] = merge_views(counts, times, bench.full_scale, bench.merge_rule)
        return getattr(self.cache[step.id], self.part)


def calibration(bench: SimulatedBench, plan: GridPlan) -> Calibration:
    """As :func:`acquisition.calibrate` would make it, without a folder."""

    def images(kind: str) -> Images:
        steps, cache = [step for step in plan.captures if step.kind == kind], {}
        stacks = [_Live(bench, plan, steps, part, cache) for part in ("radiance", "variance", "saturated")]
        views = plan.views
        return Images(*stacks, np.array(views.diversity), np.array(views.steps), np.arange(len(steps), dtype=float),
                      bench.wavelength, bench.pixel_size)  # fmt: skip

    return Calibration(images("spots"), plan.inputs, plan.points, plan.grid, images("reference"), bench.registration)
