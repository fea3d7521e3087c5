"""What a comparison of models says, pixel by pixel and pooled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .judgement import CERTAIN, OUTSTANDING, UNDECIDED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .cross_validation import LeaveOneOut

__all__ = ["Comparison", "PooledEvidence"]


def _index(models: tuple[str, ...], name: str) -> int:
    if name not in models:
        raise ValueError(f"model {name!r} is not among those compared; they are {', '.join(models)}.")
    return models.index(name)


@dataclass(frozen=True, eq=False)
class PooledEvidence:
    """Evidence for models of all data of a scene or a region, every datum counted once.

    Attributes
    ----------
    models: names. units: number of terms of the sum: pixels, or disjoint tiles where parameters are shared over a
        window.
    log_evidence: (model,), nats. error: its standard error by Monte Carlo, NaN where it is not known (a Laplace
        approximation has an error, but no estimate of it).
    scatter: (model,), standard deviation of the difference from the best model as the spread between the units makes
        it; 0 for the best itself, NaN with one unit.
    probabilities: (model,), given that one of the models holds everywhere.
    verdict: name of the model that is found, or "undecided": the best probability is below 0.95, or its lead over some
        other model is less than 1.96 times the scatter (:mod:`polinfer.comparison.judgement` says why).
    """

    models: tuple[str, ...]
    units: int
    log_evidence: np.ndarray
    error: np.ndarray
    scatter: np.ndarray
    probabilities: np.ndarray
    verdict: str
    pair_scatter: np.ndarray = field(repr=False)

    @property
    def reason(self) -> str:
        """Why the verdict is what it is, one line."""
        if not self.units:
            return "no unit of data has an answer from all models"
        best = int(np.argmax(self.probabilities))
        if self.probabilities[best] < CERTAIN:
            return f"the best probability is {self.probabilities[best]:.2f}, below {CERTAIN}"
        if self.verdict != UNDECIDED:
            return f"probability {self.probabilities[best]:.3f}, and the lead stands out of the scatter"
        lead = self.log_evidence[best] - self.log_evidence
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(np.arange(len(lead)) == best, np.inf, lead / self.scatter)
        other = int(np.nanargmin(ratio))
        return (
            f"the lead of {self.models[best]} over {self.models[other]}, {lead[other]:.1f} nat, is {ratio[other]:.1f} "
            f"times the scatter, below {OUTSTANDING:.2f}"
        )

    def bayes_factor(self, first: str, second: str) -> tuple[float, float, float]:
        """Logarithm of the Bayes factor for ``first`` against ``second``, its standard error, and its scatter (nats).

        The error is that of the evidences (NaN: not known); the scatter is what the spread between the units makes.
        """
        a, b = _index(self.models, first), _index(self.models, second)
        error = float(np.hypot(self.error[a], self.error[b])) if a != b else 0.0
        return float(self.log_evidence[a] - self.log_evidence[b]), error, float(self.pair_scatter[a, b])


@dataclass(frozen=True, eq=False)
class Comparison:
    """Models compared by their evidence, see :func:`polinfer.compare`.

    Attributes
    ----------
    models: names, in the order given. prior: (model,), probabilities before the data.
    log_evidence: ``(model, *P)``, nats. log_evidence_error: its standard error, NaN where it is not known.
    probabilities: ``(model, *P)``, of each pixel by itself; NaN without an answer from all models, and everywhere if
        only some models share parameters over a window, because a pixel's evidences are then not of the same data.
    pixel_verdict: ``(*P)`` str: the model whose probability is at least 0.95, "undecided", or "" without an answer.
    status: ``(*P)``, the status bits of all models together. scene: the whole frame pooled.
    regions: the same of each region by its label; empty without regions.
    second_opinion: leave-one-out predictive densities pooled as the evidences are, None without draws of all models.
    leave_one_out: by model, empty without draws. notes: what a reader should know about the evidences.
    """

    models: tuple[str, ...]
    prior: np.ndarray
    log_evidence: np.ndarray
    log_evidence_error: np.ndarray
    probabilities: np.ndarray
    pixel_verdict: np.ndarray
    status: np.ndarray
    scene: PooledEvidence
    regions: Mapping[int, PooledEvidence] = field(default_factory=dict)
    second_opinion: PooledEvidence | None = None
    leave_one_out: Mapping[str, LeaveOneOut] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def pooled(self) -> np.ndarray:
        """Log evidence of the whole frame, (model,)."""
        return self.scene.log_evidence

    @property
    def pooled_probabilities(self) -> np.ndarray:
        """Probabilities of the models given the whole frame, (model,)."""
        return self.scene.probabilities

    @property
    def verdict(self) -> str:
        """Name of the model found for the whole frame, or "undecided"."""
        return self.scene.verdict

    def bayes_factor(self, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
        """Logarithm of the Bayes factor for ``first`` against ``second`` in every pixel, and its standard error."""
        a, b = _index(self.models, first), _index(self.models, second)
        return self.log_evidence[a] - self.log_evidence[b], np.hypot(*self.log_evidence_error[[a, b]])

    def rows(self) -> list[dict[str, Any]]:
        """The table as dicts: one of every model for the scene, and for every region."""
        found = []
        for name, part in [("scene", self.scene), *((f"region {k}", v) for k, v in self.regions.items())]:
            top = float(np.max(part.log_evidence))
            found += [
                {
                    "where": name,
                    "model": model,
                    "units": part.units,
                    "log_evidence": float(part.log_evidence[i]),
                    "below_best": top - float(part.log_evidence[i]),
                    "error": float(part.error[i]),
                    "scatter": float(part.scatter[i]),
                    "probability": float(part.probabilities[i]),
                    "verdict": part.verdict,
                }
                for i, model in enumerate(self.models)
            ]
        return found

    def table(self) -> str:
        """The comparison as text: a row for each model, the verdict and its reason below."""
        head = ("where", "model", "units", "log evidence", "below best", "± error", "± scatter", "probability")
        body = [
            (r["where"], r["model"], str(r["units"]), f"{r['log_evidence']:.2f}", f"{r['below_best']:.2f}",
             _number(r["error"]), _number(r["scatter"]), f"{r['probability']:.4f}")
            for r in self.rows()
        ]  # fmt: skip
        widths = [max(len(row[i]) for row in [head, *body]) for i in range(len(head))]
        sides = (str.ljust, str.ljust, *(str.rjust,) * (len(head) - 2))
        lines = ["  ".join(side(t, w) for side, t, w in zip(sides, row, widths, strict=True)) for row in [head, *body]]
        lines += [f"verdict: {self.verdict} ({self.scene.reason})"]
        lines += [f"verdict in region {k}: {part.verdict} ({part.reason})" for k, part in self.regions.items()]
        if self.second_opinion is not None:
            lines += [f"leave-one-out: {self.second_opinion.verdict} ({self.second_opinion.reason})"]
        names, counts = np.unique(self.pixel_verdict[self.pixel_verdict != ""], return_counts=True)
        if len(names):
            lines += ["pixels: " + ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))]
        return "\n".join([*(line.rstrip() for line in lines), *(f"note: {note}" for note in self.notes)])

    def plot(self) -> Figure:
        """Evidence of the scene, and a map of every model's probability."""
        from .plots import plot_comparison

        return plot_comparison(self)


def _number(value: float) -> str:
    return "unknown" if np.isnan(value) else f"{value:.2f}"
