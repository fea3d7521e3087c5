"""Frames as they come: a bench, an inverse matrix and a model make maps one after the other, in a stated time.

In: what measures, and a model. Out: fits with their latency, and how many frames were dropped. Called by users. A frame
that cannot be worked on in time is never queued: the newest counts, the others are dropped and counted.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from acquisition.contracts import AnyBench
from acquisition.images import Held, expose, merged_images
from acquisition.plan import SamplePlan
from fibre import Images, Inverse, Recording, RecordingFields, reconstruct, retrieve_fields, retrieve_sample
from fibre.retrieval.base import RetrievalMethod
from polinfer import Fit, Measurement, Model, fit
from polinfer.checks import integer, one_of_types, real_number

__all__ = ["FibreImager", "Imager", "StreamedFrame", "stream"]


@runtime_checkable
class Imager(Protocol):
    """What measures: raw data of a frame, quickly, and Jones data from it, in the time that it takes."""

    def expose(self, plan: SamplePlan) -> Any:
        """Everything that must be done while the light is on."""

    def measurement(self, raw: Any) -> Measurement:
        """Jones data from what :meth:`expose` gave."""


class FibreImager:
    """A bench behind a fibre whose inverse is known.

    The reference and the blank are captured once, when the first frame is asked for; of every frame the sample alone.

    bench: simulated or of devices. inverse: from ``fibre.recover``. method: of retrieval, for instance
    ``fibre.Modal(inverse.calibration.fibrelets)``.
    """

    def __init__(self, bench: AnyBench, inverse: Inverse, method: RetrievalMethod) -> None:
        one_of_types("inverse", inverse, (Inverse,), "make it with fibre.recover().")
        self.bench, self.inverse, self.method = bench, inverse, method
        self._first: Recording | None = None
        self._fields: RecordingFields | None = None

    def expose(self, plan: SamplePlan) -> Images:
        """Images of the sample in all states; their brackets are merged when they are read."""
        if self._first is None:
            parts = {kind: self._images(plan, kind) for kind in ("reference", "blank", "sample")}
            self._first = Recording(parts["sample"], plan.illumination, parts["blank"], parts["reference"])
            return parts["sample"]
        return self._images(plan, "sample")

    def measurement(self, raw: Images) -> Measurement:
        """Fields, then Jones matrices at the distal points."""
        calibration = self.inverse.calibration
        if self._first is None:
            raise ValueError("raw must be of this imager; call expose first.")
        if self._fields is None:
            self._fields = retrieve_fields(self._first, self.method, calibration.fibrelets)
            if raw is self._first.images:
                return reconstruct(self.inverse, self._fields)
        return reconstruct(self.inverse, retrieve_sample(raw, self.method, calibration, self._fields))

    def _images(self, plan: SamplePlan, kind: str) -> Images:
        steps = [step for step in plan.captures if step.kind == kind]
        raw = Held({step.id: expose(self.bench, step, plan.views, plan.illumination, None) for step in steps})
        return merged_images(self.bench, plan.views, raw, raw.times)


@dataclass(frozen=True)
class StreamedFrame:
    """number: of the exposure, from 0; those that are missing were dropped. fit, measurement: of this frame. latency:
    seconds from the end of its exposure to its fit. seconds: of the stages "expose", "measurement" and "fit". dropped:
    frames dropped since the last one. late: the latency is above the budget. binds: the stage that takes longest."""

    number: int
    fit: Fit
    measurement: Measurement
    latency: float
    seconds: dict[str, float]
    dropped: int
    late: bool

    @property
    def binds(self) -> str:
        """The stage that a faster stream would have to shorten first."""
        return max(self.seconds, key=lambda stage: self.seconds[stage])


@dataclass
class _Slot:
    """The newest frame, and what has been dropped for it."""

    ready: threading.Condition = field(default_factory=threading.Condition)
    newest: tuple[int, Any, float, float] | None = None
    dropped: int = 0
    ended: bool = False
    error: BaseException | None = None
    stopped: bool = False


def stream(
    bench: Imager,
    plan: SamplePlan,
    model: Model,
    budget: float,
    period: float = 0.0,
    frames: int | None = None,
) -> Iterator[StreamedFrame]:
    """Fits of one frame after the other, each begun from the last.

    Exposures run in a thread of their own at ``period``. A frame that is exposed while an earlier one is still being
    worked on waits; if a newer one comes, the newer waits in its place and the older is dropped and counted. So latency
    is bounded by the work on two frames, whatever the rate.

    Parameters
    ----------
    bench: what measures, for instance ``FibreImager(bench, inverse, method)``. plan: the sample's states and views.
    model: of the pixels. budget: seconds that a frame may take from the end of its exposure to its fit; later ones are
    marked ``late``. period: seconds from one exposure to the next, 0: as fast as the bench can. frames: how many are
    exposed; None: until the iterator is closed.

    Raises TypeError, ValueError for wrong arguments; errors of the bench come out of the iterator, after the frames
    that were exposed before.
    """
    one_of_types("plan", plan, (SamplePlan,), "pass SamplePlan(...).")
    one_of_types("model", model, (Model,), "pass a Model.")
    if not isinstance(bench, Imager):
        raise TypeError(f"bench must measure (expose, measurement), got {type(bench).__name__}; pass FibreImager(...).")
    real_number("budget", budget, above=0)
    real_number("period", period, low=0)
    if frames is not None:
        integer("frames", frames, low=1)
    return _streamed(bench, plan, model, budget, period, frames)


def _streamed(
    bench: Imager, plan: SamplePlan, model: Model, budget: float, period: float, frames: int | None
) -> Iterator[StreamedFrame]:
    slot = _Slot()
    thread = threading.Thread(target=_expose, args=(slot, bench, plan, period, frames), daemon=True)
    thread.start()
    last: Fit | None = None
    try:
        while True:
            with slot.ready:
                slot.ready.wait_for(lambda: slot.newest is not None or slot.ended)
                if slot.newest is None:
                    break
                (number, raw, exposed, ended), slot.newest = slot.newest, None
                dropped, slot.dropped = slot.dropped, 0
            start = time.perf_counter()
            measurement = bench.measurement(raw)
            middle = time.perf_counter()
            last = fit(model, measurement, start=last)
            end = time.perf_counter()
            seconds = {"expose": exposed, "measurement": middle - start, "fit": end - middle}
            yield StreamedFrame(number, last, measurement, end - ended, seconds, dropped, end - ended > budget)
        if slot.error is not None:
            raise slot.error
    finally:
        slot.stopped = True
        thread.join()


def _expose(slot: _Slot, bench: Imager, plan: SamplePlan, period: float, frames: int | None) -> None:
    number, due = 0, time.perf_counter()
    try:
        while not slot.stopped and (frames is None or number < frames):
            start = time.perf_counter()
            raw = bench.expose(plan)
            end = time.perf_counter()
            with slot.ready:
                slot.dropped += slot.newest is not None
                slot.newest = (number, raw, end - start, end)
                slot.ready.notify()
            number += 1
            due = max(due + period, end)
            while not slot.stopped and (left := due - time.perf_counter()) > 0:
                time.sleep(min(left, 0.05))
    except BaseException as error:  # every end of the thread must wake the iterator, which raises it
        slot.error = error
    finally:
        with slot.ready:
            slot.ended = True
            slot.ready.notify()
