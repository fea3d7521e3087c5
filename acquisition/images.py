"""From raw exposures to images: a bracket is merged when its image is asked for, from a disk or from memory alike.

In: a step of a plan and a bench; raw frames. Out: :class:`fibre.Images` that read lazily. Called by runs and streams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from acquisition.contracts import AnyBench, Frame, bracketed
from acquisition.exposure import MergeRule
from acquisition.merging import Merged, merge_views
from acquisition.plan import Step, Views
from fibre import Images

__all__ = ["Exposed", "Held", "MergedStack", "RawCaptures", "expose", "merged_images"]


class RawCaptures(Protocol):
    """Where raw frames are: a folder, the memory, a simulation."""

    def load(self, identity: str) -> tuple[Sequence[np.ndarray], Sequence[Sequence[float]]]:
        """Raw frames (k, y, x) of every image of a capture, and their exposures in seconds."""


@dataclass(frozen=True)
class Exposed:
    """One capture as it was taken: ``images[i]`` the frames of view i, longest exposure first; ``started`` and
    ``ended`` by the clock of the bench."""

    images: list[list[Frame]]
    started: float
    ended: float

    @property
    def counts(self) -> list[np.ndarray]:
        """Raw frames (k, y, x) of every image."""
        return [np.stack([frame.counts for frame in image]) for image in self.images]

    @property
    def exposures(self) -> list[list[float]]:
        """Seconds, as the camera says they were."""
        return [[frame.exposure for frame in image] for image in self.images]


def expose(bench: AnyBench, step: Step, views: Views, states: np.ndarray, points: np.ndarray | None) -> Exposed:
    """All exposures of all views of a step; ``states`` of illumination and ``points`` as the plan has them."""
    bench.prepare(step, views, states, points)
    started = bench.time()
    images = [bracketed(bench, view, views.bracket) for view in range(len(views))]
    return Exposed(images, started, bench.time())


class Held:
    """Raw captures in memory, by the names of their steps; ``times``: when each began."""

    def __init__(self, captures: dict[str, Exposed]) -> None:
        self._raw = {name: (one.counts, one.exposures) for name, one in captures.items()}
        self.times = {name: one.started for name, one in captures.items()}

    def load(self, identity: str) -> tuple[list[np.ndarray], list[list[float]]]:
        """See :class:`RawCaptures`."""
        return self._raw[identity]


@dataclass(frozen=True)
class MergedStack:
    """A (capture, image, y, x) array that merges raw exposures when a capture is asked for.

    ``part`` is the field of :class:`acquisition.Merged` to show: radiance, variance or saturated. The last capture
    merged is remembered in ``cache``, which the three stacks of a run share, since all are asked for in turn.
    """

    raw: RawCaptures
    identities: tuple[str, ...]
    full_scale: int
    rule: MergeRule
    shape: tuple[int, int, int, int]
    part: str
    cache: dict[str, Merged]

    @property
    def dtype(self) -> np.dtype:
        """float32, or bool for the saturation mask."""
        return np.dtype(bool if self.part == "saturated" else np.float32)

    def __len__(self) -> int:
        return len(self.identities)

    def __getitem__(self, index: int) -> np.ndarray:
        identity = self.identities[index]
        if identity not in self.cache:
            frames, exposures = self.raw.load(identity)
            self.cache.clear()
            self.cache[identity] = merge_views(frames, exposures, self.full_scale, self.rule)
        part: np.ndarray = getattr(self.cache[identity], self.part).view()
        part.flags.writeable = False  # it is the cache's own
        return part

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("a lazy stack cannot be an array without a copy.")
        whole = np.stack([self[i] for i in range(len(self))])
        return whole if dtype is None else whole.astype(dtype)


def merged_images(bench: AnyBench, views: Views, raw: RawCaptures, times: dict[str, float]) -> Images:
    """Images of the captures that ``times`` names, in its order, with when each began."""
    identities = tuple(times)
    frames, _ = raw.load(identities[0])
    shape = (len(identities), len(views), *frames[0].shape[-2:])
    cache: dict[str, Merged] = {}
    radiance, variance, saturated = (
        MergedStack(raw, identities, bench.full_scale, bench.merge_rule, shape, part, cache)
        for part in ("radiance", "variance", "saturated")
    )
    return Images(
        radiance,
        variance,
        saturated,
        np.array(views.diversity),
        np.array(views.steps),
        np.array(list(times.values())),
        bench.wavelength,
        bench.pixel_size,
    )
