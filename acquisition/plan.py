"""What is to be captured, as data: ordered steps with ids, a hash, and a duration on paper.

In: sizes and settings. Out: a plan that any bench can execute and anyone can read. Called by ``calibrate`` and
``capture``.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse

from acquisition.exposure import Bracket
from polinfer.checks import integer, one_of_types, real_array, real_number

__all__ = [
    "CalibrationPlan",
    "GridPlan",
    "PatternPlan",
    "Plan",
    "SamplePlan",
    "Step",
    "Timing",
    "Upgrade",
    "Views",
    "elliptical_states",
    "upgrades",
]


def elliptical_states(count: int = 3) -> np.ndarray:
    r"""Balanced states :math:`(1, e^{2 \pi i k / n}) / \sqrt 2`, complex (2, n): sum of u u^H is n/2 times identity.

    >>> u = elliptical_states(3)
    >>> bool(np.allclose(u @ u.conj().T, 1.5 * np.eye(2)))
    True
    """
    count = integer("count", count, low=2)
    return np.stack([np.ones(count), np.exp(2j * np.pi * np.arange(count) / count)]) / np.sqrt(2)


@dataclass(frozen=True)
class Timing:
    """Seconds that images take. image: of one image, its exposures included; the default is the paper's 8.3 s for the
    11 images of a capture. overhead: of a whole run, beside its images.

    The paper states 50.8 minutes for its calibration, of which 293 captures of 8.3 s are 40.5; that the rest is
    overhead is an assumption, as it does not say.

    >>> round(CalibrationPlan((27, 36), stride=9, reference_every=5).duration(Timing(overhead=PAPER_OVERHEAD)) / 60, 1)
    50.8
    """

    image: float = 8.3 / 11
    overhead: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", real_number("image", self.image, above=0))
        object.__setattr__(self, "overhead", real_number("overhead", self.overhead, low=0))

    @classmethod
    def of_parts(
        cls,
        bracket: Bracket,
        modulator_rate: float = 60.0,
        settle: float = 0.0,
        camera_rate: float = 1000.0,
        exposures: int | None = None,
        overhead: float = 0.0,
    ) -> Timing:
        """From what an image is made of: a new pattern (1 / modulator_rate, hertz, and ``settle`` seconds), then the
        exposures of the bracket, each at least 1 / camera_rate. exposures: how many of the bracket are needed, from the
        longest; None: all.

        >>> round(Timing.of_parts(Bracket(0.064, 2, 0.016), settle=0.3).image, 4)
        0.4287
        """
        rates = [
            real_number(n, v, above=0) for n, v in (("modulator_rate", modulator_rate), ("camera_rate", camera_rate))
        ]
        times = list(bracket.times())[: None if exposures is None else integer("exposures", exposures, low=1)]
        shown = 1 / rates[0] + real_number("settle", settle, low=0)
        return cls(shown + sum(max(time, 1 / rates[1]) for time in times), overhead)


PAPER_OVERHEAD = 50.8 * 60 - 293 * 8.3  # seconds, assumed: see Timing


@dataclass(frozen=True)
class Upgrade:
    """What one change makes of the paper's times, seconds. sample, calibration: of its 33 images of a sample and its
    293 captures. claim: by which factor the paper says it is faster, None where it says nothing."""

    name: str
    sample: float
    calibration: float
    claim: float | None = None


def upgrades() -> list[Upgrade]:
    """The paper's proposals on paper, one by one and together; and what binds when all the rest costs nothing.

    It hopes for "together below 0.2 s" a sample and 22 s a calibration. The product of its own factors gives 0.50 s and
    92 s; the modulator's 60 Hz alone would allow 0.17 s and 20 to 24 s.

    >>> table = {u.name: u for u in upgrades()}
    >>> round(table["all three"].sample, 2), round(table["all three"].calibration)
    (0.5, 92)
    """
    image, captures, spots, states, images = 8.3 / 11, 293, 243, 3, 11
    sample, calibration = states * images * image, captures * images * image + PAPER_OVERHEAD
    fast, few = 15.0, 5

    def bound(rate: float, count: int = few, shown: int = 2) -> tuple[float, float]:
        return shown * count / rate, captures * count / rate

    return [
        Upgrade("as published", sample, calibration),
        Upgrade("faster camera and modulator", sample / fast, calibration / fast, fast),
        Upgrade("five images instead of eleven", sample * few / images, calibration * few / images, images / few),
        Upgrade("two states instead of three, samples only", sample * 2 / 3, calibration, 1.5),
        Upgrade("all three", sample * few / images * 2 / 3 / fast, calibration * few / images / fast, 49.5),
        Upgrade("phase steps side by side in one image: 8 images", sample * 8 / images, calibration * 8 / images),
        Upgrade("only the 60 Hz modulator binds", *bound(60.0)),
        Upgrade("the same without reference captures", bound(60.0)[0], spots * few / 60.0),
        Upgrade("only a 1.4 kHz micromirror device binds", *bound(1440.0)),
    ]


@dataclass(frozen=True)
class Step:
    """One capture: what is lit. ``kind`` is reference (the reference spot alone), spots, blank or sample; ``points``
    are the lit distal points of a spots step, ``amplitudes`` theirs (none: 1), ``state`` the column of the plan's
    states."""

    id: str
    kind: str
    points: tuple[int, ...] = ()
    state: int = 0
    amplitudes: tuple[complex, ...] = ()

    @property
    def light(self) -> np.ndarray:
        """Amplitudes of the points, (len(points),), with 1 where none are stated."""
        return np.array(self.amplitudes) if self.amplitudes else np.ones(len(self.points))


@dataclass(frozen=True)
class Views:
    """The images of one capture, and how each is exposed.

    diversity: (m,) metres of defocus of the H images. steps: (k,) radians of V against H in the interference images,
    k >= 3. bracket: exposures of every image.
    """

    diversity: tuple[float, ...] = tuple(np.linspace(-120e-6, 120e-6, 7).tolist())
    steps: tuple[float, ...] = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)
    bracket: Bracket = field(default_factory=lambda: Bracket(longest=64e-3, factor=2.0, stop=0.25e-3))

    def __post_init__(self) -> None:
        for name in ("diversity", "steps"):
            values = real_array(name, getattr(self, name), shape=(None,), finite=True)
            object.__setattr__(self, name, tuple(values.tolist()))
        one_of_types("bracket", self.bracket, (Bracket,), "pass Bracket(longest, factor, stop).")

    def __len__(self) -> int:
        return len(self.diversity) + len(self.steps)


class Plan(ABC):
    """An ordered list of captures that share their views and illumination states."""

    views: Views
    states: int

    @cached_property
    @abstractmethod
    def captures(self) -> tuple[Step, ...]:
        """The steps in order."""

    @property
    def illumination(self) -> np.ndarray:
        """The states, complex (2, n)."""
        return elliptical_states(self.states)

    def duration(self, timing: Timing) -> float:
        """Seconds that the plan takes on paper.

        >>> round(SamplePlan(blank=False, references=0).duration(Timing()), 1)  # the paper's 24.9 s
        24.9
        """
        one_of_types("timing", timing, (Timing,), "pass Timing(image=seconds).")
        return len(self.captures) * len(self.views) * timing.image + timing.overhead

    @property
    def hash(self) -> str:
        """SHA-256 of everything that decides what is captured; a resumed run must have the same."""
        text = json.dumps([type(self).__name__, repr(self), [repr(step) for step in self.captures]])
        return hashlib.sha256(text.encode()).hexdigest()


class GridPlan(Plan):
    """A plan that lights points of a grid with known amplitudes: what a calibration can be made of.

    grid: (rows, columns) of distal points. pitch: metres between them. reference_every: captures between images of the
    reference spot alone (the paper's 60 s are 7 captures).
    """

    grid: tuple[int, int]
    pitch: float
    reference_every: int

    def _check_grid(self) -> None:
        rows, columns = self.grid
        object.__setattr__(self, "grid", (integer("grid", rows, low=1), integer("grid", columns, low=1)))
        # kept as plain numbers: the hash must not depend on which kind of number was given
        object.__setattr__(self, "pitch", real_number("pitch", self.pitch, above=0))
        for name, low in (("states", 2), ("reference_every", 1)):
            object.__setattr__(self, name, integer(name, getattr(self, name), low=low))
        one_of_types("views", self.views, (Views,), "pass Views(...).")

    @property
    @abstractmethod
    def spots(self) -> list[Step]:
        """The captures that light points, in order."""

    @cached_property
    def points(self) -> np.ndarray:
        """Distal points, (p, 2) metres, row by row, centred."""
        index = np.indices(self.grid).reshape(2, -1).T
        return (index - (np.array(self.grid) - 1) / 2) * self.pitch

    @cached_property
    def captures(self) -> tuple[Step, ...]:
        """See :class:`Plan`."""
        steps: list[Step] = []
        for count, spot in enumerate(self.spots):
            if count % self.reference_every == 0:
                steps.append(Step(f"reference-{count // self.reference_every}", "reference"))
            steps.append(spot)
        steps.append(Step("reference-last", "reference"))
        return tuple(steps)

    @property
    def inputs(self) -> scipy.sparse.csr_array:
        """Amplitudes at the points in every spots step, sparse complex (2 p, captures)."""
        count = len(self.points)
        spots = [step for step in self.captures if step.kind == "spots"]
        row, column, value = [], [], []
        for capture, step in enumerate(spots):
            for polarisation in range(2):
                row += [polarisation * count + point for point in step.points]
                column += [capture] * len(step.points)
                value += (self.illumination[polarisation, step.state] * step.light).tolist()
        return scipy.sparse.csr_array((np.array(value), (row, column)), shape=(2 * count, len(spots)))


@dataclass(frozen=True)
class CalibrationPlan(GridPlan):
    """Every distal point lit in every state, spots that are ``stride`` points apart at the same time.

    grid: (rows, columns) of distal points. pitch: metres between them. stride: points between parallel spots, per
    axis; stride^2 translations cover the grid. states: number of illumination states, >= 2. reference_every: captures
    between images of the reference spot alone (the paper's 60 s are 7 captures). views: images of a capture.

    >>> plan = CalibrationPlan(grid=(4, 6), stride=2)
    >>> sum(step.kind == "spots" for step in plan.captures)  # 4 translations x 3 states
    12
    """

    grid: tuple[int, int] = (18, 18)
    pitch: float = 4.2e-6
    stride: int = 4
    states: int = 3
    reference_every: int = 7
    views: Views = field(default_factory=Views)

    def __post_init__(self) -> None:
        self._check_grid()
        object.__setattr__(self, "stride", integer("stride", self.stride, low=1))

    @property
    def spots(self) -> list[Step]:
        """See :class:`GridPlan`."""
        index = np.arange(self.grid[0] * self.grid[1]).reshape(self.grid)
        spots = []
        for row in range(min(self.stride, self.grid[0])):
            for column in range(min(self.stride, self.grid[1])):
                lit = tuple(int(i) for i in index[row :: self.stride, column :: self.stride].ravel())
                for state in range(self.states):
                    spots.append(Step(f"spots-{row}-{column}-state-{state}", "spots", lit, state))
        return spots


@dataclass(frozen=True)
class PatternPlan(GridPlan):
    """Random patterns: a random share of the points lit with random phases, the same in every state.

    Neighbouring points are lit at the same time, so that intensities alone tell the transmission matrix
    (:class:`fibre.IntensityOnly`). A point carries less light than in a :class:`CalibrationPlan` of the same laser.

    grid: (rows, columns) of distal points. pitch: metres between them. patterns: >= 1. share: of the points lit in a
    pattern, 0 < share <= 1. seed: of patterns and phases. states, reference_every, views: as in
    :class:`CalibrationPlan`.

    >>> plan = PatternPlan(grid=(4, 6), patterns=5)
    >>> plan.inputs.shape  # 5 patterns x 3 states
    (48, 15)
    """

    grid: tuple[int, int] = (18, 18)
    pitch: float = 4.2e-6
    patterns: int = 60
    share: float = 0.5
    seed: int = 0
    states: int = 3
    reference_every: int = 7
    views: Views = field(default_factory=Views)

    def __post_init__(self) -> None:
        self._check_grid()
        object.__setattr__(self, "patterns", integer("patterns", self.patterns, low=1))
        object.__setattr__(self, "seed", integer("seed", self.seed, low=0))
        object.__setattr__(self, "share", real_number("share", self.share, above=0))
        if self.share > 1:
            raise ValueError(f"share must be <= 1, got {self.share}.")

    @property
    def spots(self) -> list[Step]:
        """See :class:`GridPlan`."""
        generator = np.random.default_rng(self.seed)
        count = self.grid[0] * self.grid[1]
        spots = []
        for pattern in range(self.patterns):
            lit = np.sort(generator.choice(count, max(1, round(self.share * count)), replace=False))
            phases = tuple(np.exp(2j * np.pi * generator.random(len(lit))).tolist())
            for state in range(self.states):
                spots.append(Step(f"pattern-{pattern}-state-{state}", "spots", tuple(lit.tolist()), state, phases))
        return spots


@dataclass(frozen=True)
class SamplePlan(Plan):
    """The sample in every state, with captures of the reference spot and (``blank``) of the scene without a sample.

    References are spread evenly, the first before everything else, the last after it (a single one before): drift is
    interpolated between them.
    """

    states: int = 3
    blank: bool = True
    references: int = 2
    views: Views = field(default_factory=Views)

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", integer("states", self.states, low=2))
        object.__setattr__(self, "blank", bool(self.blank))
        object.__setattr__(self, "references", integer("references", self.references, low=0))
        one_of_types("views", self.views, (Views,), "pass Views(...).")

    @cached_property
    def captures(self) -> tuple[Step, ...]:
        """See :class:`Plan`."""
        steps = []
        if self.blank:
            steps += [Step(f"blank-state-{state}", "blank", (), state) for state in range(self.states)]
        steps += [Step(f"sample-state-{state}", "sample", (), state) for state in range(self.states)]
        before = np.round(np.linspace(0, len(steps), self.references)).astype(int) if self.references > 1 else [0]
        for i in reversed(range(self.references)):
            steps.insert(int(before[i]), Step(f"reference-{i}", "reference"))
        return tuple(steps)
