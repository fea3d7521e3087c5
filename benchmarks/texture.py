"""Texture: speed and error of the sliding-window filters, against what a user would write and the nearest rival.

Speed: von Mises expectation and entropy of a masked frame in single precision, ours beside SciPy's uniform filters
with the closed form, and beside the binned entropy of scikit-image, taking turns; errors beside them. Error: the
entropy of a concentration against sums over a fine grid; single against double precision; the mean error of independent
samples, uncorrected and corrected; joint entropies against sums over dense grids; entropies of tissue under noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import i0e, i1e

from polinfer import texture
from polinfer.texture.joint import Joint
from polinfer.texture.quadrature import joint_entropy

from .results import Results, alternating_seconds, median_seconds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = 15
CONCENTRATIONS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


def exact(concentration: float) -> float:
    """Entropy of a von Mises distribution, from a sum over 200,000 points of its density."""
    reach = min(np.pi, 12 / concentration**0.5)
    x = (np.arange(200_000) + 0.5) * (2 * reach / 200_000) - reach
    power = -2 * concentration * np.sin(0.5 * x) ** 2
    weight = np.exp(power)
    return float(np.log(weight.sum() * (2 * reach / 200_000)) - np.sum(weight * power) / weight.sum())


def scipy_version(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and entropy as a user would write them, who has no mask; concentration by Banerjee et al. (2005)."""
    cosine, sine = uniform_filter(np.cos(angles), SIZE), uniform_filter(np.sin(angles), SIZE)
    resultant = np.hypot(cosine, sine)
    kappa = resultant * (2 - resultant**2) / (1 - resultant**2)
    return np.arctan2(sine, cosine), np.log(2 * np.pi * i0e(kappa)) + kappa * (1 - resultant)


