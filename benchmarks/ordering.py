"""Can the data tell the order of polariser and retarder, and does a comparison of models say so when they can?

How different are the two orderings: the paper's figure, with its percentages corrected. How often the verdict of
:func:`polinfer.compare` is right, wrong and undecided, beside :func:`polinfer.power`, and where the border is.
Sums of log Bayes factors where D is within its noise, against their scatter. Whether :func:`polinfer.select` leaves
out what a scene does not need, and finds what made it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

import polinfer
from benchmarks.results import Results
from benchmarks.scenes import balanced_states, conditioned_states
from polinfer import Model, Parameters, PhaseGain, PolariserFirst, RetarderFirst, VonMises, Window
from polinfer.comparison import compare, ordering_screen, power, select

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PIXELS = 972
EXACT = 50  # scenes compared by the evidence of draws, some seconds each
SIGMAS, SIZES = (0.02, 0.1, 0.4), (0.01, 0.1, 0.3)
ORDERINGS = {"retarder_first": Model(RetarderFirst()), "polariser_first": Model(PolariserFirst())}
RETARDER = Model(fixed={"diattenuation": 0.0})
PAPER = ((0.01, 0.05, 0.967), (0.05, 0.10, 0.910), (0.0081, 0.05, 0.973))
WIDTHS = (0.0081, 0.01, 0.02, 0.05, 0.1, 0.2)


def truths(count: int, diattenuation: float, rng: np.random.Generator) -> Parameters:
    """Parameters from the default priors, but for D."""
    turn = rng.uniform(-0.5, 0.5, (3, count)) * np.pi
    return Parameters(
        np.full(count, diattenuation), turn[0], 2 * turn[1], turn[2], VonMises(0.0, 1.0).sample(rng, (count,))
    )


def errors(results: Results, count: int) -> dict[float, tuple[np.ndarray, np.ndarray]]:
    """Q and the bounded error of ``count`` matrices for every width of D: all angles uniform, as the paper has it."""
    rng, found = np.random.default_rng(1), {}
    for width in WIDTHS:
        turn = rng.uniform(-np.pi, np.pi, (4, count)) * np.array([0.5, 1.0, 0.5, 1.0])[:, None]
        d = np.clip(rng.normal(0, width, count), -1, 1)
        found[width] = polinfer.ordering_error(Parameters(d, *turn))
    for width, limit, expected in PAPER:
        q, bounded = found[width]
        share, half = np.mean(q < limit), np.mean(bounded < limit)
        error = np.sqrt(share * (1 - share) / count)
        results.add(sigma_D=width, limit=limit, q_below=float(share), error=float(error), expected=expected,
                    frobenius_below=float(half), worst_frobenius=float(bounded.max()))  # fmt: skip
        # the expected ones are given to 0.1 %
        results.bar(f"Q < {limit:g} at sigma_D {width:g}: share off by", abs(share - expected), 3 * error + 5e-4)
    return found


def verdicts(truth: str, sigma: float, size: float, scenes: int, states: np.ndarray, seed: int) -> np.ndarray:
    """Verdicts of scenes made and compared one by one."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(scenes):
        data = polinfer.simulate(ORDERINGS[truth], truths(PIXELS, size, rng), states, sigma, rng=rng)
        found.append(compare({name: polinfer.fit(model, data) for name, model in ORDERINGS.items()}).verdict)
    return np.array(found)


