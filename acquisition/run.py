"""Execute a plan on a bench into a folder, and hand over the record that the fibre package consumes.

In: a bench, a plan, a folder. Out: :class:`fibre.Calibration` or :class:`fibre.Recording`. Both verbs resume: a
capture whose frames are complete in the folder is not taken again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tqdm import tqdm

from acquisition.contracts import AnyBench
from acquisition.plan import GridPlan, Plan, SamplePlan, Step, Views
from acquisition.recording import Folder, MergedStack
from fibre import Calibration, Images, Recording
from polinfer.checks import one_of_types

__all__ = ["calibrate", "capture"]


def calibrate(bench: AnyBench, plan: GridPlan, folder: str | Path, progress: bool = False) -> Calibration:
    """Capture a calibration, or what is missing of it in ``folder``.

    Raises ValueError where the folder holds another plan's or another bench's run, TypeError for other plans.
    """
    one_of_types("plan", plan, (GridPlan,), "pass CalibrationPlan(...) or PatternPlan(...).")
    store = _execute(bench, plan, folder, plan.points, progress)
    spots = [step for step in plan.captures if step.kind == "spots"]
    references = [step for step in plan.captures if step.kind == "reference"]
    return Calibration(
        _images(bench, plan.views, store, spots),
        plan.inputs,
        plan.points,
        plan.grid,
        _images(bench, plan.views, store, references),
        bench.registration,
    )


def capture(bench: AnyBench, plan: SamplePlan, folder: str | Path, progress: bool = False) -> Recording:
    """Capture a sample with its blank and reference, or what is missing of them in ``folder``.

    Raises as :func:`calibrate`; ValueError for a plan without blank or reference, which a Recording needs.
    """
    one_of_types("plan", plan, (SamplePlan,), "pass SamplePlan(...).")
    if not plan.blank or plan.references < 1:
        raise ValueError("plan must have a blank and a reference to make a Recording; it has not.")
    store = _execute(bench, plan, folder, None, progress)
    parts = {
        kind: _images(bench, plan.views, store, [step for step in plan.captures if step.kind == kind])
        for kind in ("sample", "blank", "reference")
    }
    return Recording(parts["sample"], plan.illumination, parts["blank"], parts["reference"])


def _execute(bench: AnyBench, plan: Plan, folder: str | Path, points: np.ndarray | None, progress: bool) -> Folder:
    store = Folder(folder, {"plan": plan.hash, "bench": bench.describe()})
    for step in tqdm(plan.captures, desc=type(plan).__name__, unit="capture", disable=not progress):
        if store.complete(step.id):
            bench.continue_from(store.done[step.id]["ended"])
            continue
        bench.prepare(step, plan.views, plan.illumination, points)
        started = bench.time()
        frames, exposures = [], []
        for view in range(len(plan.views)):
            stack, times = [], []
            for exposure in plan.views.bracket.times():
                stack.append(bench.expose(view, exposure))
                times.append(exposure)
                if stack[-1].max() < bench.full_scale:
                    break
            frames.append(np.stack(stack))
            exposures.append(times)
        store.store(step.id, frames, exposures, started, bench.time())
    return store


def _images(bench: AnyBench, views: Views, store: Folder, steps: list[Step]) -> Images:
    identities = tuple(step.id for step in steps)
    frames, _ = store.load(identities[0])
    shape = (len(steps), len(views), *frames[0].shape[-2:])
    cache: dict = {}
    radiance, variance, saturated = (
        MergedStack(store, identities, bench.full_scale, bench.merge_rule, shape, part, cache)
        for part in ("radiance", "variance", "saturated")
    )
    return Images(
        radiance,
        variance,
        saturated,
        np.array(views.diversity),
        np.array(views.steps),
        np.array([store.done[i]["time"] for i in identities]),
        bench.wavelength,
        bench.pixel_size,
    )
