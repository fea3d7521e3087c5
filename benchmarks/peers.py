"""Speed against error of five parameters a pixel: ``fit`` and ``decompose`` against whoever else can infer them.

Three balanced states, unit gain, default priors, truths drawn from them, sigma 0.02 and 0.2, double precision for all.
Everybody maximises, or samples, the same posterior, and is judged on the same 64 pixels: root mean square of
||J_found - J_true||_F over the Cramer-Rao bound of the same, and the share of pixels whose parameters lie more than 0.1
nat below the best that anybody found, the independent optimiser of ``benchmarks.oracle`` with 32 starts included.
Samplers are judged by the posterior mean of J and by their densest draw: they do not climb, so many of their pixels lie
below.

Time: median of calls that are not the first (NumPyro: of one call, compiled ahead), or of pixels where a peer takes one
at a time. Compiling is counted apart. Take the machine for yourself: two to five minutes.
The contestants are written in ``benchmarks.rivals``; those that are not installed (``pip install '.[peers]'``) are
named and left out. The picture of the README:

    python -m benchmarks peers && cp benchmarks/results/peers.png docs/images/speed-against-error.png
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from matplotlib.patheffects import withStroke

from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.results import Results, median_seconds
from benchmarks.rivals import CHECKED, CONTESTANTS, MODEL, PIXELS, REPEATS, SIZES, STARTS, Answer, Scene, density
from polinfer import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = (0.02, 0.2)
ORACLE_STARTS = 32
TOLERANCE = 0.1  # nat


def _error(answer: Answer, scene: Scene, count: int = PIXELS) -> tuple[float, float]:
    """Root mean square error of J over its bound in the first pixels, and its standard error from their scatter."""
    jones = answer.jones[:count]
    truth = Parameters(*(x[: len(jones)] for x in scene.truth))
    error = scenes.squared_error(MODEL, jones, scenes.jones(MODEL, truth))
    bound = scenes.least_squared_error(MODEL, truth, scene.data.illumination, scene.sigma)
    ratio = error.sum() / bound.sum()
    scatter = np.std(error - ratio * bound, ddof=1) / (bound.mean() * np.sqrt(len(bound)))
    return float(np.sqrt(ratio)), float(scatter / (2 * np.sqrt(ratio)))


def _scene(sigma: float, count: int) -> Scene:
    truth = scenes.from_priors(MODEL, count, np.random.default_rng(1))
    high = np.array([1, 1, 2, 1, 2]) * np.pi / 2
    starts = np.random.default_rng(2).uniform(-0.95, 0.95, (STARTS, 5)) * high
    return Scene(truth, scenes.measure(MODEL, truth, scenes.balanced_states(), sigma, rng=3), sigma, starts)


def _answers(scene: Scene) -> dict[str, list[Answer]]:
    found = {}
    for name, contestant in CONTESTANTS.items():
        jax.clear_caches()  # everybody compiles
        begin = time.perf_counter()
        try:
            found[name] = contestant(scene)
            print(f"  {name}, sigma {scene.sigma:g}: done in {time.perf_counter() - begin:.0f} s", flush=True)
        except ModuleNotFoundError as error:
            print(f"  [skipped] {name}: {error}; pip install '.[peers]'")
    return found


def _best(scene: Scene, densities: dict[str, np.ndarray]) -> np.ndarray:
    """The highest log posterior that anybody found, (pixels,), the oracle included."""
    data = scene.first()
    _, own = Oracle("RetarderFirst", "unit").maximum(
        data.response, data.illumination, scene.sigma, ORACLE_STARTS, np.random.default_rng(4)
    )
    return np.max([own, *(np.nan_to_num(x, nan=-np.inf) for x in densities.values())], axis=0)


def _judge(results: Results, scene: Scene) -> None:
    """One row for every answer, and one for the error of ``fit`` and ``decompose`` in more pixels."""
    answers = _answers(scene)
    densities = {name: density(scene, found[-1].points[:, :PIXELS]) for name, found in answers.items()}
    best = _best(scene, densities)
    for name, found in answers.items():
        below = float(100 * np.mean(~(densities[name] >= best - TOLERANCE)))
        for answer in found:
            error, spread = _error(answer, scene)
            micro = 1e6 * answer.times
            results.add(
                method=name,
                sigma=scene.sigma,
                pixels=answer.pixels,
                microseconds_a_pixel=float(np.median(micro)),
                least=float(micro.min()),
                most=float(micro.max()),
                compile_seconds=answer.compiling,
                error_over_bound=error,
                standard_error=spread,
                below_best_percent=below,
                effective_draws=answer.effective,
            )
    for name in ("fit", "decompose"):
        answer = answers[name][-1]
        error, spread = _error(answer, scene, CHECKED)
        results.add(
            judge_of=name, sigma=scene.sigma, judged_pixels=len(answer.jones), error=error, standard_error=spread
        )


def main(size: int | None = None) -> None:
    """Print the tables, save the picture; ``size`` is the largest number of pixels that ``fit`` gets."""
    results = Results("peers")
    for sigma in SIGMAS:
        scene = _scene(sigma, max(size or SIZES[-1], PIXELS))
        matrices = scene.data.response @ np.linalg.pinv(scene.data.illumination)
        _judge(results, scene)
        svd = median_seconds(lambda m=matrices: np.linalg.svd(m), REPEATS) / len(matrices)
        results.add(reference="numpy.linalg.svd", sigma=sigma, matrices=len(matrices), microseconds=1e6 * svd)
    print("  [skipped] Stan: pip installs cmdstanpy without CmdStan, so nothing could be tried and nothing was written")
    results.save(picture(results.rows))


STYLES = {  # colour, marker, size
    "fit": ("C3", "o", 8),
    "decompose": ("C1", "s", 7),
    "optimistix LM": ("C0", "^", 7),
    "SciPy LM": ("C0", "v", 7),
    "SciPy TRF": ("C0", "D", 6),
    "SciPy L-BFGS-B": ("C0", "P", 7),
    "NumPyro NUTS": ("C2", "X", 8),
    "emcee": ("C2", "*", 11),
}
OWN = ("fit", "decompose")
BESIDE = {"NumPyro NUTS": ((-40, -18), (-50, 0)), "emcee": ((4, -14), (4, 13))}  # labels of both figures: points
HALO = [withStroke(linewidth=2.5, foreground="white")]
NAMES = {1_000_000: "$10^6$"}
NOTE = (
    "Three states, truths from the priors, double precision. Everybody is judged on the same {} pixels; small numbers: "
    "pixels in the timed call.\nOptimisers of others: best of {} random starts. Samplers: posterior mean of J above, "
    "densest draw below."
)


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Error, and pixels below the best mode, against time; a column for each sigma."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator

    figure = Figure(figsize=(9.6, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(1.2, 1))
    for column, sigma in enumerate(SIGMAS):
        own = [row for row in rows if row["sigma"] == sigma]
        _draw(axes[0, column], own, "error_over_bound", 0)
        _draw(axes[1, column], own, "below_best_percent", 1)
        _references(axes[:, column], own)
        axes[0, column].set_title(f"noise: sigma = {sigma:g}", weight="bold")
        axes[1, column].set_xlabel("microseconds a pixel, compiling apart")
    errors = [row["error_over_bound"] for row in rows if "error_over_bound" in row]
    ticks = [0.8, 0.9, 1, 1.1, 1.2, 1.3, 1.4, 1.5, 2, 3, 5, 10]
    axes[0, 0].set(xscale="log", yscale="log", ylabel="rms error of J over its Cramér-Rao bound", yticks=ticks)
    axes[0, 0].set(xlim=(0.3, 1e7), ylim=(0.93 * min([1, *errors]), 1.1 * max(errors)))
    axes[0, 0].yaxis.set_major_formatter("{x:g}")
    axes[0, 0].yaxis.set_minor_locator(NullLocator())
    axes[1, 0].set(ylim=(-55, 106), yticks=range(0, 101, 20), ylabel=f"% of pixels {TOLERANCE:g} nat below best mode")
    figure.supxlabel(NOTE.format(PIXELS, STARTS), size=8, color="0.3")
    return figure


def _draw(axes: Axes, rows: list[dict[str, Any]], key: str, figure: int) -> None:
    axes.grid(alpha=0.25, lw=0.6)
    points: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if "method" in row:
            points.setdefault(row["method"], []).append((row["microseconds_a_pixel"], row[key]))
    # equally good ones stand in a row: labels above or below them, the fastest one's furthest
    crowd = sorted((name for name in points if name not in OWN and name not in BESIDE), key=lambda n: -points[n][-1][0])
    for name, places in points.items():
        color, marker, size = STYLES[name]
        axes.plot(*zip(*places, strict=True), marker + "-", color=color, ms=size, lw=1.2)
        text: dict[str, Any] = {"textcoords": "offset points", "color": color, "va": "center", "size": 9}
        if name in crowd:
            line = {"arrowstyle": "-", "color": color, "lw": 0.6, "shrinkA": 0, "relpos": (0, figure)}
            height = (1 - 2 * figure) * (18 + 13 * crowd.index(name))
            axes.annotate(name, places[-1], (-3, height), ha="left", arrowprops=line, path_effects=HALO, **text)
        elif name in BESIDE:
            axes.annotate(name, places[-1], BESIDE[name][figure], ha="center", **text)
        else:
            axes.annotate(name, places[len(places) // 2], (0, 13), ha="center", weight="bold", **text)
            _sizes(axes, [row for row in rows if row.get("method") == name], key, color)


def _sizes(axes: Axes, rows: list[dict[str, Any]], key: str, color: str) -> None:
    """The number of pixels below each point, as far as there is room."""
    done: list[float] = []
    for row in (rows[0], *rows[:0:-1]):
        x = row["microseconds_a_pixel"]
        if all(abs(np.log10(x / other)) > 0.3 for other in done):
            name = NAMES.get(row["pixels"], row["pixels"])
            text = {"textcoords": "offset points", "ha": "center", "va": "top", "size": 7, "color": color}
            axes.annotate(name, (x, row[key]), (0, -6), **text)
            done.append(x)


def _references(axes: Any, rows: list[dict[str, Any]]) -> None:
    """The bound, what ``fit`` reaches in more pixels, and the time of a singular value decomposition."""
    many = next(row for row in rows if row.get("judge_of") == "fit")
    one = next(row for row in rows if row.get("method") == "fit")
    svd = next(row["microseconds"] for row in rows if "reference" in row)
    axes[0].axhline(1, color="0.3", lw=0.8)
    text = {"textcoords": "offset points", "size": 8, "color": "0.3"}
    axes[0].annotate("bound", (0.35, 1), (0, -3), va="top", **text)
    note = f"fit: {one['error_over_bound']:.2f} ± {one['standard_error']:.2f} in these {one['pixels']} pixels,\n"
    note += f"{many['error']:.3f} ± {many['standard_error']:.3f} in {many['judged_pixels']:,}"
    axes[0].annotate(note, (0.98, 0.97), xycoords="axes fraction", ha="right", va="top", size=8, color="C3")
    for axis in axes:
        axis.axvline(svd, color="0.3", lw=0.8, ls=":")
    axes[1].annotate("numpy.linalg.svd", (svd, 0.04), (4, 0), xycoords=("data", "axes fraction"), va="bottom", **text)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