def orderings(results: Results, scenes: int, simulations: int) -> None:
    """Right, wrong and undecided, for both truths, beside the power."""
    states, wrong_most, off_most = balanced_states(), 0.0, 0.0
    for seed, (sigma, size, truth) in enumerate(product(SIGMAS, SIZES, ORDERINGS)):
        found = verdicts(truth, sigma, size, scenes, states, 100 + seed)
        right = float(np.mean(found == truth))
        wrong = float(np.mean((found != truth) & (found != "undecided")))
        first, second = (ORDERINGS[truth], *(m for name, m in ORDERINGS.items() if name != truth))
        said = power(first, second, states, sigma, PIXELS, truths(200_000, size, np.random.default_rng(seed)),
                     simulations=simulations, rng=seed)  # fmt: skip
        share = (right * scenes + said.right * simulations) / (scenes + simulations)
        error = float(np.sqrt(max(share * (1 - share), 1e-9) * (1 / scenes + 1 / simulations)))
        results.add(sigma=sigma, D=size, truth=truth, scenes=scenes, right=right, wrong=wrong,
                    undecided=1 - right - wrong, power=said.right, power_error=said.error, power_wrong=said.wrong,
                    advantage_nat=said.advantage)  # fmt: skip
        wrong_most = max(wrong_most, wrong)
        off_most = max(off_most, abs(right - said.right) / max(error, 1e-3))
    # eighteen shares, each with its own binomial error
    allowed = 0.05 + 3 * float(np.sqrt(0.05 * 0.95 / scenes))
    results.bar(f"wrong verdicts, worst of {len(SIGMAS) * len(SIZES) * 2} cases (0.05 + 3 errors)", wrong_most, allowed)
    rows = [row for row in results.rows if "advantage_nat" in row]
    results.bar("wrong verdicts, all cases", float(np.mean([row["wrong"] for row in rows])), 0.05)
    results.bar("share of right verdicts off from power by at most", off_most, 3.5, "binomial errors")


def scatter(results: Results, scenes: int) -> None:
    """Sums of log Bayes factors where there is nothing, or little, to tell: is the answer of a sum worth its size?"""
    rng = np.random.default_rng(7)
    kinds = {"balanced": balanced_states(), "condition 5": conditioned_states(5.0, np.random.default_rng(0))}
    for (kind, states), sigma, size in product(kinds.items(), (0.02, 0.1), (0.0, 0.01)):
        said, sums, screens, three = [], [], [], []
        for _ in range(scenes):
            data = polinfer.simulate(ORDERINGS["polariser_first"], truths(PIXELS, size, rng), states, sigma, rng=rng)
            fits = {name: polinfer.fit(model, data) for name, model in ORDERINGS.items()}
            found = compare(fits)
            said.append(found.verdict)
            three.append(compare(fits | {"no_diattenuation": polinfer.fit(RETARDER, data)}).verdict)
            sums.append(found.pooled[1] - found.pooled[0])
            screens.append(ordering_screen(data).verdict)
        sure = np.mean(np.array(sums) < -np.log(19))
        results.add(states=kind, sigma=sigma, D=size, truth="polariser_first", scenes=scenes,
                    mean_sum_nat=float(np.mean(sums)), spread_nat=float(np.std(sums)), bayes_alone_wrong=float(sure),
                    wrong=float(np.mean(np.array(said) == "retarder_first")),
                    of_three_wrong=float(np.mean(np.array(three) == "retarder_first")),
                    of_three_none=float(np.mean(np.array(three) == "no_diattenuation")),
                    screen_wrong=float(np.mean(np.array(screens) == "retarder_first")),
                    screen_right=float(np.mean(np.array(screens) == "polariser_first")))  # fmt: skip
    rows = [row for row in results.rows if "of_three_wrong" in row]
    worst = max(row["of_three_wrong"] for row in rows)
    results.bar("D within its noise, a model without D offered too: wrong ordering, worst case", worst, 0.05)
    results.bar("  the closed-form screen: wrong ordering, all cases",
                float(np.mean([row["screen_wrong"] for row in rows])), 0.05)  # fmt: skip


