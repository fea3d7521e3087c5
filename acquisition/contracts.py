"""What a bench must be able to do, whether simulated or real. Plans are executed against this and nothing else."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from acquisition.exposure import MergeRule
from acquisition.plan import Step, Views

__all__ = ["Bench"]


@runtime_checkable
class Bench(Protocol):
    """A camera, the modulators in front of it, and a sample that can be put in or left out.

    wavelength, pixel_size (at the facet): metres. full_scale: count at saturation. merge_rule: how this camera's
    exposures are merged. registration: (2, 3) affine map from distal to camera coordinates.
    """

    wavelength: float
    pixel_size: float
    full_scale: int
    merge_rule: MergeRule
    registration: np.ndarray

    def describe(self) -> dict[str, Any]:
        """Everything that must not change within a run, as JSON: serial numbers, settings, frame size."""

    def prepare(self, step: Step, views: Views, illumination: np.ndarray, points: np.ndarray | None) -> None:
        """Show the step's pattern and place the sample; returns when both have settled."""

    def expose(self, view: int, exposure: float) -> np.ndarray:
        """One raw frame (y, x) of counts of the given view of the prepared step; exposure in seconds."""

    def time(self) -> float:
        """Seconds on a monotonic clock."""

    def continue_from(self, seconds: float) -> None:
        """A run that is resumed was at this time when it was cut off: the clock goes on from there, not before it."""