def scipy_shortest(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same with the entropy of a Gaussian, the least that could be written."""
    cosine, sine = uniform_filter(np.cos(angles), SIZE), uniform_filter(np.sin(angles), SIZE)
    return np.arctan2(sine, cosine), 0.5 * np.log(2 * np.pi * np.e * -np.log(cosine**2 + sine**2))


def rank_entropy(angles: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Binned Shannon entropy of scikit-image, 256 levels, in nats per radian."""
    from skimage.filters.rank import entropy

    levels = np.clip((angles + np.pi) * (256 / (2 * np.pi)), 0, 255).astype(np.uint8)
    bits = entropy(levels, np.ones((SIZE, SIZE), np.uint8), mask=mask.astype(np.uint8))
    return np.asarray(bits * np.log(2) + np.log(2 * np.pi / 256))


def speed(results: Results, side: int) -> dict[str, float]:
    """Times and errors of everybody on one frame of known concentration."""
    rng = np.random.default_rng(0)
    concentration = 2.0
    angles = rng.vonmises(0.3, concentration, (side, side)).astype(np.float32)
    mask = rng.random(angles.shape) < 0.95
    double = angles.astype(float)
    runs: dict[str, Any] = {
        "polinfer": lambda: texture.describe(angles, SIZE, mask=mask),
        "polinfer, entropy only": lambda: texture.entropy(angles, SIZE, mask=mask),
        "polinfer, float64": lambda: texture.describe(double, SIZE, mask=mask),
        "SciPy, no mask": lambda: scipy_version(angles),
        "SciPy, no mask, Gaussian entropy": lambda: scipy_shortest(angles),
    }
    for run in runs.values():
        run()
    times = {name: float(np.median(t)) for name, t in alternating_seconds(runs, 9).items()}
    times["skimage rank.entropy"] = median_seconds(lambda: rank_entropy(angles, mask), 1)
    truth = exact(concentration)
    found = {
        "polinfer": texture.entropy(angles, SIZE, mask=mask),
        "polinfer, entropy only": texture.entropy(angles, SIZE, mask=mask),
        "polinfer, float64": texture.entropy(double, SIZE, mask=mask),
        "SciPy, no mask": scipy_version(angles)[1],
        "SciPy, no mask, Gaussian entropy": scipy_shortest(angles)[1],
        "skimage rank.entropy": rank_entropy(angles, mask),
    }
    for name, seconds in times.items():
        inner = found[name][SIZE:-SIZE, SIZE:-SIZE]
        results.add(method=name, milliseconds=1e3 * seconds, ns_a_pixel=1e9 * seconds / side**2,
                    mean_error=float(np.mean(inner) - truth))  # fmt: skip
    frame = f"{side} x {side}, {SIZE} x {SIZE}, float32, masked: "
    results.bar(frame + "time over SciPy's", times["polinfer"] / times["SciPy, no mask"], 1.2)
    results.bar(frame + "time over the shortest SciPy",
                times["polinfer"] / times["SciPy, no mask, Gaussian entropy"], 1.2)  # fmt: skip
    sizes = {n: median_seconds(lambda n=n: texture.describe(angles, n, mask=mask), 5) for n in (3, 15, 51, 151)}  # type: ignore[misc]
    for n, seconds in sizes.items():
        results.add(window=n, milliseconds=1e3 * seconds)
    return times


def concentrations(results: Results) -> None:
    """Entropy of a concentration, and of windows in single precision."""
    worst = 0.0
    for kappa in np.logspace(-6, 6, 49):
        worst = max(worst, abs(float(texture.von_mises_entropy(kappa)) - exact(float(kappa))))
    results.bar("entropy of a concentration, 1e-6 to 1e6, error", worst, 1e-5, "nat")
    rng = np.random.default_rng(1)
    for kappa in (0.1, 1.0, 10.0, 100.0, 300.0, 1e3, 1e4, 1e6):
        angles = rng.vonmises(2.0, kappa, (96, 96))
        single = angles.astype(np.float32)
        error = np.abs(texture.entropy(single, SIZE).astype(float) - texture.entropy(angles, SIZE)).max()
        results.add(concentration=kappa, single_minus_double=float(error))
    rows = [r["single_minus_double"] for r in results.rows if r.get("concentration", 1e9) <= 1e3]
    results.bar("float32 filter up to a concentration of 1e3, error", max(rows), 1e-3, "nat")


def bias(results: Results, windows: int) -> None:
    """Mean error of the entropy of independent samples.

    The mean of ``-log p`` of the true density over the same samples has the true entropy as its expectation, and nearly
    the same fluctuations: the difference needs a hundred times fewer samples.
    """
    rng = np.random.default_rng(2)
    for side, bar in ((5, 0.005), (15, 0.001)):
        worst = 0.0
        for kappa in CONCENTRATIONS:
            rows = int(windows**0.5)
            angles = rng.vonmises(0.0, kappa, (rows * side, rows * side))
            cosine = np.cos(angles).reshape(rows, side, rows, side).mean(axis=(1, 3))
            truth = np.log(2 * np.pi * i0e(kappa)) + kappa * (1 - cosine)
            centre = slice(side // 2, None, side)
            error = texture.entropy(angles, side)[centre, centre] - truth
            sine = np.sin(angles).reshape(rows, side, rows, side).mean(axis=(1, 3))
            plain = _entropy_of_resultant(np.hypot(cosine, sine)) - truth
            results.add(pixels=side**2, concentration=kappa, uncorrected=float(plain.mean()),
                        corrected=float(error.mean()), standard_error=float(error.std() / rows))  # fmt: skip
            worst = max(worst, abs(float(error.mean())))
        results.bar(f"mean error of {side**2} independent samples, concentration 0.1 to 100", worst, bar, "nat")


def _entropy_of_resultant(resultant: np.ndarray) -> np.ndarray:
    low, high = np.zeros(resultant.shape), np.full(resultant.shape, 1e6)
    for _ in range(80):
        middle = 0.5 * (low + high)
        less = i1e(middle) / i0e(middle) < resultant
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    return np.asarray(np.log(2 * np.pi * i0e(low)) + low * (1 - resultant))


def dense(model: Joint, parameters: np.ndarray, angles: int, nodes: int) -> float:
    """Entropy from a sum over all angles."""
    x = (np.arange(nodes) + 0.5) * (2 * np.pi / nodes) - np.pi
    grid = np.meshgrid(*[x] * angles, indexing="ij")
    power = np.zeros(grid[0].shape)
    for statistic, factor in zip(model.statistics(angles), parameters, strict=True):
        for frequency, c in statistic.items():
            power += factor * (c * np.exp(1j * sum(k * g for k, g in zip(frequency, grid, strict=True)))).real
    power -= power.max()
    weight = np.exp(power)
    total = weight.sum()
    return float(np.log(total * (2 * np.pi / nodes) ** angles) - np.sum(weight * power) / total)


def joint(results: Results, cases: int) -> None:
    """Entropies of joint distributions against dense grids; what a window costs."""
    rng = np.random.default_rng(3)
    for angles, nodes in ((2, 512), (3, 96)):
        worst = 0.0
        for model in (texture.MultivariateVonMises(), texture.TorusGraph()):
            for scale in (0.3, 3.0, 30.0):
                parameters = scale * rng.normal(size=(cases, len(model.statistics(angles))))
                found = joint_entropy(model, parameters, np.full((cases, angles), 0.3))
                true = [dense(model, p, angles, nodes) for p in parameters]
                error = float(np.abs(found - true).max())
                results.add(angles=angles, model=type(model).__name__, parameters_about=scale, largest_error=error)
                worst = max(worst, error)
        results.bar(f"joint entropy of {angles} angles against a dense grid, error", worst, 0.01, "nat")
        for kappa in (1.0, 10.0, 100.0):
            shape = (27, 36) if angles == 3 else (81, 108)
            images = list(rng.vonmises(0.0, kappa, (angles, *shape)))
            seconds = median_seconds(lambda images=images: texture.entropy(images, SIZE), 3)  # type: ignore[misc]
            results.add(angles=angles, concentration=kappa, microseconds_a_window=1e6 * seconds / np.prod(shape))


def noise(results: Results, side: int) -> None:
    """Entropy of tissue under noise of known width, with and without its subtraction."""
    rng = np.random.default_rng(4)
    for kappa in (1.0, 10.0, 50.0):
        for width in (0.05, 0.2, 0.5):
            tissue = rng.vonmises(0.0, kappa, (side, side))
            std = width * rng.uniform(0.5, 1.5, tissue.shape)
            seen = tissue + std * rng.normal(size=tissue.shape)
            centre = slice(SIZE // 2, None, SIZE)
            subtracted = texture.entropy(seen, SIZE, std=std)[centre, centre]
            kept = np.isfinite(subtracted)
            results.add(concentration=kappa, noise=width,
                        error_with_noise=float(texture.entropy(seen, SIZE)[centre, centre].mean() - exact(kappa)),
                        median_error_subtracted=float(np.median(subtracted) - exact(kappa)),
                        standard_error=float(subtracted[kept].std() / kept.sum() ** 0.5),
                        share_all_noise=float(1 - kept.mean()))  # fmt: skip


def _picture(results: Results, times: dict[str, float]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [n for n in times if "only" not in n]
    left.barh(
        names, [1e3 * times[n] for n in names], color=["C0" if n.startswith("polinfer") else "0.6" for n in names]
    )
    left.set_xscale("log")
    left.set_xlim(10, 1e4)
    left.invert_yaxis()
    left.set_xlabel("ms a frame of 1.44 million pixels")
    rows = [r for r in results.rows if "corrected" in r]
    for pixels, colour in ((25, "C1"), (225, "C0")):
        own = [r for r in rows if r["pixels"] == pixels]
        x = [r["concentration"] for r in own]
        right.semilogx(x, [r["uncorrected"] for r in own], "--", color=colour, label=f"{pixels} pixels, uncorrected")
        right.errorbar(x, [r["corrected"] for r in own], [2 * r["standard_error"] for r in own], fmt="o-",
                       color=colour, label=f"{pixels} pixels, corrected")  # fmt: skip
    right.axhline(0, color="k", lw=0.5)
    right.set_xlabel("concentration")
    right.set_ylabel("mean error of the entropy (nat)")
    right.legend(fontsize=7)
    return figure


def main(size: int | None = None, full: bool = False) -> None:
    """Everything; ``size`` is the number of pixels of the frame that is timed."""
    side = 1200 if size is None else max(int(size**0.5), 3 * SIZE)
    results = Results("texture")
    times = speed(results, side)
    concentrations(results)
    bias(results, 40_000 if full else 10_000)
    joint(results, 20 if full else 5)
    noise(results, 1500 if full else 600)
    results.save(_picture(results, times))


if __name__ == "__main__":
    main()