def needs(results: Results, scenes: int) -> None:
    """What a scene needs: a part that it does not need is left out, the model that made it is found."""
    states, free = balanced_states(), Model()
    shape = (9, 30)
    candidates: dict[str, tuple[Model, Model, float, float]] = {
        # name: the model that made the scene, the other one, D, sigma
        "diattenuation, not needed": (RETARDER, free, 0.0, 0.05),
        "diattenuation, not needed, noisy": (RETARDER, free, 0.0, 0.4),
        "diattenuation, not needed, noisy, exact evidence": (RETARDER, free, 0.0, 0.4),
        "diattenuation, needed": (free, RETARDER, 0.3, 0.05),
        "phase, not needed": (free, replace(free, gain=PhaseGain()), 0.3, 0.05),
        "phase, needed": (replace(free, gain=PhaseGain()), free, 0.3, 0.05),
        "window, needed": (replace(free, neighbours=Window(3, 5)), free, 0.3, 0.1),
        "window, not wanted": (free, replace(free, neighbours=Window(3, 5)), 0.3, 0.1),
    }
    rng = np.random.default_rng(11)
    for name, (right, other, size, sigma) in candidates.items():
        found, leads = [], []
        count = min(scenes, EXACT) if "exact" in name else scenes
        for _ in range(count):
            each = truths(shape[0] * shape[1], size, rng)
            if right.neighbours is not None:
                each = Parameters(*(np.full(shape[0] * shape[1], x[0]) for x in each))
            truth = Parameters(*(x.reshape(shape) for x in each))
            made = replace(right, neighbours=None)
            data = polinfer.simulate(made, truth, states, sigma, rng=rng)
            infer = partial(polinfer.sample, draws=400, rng=rng) if "exact" in name else polinfer.fit
            result = select({"right": right, "other": other}, data, infer=infer)
            found.append(result.verdict)
            leads.append(result.pooled[0] - result.pooled[1])
        share, wrong = np.mean(np.array(found) == "right"), np.mean(np.array(found) == "other")
        results.add(select=name, sigma=sigma, D=size, scenes=count, right=float(share), wrong=float(wrong),
                    mean_lead_nat=float(np.mean(leads)), spread_nat=float(np.std(leads)))  # fmt: skip
        results.bar(f"select, {name}: the other model chosen", float(wrong), 0.05)
        if np.mean(leads) > 5:
            results.bar(f"select, {name}: the model that made it chosen", float(share), 0.95, at_least=True)


def border(results: Results, points: int, simulations: int) -> list[tuple[float, float, float]]:
    """Power over D and sigma."""
    found, states = [], balanced_states()
    pair = tuple(ORDERINGS.values())
    for i, (sigma, size) in enumerate(product(np.geomspace(0.01, 0.5, points), np.geomspace(0.003, 0.5, points))):
        truth = truths(100_000, float(size), np.random.default_rng(i))
        said = power(pair[0], pair[1], states, float(sigma), PIXELS, truth, simulations=simulations, rng=i)
        found.append((float(sigma), float(size), said.right))
    for sigma in sorted({row[0] for row in found}):
        told = [size for s, size, share in found if s == sigma and share >= 0.8]
        results.add(map_sigma=sigma, least_D_at_power_80=min(told) if told else float("nan"), simulations=simulations)
    return found


def picture(curves: dict[float, Any], found: list[tuple[float, float, float]]) -> Figure:
    """The paper's figure, the bounded error, and the map of power."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    for ax, index, name in zip(
        figure.subplots(1, 3)[:2], (0, 1), ("Q of the paper", "Frobenius, bounded"), strict=True
    ):
        for width, pair in curves.items():
            share = np.linspace(0, 1, 501)
            ax.semilogx(np.quantile(pair[index], share), share, label=f"sigma_D {width:g}")
        ax.set(xlabel=name, ylabel="share of matrices below", xlim=(1e-4, 3))
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    ax = figure.axes[2]
    sigma, size = (np.array(sorted({row[i] for row in found})) for i in (0, 1))
    table = np.array([row[2] for row in found]).reshape(len(sigma), len(size))
    drawn = ax.pcolormesh(size, sigma, table, vmin=0, vmax=1, shading="nearest")
    if min(table.shape) > 1:
        ax.contour(size, sigma, table, levels=[0.8], colors="w")
    ax.set(xscale="log", yscale="log", xlabel="|D|", ylabel="sigma", title=f"power, {PIXELS} pixels (line: 0.8)")
    figure.colorbar(drawn, ax=ax)
    return figure


def main(size: int | None = None, full: bool = False, quick: bool = False) -> None:
    """Print the tables; ``size`` is the number of scenes. ``quick``: the paper's Q and the verdicts only."""
    results = Results("ordering")
    if quick:
        errors(results, 20_000)
        orderings(results, size or 20, 40)
        results.save()
        return
    curves = errors(results, 1_000_000 if full else 100_000)
    orderings(results, size or (100 if full else 20), 400 if full else 100)
    scatter(results, size or (100 if full else 20))
    needs(results, size or (200 if full else 40))
    found = border(results, 13 if full else 6, 100 if full else 40)
    results.save(picture(curves, found))


if __name__ == "__main__":
    main()
