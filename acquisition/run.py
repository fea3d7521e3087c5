"""Execute a plan on a bench into a folder, and hand over the record that the fibre package consumes.

In: a bench, a plan, a folder. Out: :class:`fibre.Calibration` or :class:`fibre.Recording`. Both verbs resume: a
capture whose frames are complete in the folder is not taken again.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from acquisition.contracts import AnyBench, leave_safely
from acquisition.errors import DeviceLost, DeviceTimeout, FrameLost
from acquisition.images import expose, merged_images
from acquisition.plan import GridPlan, Plan, SamplePlan, Step, Views
from acquisition.recording import Folder
from fibre import Calibration, Images, Recording
from polinfer.checks import one_of_types, real_number

__all__ = ["calibrate", "capture"]

WAITS = (0.5, 2.0, 5.0)  # seconds before a capture is taken anew


def calibrate(
    bench: AnyBench,
    plan: GridPlan,
    folder: str | Path,
    progress: bool = False,
    reference_seconds: float | None = None,
) -> Calibration:
    """Capture a calibration, or what is missing of it in ``folder``.

    A run that was cut off begins again with a reference, and what lies after its last reference is taken again: drift
    is never interpolated over the gap. ``reference_seconds``: take a further reference where the last is older than
    that (the paper's 60 s); None: those of the plan only. On every way out the bench is made safe.

    Raises RunMismatch (a ValueError) where the folder holds another plan's or another bench's run, TypeError for
    other plans.
    """
    one_of_types("plan", plan, (GridPlan,), "pass CalibrationPlan(...) or PatternPlan(...).")
    store = _execute(bench, plan, folder, plan.points, progress, reference_seconds)
    spots = [step for step in plan.captures if step.kind == "spots"]
    return Calibration(
        _images(bench, plan.views, store, [step.id for step in spots]),
        plan.inputs,
        plan.points,
        plan.grid,
        _images(bench, plan.views, store, _references(store)),
        bench.registration,
    )


def capture(
    bench: AnyBench,
    plan: SamplePlan,
    folder: str | Path,
    progress: bool = False,
    reference_seconds: float | None = None,
) -> Recording:
    """Capture a sample with its blank and reference, or what is missing of them in ``folder``.

    Raises as :func:`calibrate`; ValueError for a plan without blank or reference, which a Recording needs.
    """
    one_of_types("plan", plan, (SamplePlan,), "pass SamplePlan(...).")
    if not plan.blank or plan.references < 1:
        raise ValueError("plan must have a blank and a reference to make a Recording; it has not.")
    store = _execute(bench, plan, folder, None, progress, reference_seconds)
    parts = {
        kind: _images(bench, plan.views, store, [step.id for step in plan.captures if step.kind == kind])
        for kind in ("sample", "blank")
    }
    references = _images(bench, plan.views, store, _references(store))
    return Recording(parts["sample"], plan.illumination, parts["blank"], references)


def _references(store: Folder) -> list[str]:
    """All of them, those that an interruption or the clock has added too, in the order of their times."""
    found = [identity for identity in store.done if identity.startswith("reference")]
    return sorted(found, key=lambda identity: store.done[identity]["time"])


def _execute(
    bench: AnyBench, plan: Plan, folder: str | Path, points: np.ndarray | None, progress: bool, every: float | None
) -> Folder:
    if every is not None:
        real_number("reference_seconds", every, above=0)
    store = Folder(folder, {"plan": plan.hash, "bench": bench.describe()})
    if store.done:
        bench.continue_from(max(line["ended"] for line in store.done.values()))
    steps = _to_be_taken(plan, store)
    bar = tqdm(total=len(plan.captures), desc=type(plan).__name__, unit="capture", disable=not progress)
    bar.update(max(len(plan.captures) - len(steps), 0))
    last: float | None = None  # when the last reference of this segment was finished
    segment = 1 + max((line.get("segment", 0) for line in store.done.values()), default=-1)
    try:
        for step in steps:
            since = None if last is None else bench.time() - last
            if every is not None and since is not None and since > every and step.kind != "reference":
                extra = Step(_fresh(store, "reference-clock"), "reference")
                _surely(bench, plan, extra, points, store, segment=segment, late=since - every)
                last = bench.time()
            _surely(bench, plan, step, points, store, segment=segment)
            if step.kind == "reference":
                last = bench.time()
            bar.update()
    except BaseException as error:
        leave_safely(bench.make_safe, error)
        raise
    finally:
        bar.close()
    bench.make_safe()
    return store


def _to_be_taken(plan: Plan, store: Folder) -> list[Step]:
    """What is missing. Where something is there already, a reference comes first, and what was taken after the last
    reference of before is taken again: drift is not to be interpolated over the gap."""
    steps = list(plan.captures)
    missing = [step for step in steps if not store.complete(step.id)]
    if not missing or not store.done:
        return missing
    closes = steps[-1].kind == "reference"
    order = list(store.done)
    if closes:
        last = max((i for i, identity in enumerate(order) if identity.startswith("reference")), default=-1)
        for identity in order[last + 1 :]:
            store.void(identity)
        missing = [step for step in steps if not store.complete(step.id)]
    if any(step.kind == "reference" for step in steps):
        if missing[0].kind != "reference":
            missing.insert(0, Step(_fresh(store, "reference-again"), "reference"))
        if closes and missing[-1].kind != "reference":
            missing.append(Step(_fresh(store, "reference-after"), "reference"))
    return missing


def _fresh(store: Folder, name: str) -> str:
    """A name that no line of the manifest can have: lines are never removed."""
    return f"{name}-{store.lines}"


def _surely(bench: AnyBench, plan: Plan, step: Step, points: np.ndarray | None, store: Folder, **more: Any) -> None:
    """One capture, taken anew where a frame or a device was lost on the way."""
    for wait in WAITS:
        try:
            _take(bench, plan, step, points, store, **more)
            return
        except (DeviceLost, DeviceTimeout, FrameLost):
            time.sleep(wait)
    _take(bench, plan, step, points, store, **more)


def _take(bench: AnyBench, plan: Plan, step: Step, points: np.ndarray | None, store: Folder, **more: Any) -> None:
    """One capture: all exposures of all its views, then on the disk."""
    taken = expose(bench, step, plan.views, plan.illumination, points)
    store.store(
        step.id,
        taken.counts,
        taken.exposures,
        taken.started,
        taken.ended,
        blocks=[[frame.block for frame in image] for image in taken.images],
        saturated=[[int((frame.counts >= bench.full_scale).sum()) for frame in image] for image in taken.images],
        **more,
    )


def _images(bench: AnyBench, views: Views, store: Folder, names: list[str]) -> Images:
    return merged_images(bench, views, store, {name: store.done[name]["time"] for name in names})
