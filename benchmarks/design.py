"""The paper's design of a calibration, checked: how many spots at once, how far apart, and which states.

Spots: 144 points on 12 x 12, every one lit in three states, with complex noise of 2 % of the mean field that one spot
makes on the bundle, whatever else is lit; cross-talk (with regularisation) is the error of the same estimate from
fields without noise. Error: relative, of held-out random fields at the points, by ``ForwardInverse``.

States: images of a simulated bench whose focus and phase steps err, retrieved with ``Modal`` and recovered; 64 points
30 um apart where lit together, 16 translations in each state. Linear states are spread over half a turn of the
direction; elliptical ones are (1, e^{2 pi i k / n}) / sqrt 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from acquisition import CalibrationPlan, SimulatedBench
from acquisition import Scene as BenchScene
from benchmarks import live
from benchmarks.recovery import WAIST, Scene, gauge_free_error, noise
from benchmarks.results import Results
from fibre import Bundle, Fibrelets, ForwardInverse, Modal, recover, retrieve_fields
from polinfer import phantoms

STEP, SIDE = 68.2e-6 / 9, 12


@dataclass(frozen=True)
class StatedPlan(CalibrationPlan):
    """A calibration with linear states, evenly over half a turn, or with the elliptical ones of its parent."""

    linear: bool = False

    @property
    def illumination(self) -> np.ndarray:
        """See :class:`acquisition.plan.Plan`."""
        if not self.linear:
            return super().illumination
        angles = np.pi * np.arange(self.states) / self.states
        return np.stack([np.cos(angles), np.sin(angles)]) + 0j


def held_out_error(inverse: np.ndarray, matrix: np.ndarray, rng: np.random.Generator) -> float:
    """Relative error of twenty random fields at the points, up to the unit of the light and a phase of each point."""
    z = noise(rng, matrix.shape[1], 20)
    return gauge_free_error(inverse @ (matrix @ z), z)


def spots(results: Results, side: int) -> None:
    """Cross-talk and noise against the distance between spots that are lit together."""
    level = None
    for stride in sorted({2, 3, 4, 6, 9, side}, reverse=True):
        scene = Scene((side, side), stride=stride, pitch=STEP, level=level)
        level = scene.level  # of one spot at a time, for all
        noisy, bare = (
            held_out_error(recover(fields, ForwardInverse()).matrix, scene.matrix, np.random.default_rng(1))
            for fields in (scene.fields, replace(scene.fields, fields=scene.clean))
        )
        by_noise = float(np.sqrt(max(noisy**2 - bare**2, 0)))
        results.add(spot_pitch_um=stride * STEP * 1e6, spots_at_once=(-(-side // stride)) ** 2,
                    captures=len(scene.clean), error=noisy, cross_talk=bare, noise=by_noise,
                    limit="noise" if by_noise > bare else "cross-talk")  # fmt: skip


def states(results: Results, seeds: int) -> None:
    """Errors of calibrations in two, three and four states, with and without the same number of captures."""
    grid = (8, 8)
    for linear, count in ((True, 2), (False, 2), (True, 3), (False, 3), (True, 4), (False, 4)):
        errors, stated = [], []
        for seed in range(seeds):
            bundle = Bundle.hexagonal(rng=seed)
            scene = BenchScene(bundle, phantoms.lesion(grid, rng=seed), focus_error=3e-3, step_error=5e-3)
            bench = SimulatedBench(scene, rng=seed)
            plan = StatedPlan(grid, STEP, 4, count, reference_every=24, linear=linear)
            fibrelets = Fibrelets(bundle.centres, bundle.mode_radius)
            fields = retrieve_fields(live.calibration(bench, plan), Modal(fibrelets), fibrelets)
            launch = bundle.launch(plan.points, WAIST).toarray()
            matrix = bundle.columns(np.kron(np.eye(2), launch), faint=1e-9)
            inverse = recover(fields, ForwardInverse()).matrix
            errors.append(held_out_error(inverse, matrix, np.random.default_rng(seed)))
            stated.append(fields.relative_error)
        error = float(np.median(errors))
        results.add(states=("linear" if linear else "elliptical"), number=count, error=error,
                    times_root_of_captures=error * np.sqrt(count), closure_found=float(np.median(stated)))  # fmt: skip


def picture(rows: list[dict]) -> Figure:
    """Both questions beside each other."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    near = [row for row in rows if "spot_pitch_um" in row]
    for name, style in (("error", "o-"), ("cross_talk", "s--"), ("noise", "^:")):
        left.semilogy([r["spot_pitch_um"] for r in near], [r[name] for r in near], style, label=name.replace("_", "-"))
    for r in near:
        left.annotate(str(r["spots_at_once"]), (r["spot_pitch_um"], r["error"]), textcoords="offset points",
                      xytext=(0, 7), ha="center", fontsize=8)  # fmt: skip
    left.axvline(68.2, color="grey", lw=1)
    left.set(xlabel="pitch of spots lit at once / um (numbers: how many)", ylabel="relative error of held-out fields")
    for kind, style in (("linear", "s--"), ("elliptical", "o-")):
        some = [row for row in rows if row.get("states") == kind]
        right.plot([r["number"] for r in some], [r["error"] for r in some], style, label=kind)
    right.set(xlabel="states of polarisation", xticks=[2, 3, 4], ylim=(0, None))
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    return figure


def main(size: int | None = None, full: bool = False) -> None:
    """Print the tables; ``size``: points along each axis instead of 12."""
    results = Results("design")
    spots(results, size or SIDE)
    states(results, 5 if full else 1)
    results.save(picture(results.rows))


if __name__ == "__main__":
    main()
