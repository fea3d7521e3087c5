"""Do the corners hold? One row for each hard scene, ordering, gain and precision; then scenes outside the model.

Unless a case says otherwise: truths from the priors, balanced states, amplitude 1, so that the signal-to-noise ratio is
1 / sigma, sigma 0.01. A row gives, over the pixels that can be fitted:

``deficit`` (nat): log posterior of the best start less that of the reported parameters, both by ``benchmarks.oracle``
    in double precision on the data as they were given (in single precision the rounded data). The starts are random
    ones, the truth and the fit itself; in single precision the maxima and the fit in double precision, and the fit. At
    a signal-to-noise ratio of 1e8 the formulas themselves, sums of squared residuals, are rounded by some 1e-7 nat. A
    point in single precision, and D next to 1 in either, cannot come as near to the maximum as wished: D moves in steps
    of eps, and J with the square root of 1 - D. So the reference is the lower of the maximum and the maximum with its
    five numbers rounded to the type of the result; ``raw`` is the deficit from the maximum itself.
``rms``: root mean square error of J modulo the gain over its bound. The bound is that of
    :mod:`benchmarks.regular_bound`, in the directions in which J can move, which stay regular where angles are
    undefined (at eta = 0 all three of the retarder). It leaves the priors and the edges out: beyond an edge (|D| = 1,
    eta = pi with unit gain) estimates are cut off, and are better than it. Where data leave J open (one state, nearly
    parallel ones) it is the error of the field J U instead, whose bound is sigma^2 / 2 for each of its directions.
    Below a signal-to-noise ratio of 10 the prior decides and no bound of unbiased estimates means anything: there
    ``rms_oracle`` counts, the same over the error of the oracle's maximum, which contains the prior.
``wrong``: pixels whose status is not what is expected. MASKED and NON_FINITE: exactly the pixels made so.
    NOT_CONVERGED: none. AT_EDGE: where the reported D or (unit gain) eta is a bound to within rounding (eight eps;
    between that and 1e-9 of the range, 1e-5 in single precision, either is right); where the oracle's maximum is on
    one, in the pixels that it has, and nowhere else; where the truth is on one and D can be told from it, in half of
    the pixels (unit gain: a free phase takes up the sign of the weaker transmission).
    BAD_FIT: exactly where the oracle's chi-square at the reported point has a tail probability below the nominal one,
    and in an expected share of the pixels. UNIDENTIFIED: exactly where the standard deviation from the oracle's second
    derivatives exceeds half of that of a uniform one, off the bounds and where that matrix is definite; all of them in
    a dark pixel of unknown gain. Within rounding of a threshold either is right.
``nan``: values that are not finite in pixels of status OK; ``nan_flagged`` those in pixels flagged otherwise than
    MASKED or NON_FINITE, for information.

``--full``: both orderings with both gains, instead of each once; 32 starts and all pixels for the deficit. Scenes
outside the model: :mod:`benchmarks.bad_fit`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import pi
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

import polinfer
from benchmarks import bad_fit, regular_bound, scenes
from benchmarks.oracle import Oracle
from benchmarks.results import Results
from polinfer import ComplexGain, Fit, Measurement, Model, Parameters, PolariserFirst, RetarderFirst, Status
from polinfer.fitting.residuals import BAD_FIT_PROBABILITY

PIXELS, CHECKED, STARTS = 400, 64, 12
SIGMA, LOW_SNR = 0.01, 10
GAINS = {"unit": None, "complex": ComplexGain(1.0)}
DEFICIT = {"complex128": 1e-3, "complex64": 1e-2}
UNIDENTIFIED = sum(int(Status.unidentified(name)) for name in Parameters._fields)
RANGE = np.array([2.0, pi, 2 * pi, pi, 2 * pi]) / np.sqrt(12)
EXACT = 8 * np.finfo(np.float64).eps  # an oracle's maximum so near to a bound lies on it
SLACK = {"complex128": 0.02, "complex64": 0.1}  # of a threshold, within which rounding decides
# from a bound, of the range: AT_EDGE is right up to the second, and must be set up to the first
ROUNDING = {"complex128": (8 * np.finfo(np.float64).eps, 1e-9), "complex64": (8 * np.finfo(np.float32).eps, 1e-5)}
CHANCE = 1e-6  # of a count of flags that is still expected


@dataclass(frozen=True)
class Case:
    """A scene: fixed values of the truth, states, sigma, and what happens to the data."""

    name: str
    truth: dict[str, Any] = field(default_factory=dict)
    states: np.ndarray = field(default_factory=scenes.balanced_states)
    sigma: float = SIGMA
    data: str = ""  # see _spoil
    error: str = "J"
    edge: tuple[str, ...] = ()  # gains for which the truth lies on a bound
    bad: tuple[str, ...] = ()  # gains for which every pixel contradicts the model
    dark: tuple[str, ...] = ()  # gains for which nothing is identified
    double_only: bool = False


def near(angle: float) -> np.ndarray:
    """Two states of unit power whose fields are so far apart, in radians."""
    return np.array([[1, np.cos(angle)], [0, np.sin(angle)]], complex)


def cases() -> list[Case]:
    """All scenes."""
    signs = np.array([1.0, -1.0])
    return [
        Case("eta = 0", {"retardance": 0.0}),
        Case("eta = 1e-3", {"retardance": 1e-3}),
        Case("eta = pi - 1e-3", {"retardance": pi - 1e-3}),
        Case("eta = pi", {"retardance": pi}, edge=("unit",)),
        Case("D = 0", {"diattenuation": 0.0}),
        Case("D = 1e-3", {"diattenuation": 1e-3}),
        Case("|D| = 1 - 1e-6", {"diattenuation": (1 - 1e-6) * signs}),
        Case("|D| = 1", {"diattenuation": signs}, edge=("unit",)),
        Case("theta = 0", {"diattenuation_angle": 0.0, "retardance_angle": 0.0}),
        Case("theta = pi/2", {"diattenuation_angle": pi / 2, "retardance_angle": pi / 2}),
        Case("theta by the wrap", {"diattenuation_angle": (pi / 2 - 1e-4) * signs,
                                   "retardance_angle": -(pi / 2 - 1e-4) * signs}),
        Case("xi by the wrap", {"circularity": (pi - 1e-4) * signs}),
        Case("xi = pi/2, where copies tie", {"circularity": pi / 2 * signs}),
        Case("identity", {"diattenuation": 0.0, "retardance": 0.0}),
        Case("|D| = 1 - 1e-6, eta = 0", {"diattenuation": (1 - 1e-6) * signs, "retardance": 0.0}),
        *(Case(f"SNR {1 / s:g}", sigma=s, double_only=s < 1e-5) for s in (2.0, 0.5, 0.1, 1e-4, 1e-5, 1e-6, 1e-8)),
        Case("eta = 0, top SNR", {"retardance": 0.0}, sigma=1e-5),
        Case("|D| = 1, top SNR", {"diattenuation": signs}, sigma=1e-5, edge=("unit",)),
        Case("|D| = 1, SNR 1e8", {"diattenuation": signs}, sigma=1e-8, edge=("unit",), double_only=True),
        Case("D = 0, top SNR", {"diattenuation": 0.0}, sigma=1e-5),
        Case("one state", states=scenes.balanced_states(1), error="field"),
        Case("two states", states=scenes.balanced_states(2)),
        Case("12 states", states=scenes.balanced_states(12)),
        Case("states 0.1 apart", states=near(0.1), sigma=1e-3),
        Case("states 1e-4 apart", states=near(1e-4), error="field"),
        Case("the same state twice", states=near(0.0), error="field"),
        Case("response 0", data="zero", error="", bad=("unit",), dark=("complex",)),
        Case("amplitude 0", data="dark", error="", bad=("unit",)),
        Case("saturated, weight 0", data="saturated", states=scenes.balanced_states(4)),
        Case("NaN and masked pixels", data="spoilt"),
        Case("identical pixels", data="identical", error=""),
    ]  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """Data of a case in double precision: what is given, and what the oracle is to see of every pixel."""

    truth: Parameters
    given: Measurement
    response: np.ndarray
    states: np.ndarray
    masked: np.ndarray
    non_finite: np.ndarray

    @property
    def good(self) -> np.ndarray:
        """Pixels that can be fitted."""
        return ~(self.masked | self.non_finite)


def make(case: Case, model: Model, pixels: int, rng: np.random.Generator) -> Scene:
    """Truth and data of a case."""
    drawn = scenes.from_priors(model, pixels, rng)._asdict()
    fixed = {name: np.resize(np.asarray(value, float), pixels) for name, value in case.truth.items()}
    truth, states = Parameters(**(drawn | fixed)), case.states
    if case.data == "identical":
        truth = Parameters(*(np.full(pixels, x[0]) for x in truth))
    plain = Model(model.ordering)
    response = scenes.measure(plain, truth, states, case.sigma, rng=int(rng.integers(2**31))).response.copy()
    masked, non_finite = np.zeros(pixels, bool), np.zeros(pixels, bool)
    if case.data in ("dark", "zero"):
        response -= scenes.jones(plain, truth) @ states
        response *= case.data == "dark"
    if case.data == "identical":
        response[:] = response[0]
    seen, used, weight, mask = response.copy(), np.broadcast_to(states, (pixels, *states.shape)), None, None
    if case.data == "saturated":  # another state in every pixel, some of them not finite
        lost = np.arange(pixels) % states.shape[-1]
        weight = np.ones((pixels, states.shape[-1]))
        weight[np.arange(pixels), lost] = 0
        response[np.arange(pixels), :, lost] = np.resize([1e30, np.inf, np.nan], pixels)[:, None]
        kept = np.array([np.delete(np.arange(states.shape[-1]), k) for k in lost])
        seen, used = (np.take_along_axis(x, kept[:, None], axis=-1) for x in (seen, used))
    if case.data == "spoilt":
        masked[::3], non_finite[1::5] = True, True
        response[non_finite, 0, 1] = np.resize([np.nan, np.inf, complex(0, np.nan)], non_finite.sum())
        mask, non_finite = ~masked, non_finite & ~masked
    given = Measurement(states, response, np.array(case.sigma), weight=weight, mask=mask)
    return Scene(truth, given, seen, used, masked, non_finite)


def cast(measurement: Measurement, dtype: str) -> Measurement:
    """The same in another precision."""
    with np.errstate(invalid="ignore"):
        response = measurement.response.astype(dtype)
    return replace(measurement, illumination=measurement.illumination.astype(dtype), response=response)


def from_edge(point: np.ndarray, gain: str) -> np.ndarray:
    """Distance of points ``(5, pixels)`` from the nearest bound, as a share of the range from its middle."""
    away = 1 - np.abs(point[0])
    return away if gain != "unit" else np.minimum(away, 1 - np.abs(point[2]) / pi)


def status_errors(case: Case, model: Model, gain: str, scene: Scene, result: Fit, point: np.ndarray, dtype: str,
                  response: np.ndarray, peak: np.ndarray) -> dict[str, int]:  # fmt: skip
    """Number of pixels with a wrong bit, by bit; ``response`` as the fit was given it, of the states used.

    ``peak`` are the oracle's maxima of the first good pixels.
    """
    status, good, oracle = result.status, scene.good, Oracle(type(model.ordering).__name__, gain)
    wrong = {"MASKED": np.sum(((status & Status.MASKED) != 0) != scene.masked),
             "NON_FINITE": np.sum(((status & Status.NON_FINITE) != 0) != scene.non_finite)}  # fmt: skip
    status, point = status[good], point[:, good]
    states, response = scene.states[good], response[good]
    wrong["NOT_CONVERGED"] = np.sum((status & Status.NOT_CONVERGED) != 0)
    away, expected_away = from_edge(point, gain), from_edge(peak, gain)
    flagged, (surely, rounding) = (status & Status.AT_EDGE) != 0, ROUNDING[dtype]
    wrong["AT_EDGE"] = np.sum(flagged & (away > rounding)) + np.sum(~flagged & (away < surely))
    first = flagged[: len(expected_away)]
    wrong["AT_EDGE"] += np.sum(first & (expected_away > rounding)) + np.sum(~first & (expected_away < EXACT))
    # |D| is 1 - O(sigma^2) beside the bound
    wrong["AT_EDGE"] += misplaced(flagged, 0.5) * (gain in case.edge and case.sigma**2 > 4 * rounding)
    chi = chi_square(model, oracle, point, response, states, case.sigma)
    rank = np.minimum(np.linalg.matrix_rank(states, tol=1e-6), 2)
    freedom = 4 * states.shape[-1] - np.minimum(5 + (0 if gain == "unit" else 2), 4 * rank)
    p = np.where(freedom > 0, chi2.sf(chi, np.maximum(freedom, 1)), 1)
    clear = np.abs(p / BAD_FIT_PROBABILITY - 1) > SLACK[dtype]
    least, most = rounding_of_chi_square(model, oracle, point, response, states, case.sigma, dtype)
    clear &= (chi2.sf(least, np.maximum(freedom, 1)) < BAD_FIT_PROBABILITY) == (
        chi2.sf(most, np.maximum(freedom, 1)) < BAD_FIT_PROBABILITY
    )
    bad = (status & Status.BAD_FIT) != 0
    expected = 1.0 if gain in case.bad else BAD_FIT_PROBABILITY
    wrong["BAD_FIT"] = np.sum(clear & (bad != (p < BAD_FIT_PROBABILITY)))
    wrong["BAD_FIT"] += np.sum(~bad) if expected == 1 else misplaced(bad, expected, below=True)
    spread, definite = deviations(oracle, point, response, states, case.sigma)
    bits = np.array([(status & Status.unidentified(name)) != 0 for name in Parameters._fields])
    ratio = spread / (0.5 * RANGE[:, None])
    clear = definite & (away > rounding) & ~flagged & (np.abs(ratio - 1) > SLACK[dtype])
    wrong["UNIDENTIFIED"] = np.sum((clear & (bits != (ratio > 1))).any(axis=0))
    if gain in case.dark:
        wrong["UNIDENTIFIED"] += np.sum(~bits.all(axis=0))
    return {name: int(count) for name, count in wrong.items()}


def misplaced(flagged: np.ndarray, share: float, below: bool = False) -> int:
    """By how many pixels a count is off what is expected, beyond chance; ``below``: fewer are welcome."""
    count, (low, high) = int(flagged.sum()), binom.interval(1 - CHANCE, flagged.size, share)
    return int(max(count - high, 0 if below else low - count, 0))


def chi_square(model: Model, oracle: Oracle, point: np.ndarray, response: np.ndarray, states: np.ndarray,
               sigma: float) -> np.ndarray:  # fmt: skip
    """``2 |g J U - V|^2 / sigma^2`` at the best gain, that of the posterior where it has a prior."""
    field = np.moveaxis(oracle.jones(point), -1, 0) @ states
    if isinstance(model.gain, ComplexGain):
        power = np.sum(np.abs(field) ** 2, axis=(-1, -2))
        best = np.sum(field.conj() * response, axis=(-1, -2)) / (power + sigma**2 / model.gain.scale**2)
        field = best[:, None, None] * field
    return 2 * np.sum(np.abs(field - response) ** 2, axis=(-1, -2)) / sigma**2


def rounding_of_chi_square(model: Model, oracle: Oracle, point: np.ndarray, response: np.ndarray, states: np.ndarray,
                           sigma: float, dtype: str) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Between which values chi-square may have been before the reported points were rounded.

    In single precision that of the maximum beside them is one; in double precision the next values of D say how much a
    rounding changes.
    """
    own, size, sign = chi_square(model, oracle, point, response, states, sigma), np.abs(point[0]), np.sign(point[0])

    def at(d: np.ndarray, climb: bool) -> np.ndarray:
        other = np.concatenate([(sign * d)[None], point[1:]])
        with np.errstate(all="ignore"):
            other = oracle.climb(other, response, states, sigma)[0] if climb else other
            return chi_square(model, oracle, other, response, states, sigma)

    if dtype == "complex64":
        other = at(np.minimum(size, 1 - sigma**2), True)  # from a bound itself no slope leads away
        return np.minimum(own, other), np.maximum(own, other)
    near = (np.nextafter(size, 0), np.minimum(np.nextafter(size, 2), 1))
    change = np.max([np.abs(at(d, False) - own) for d in near], axis=0)
    return own - change, own + change


def deviations(oracle: Oracle, point: np.ndarray, response: np.ndarray, states: np.ndarray,
               sigma: float) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Standard deviations ``(5, pixels)`` from the oracle's second derivatives, and where these are definite."""
    angles = np.concatenate([np.arcsin(point[:1]), point[1:]])
    with np.errstate(all="ignore"):
        curvature = np.moveaxis(oracle._derivatives(angles, response, states, sigma)[1], -1, 0)
    finite = np.isfinite(curvature).all(axis=(-1, -2))
    curvature = np.where(finite[:, None, None], curvature, np.eye(5))
    size = np.sqrt(np.abs(np.einsum("nii->ni", curvature)))
    finite &= size.min(axis=1) > 1e-9 * size.max(axis=1)
    size = np.where(finite[:, None], size, 1)
    scaled = curvature / size[:, :, None] / size[:, None]
    definite = finite & (np.linalg.eigvalsh(scaled)[:, 0] > 1e-9)
    scaled = np.where(definite[:, None, None], scaled, np.eye(5))
    variance = np.einsum("nii->ni", np.linalg.inv(scaled)) / size**2
    variance[:, 0] *= np.cos(angles[0]) ** 2
    return np.sqrt(variance).T, definite


def nan_counts(result: Fit) -> tuple[int, int]:
    """Values that are not finite in pixels of status OK, and in those that are flagged but should have an answer."""
    bad = np.zeros(result.status.shape, int)
    values = [*result.parameters, *result.std, result.log_posterior, result.log_evidence, result.chi_square]
    for value in values if result.gain is None else [*values, result.gain]:
        bad += ~np.isfinite(value)
    bad += np.sum(~np.isfinite(result.covariance), axis=(-1, -2))
    answered = (result.status & (Status.MASKED | Status.NON_FINITE)) == 0
    return int(bad[result.status == 0].sum()), int(bad[answered & (result.status != 0)].sum())


def rows_of(case: Case, model: Model, gain: str, pixels: int, checked: int, starts: int) -> Iterator[dict[str, Any]]:
    """The rows of a case, one for each precision."""
    rng = np.random.default_rng(list(case.name.encode()))
    scene = make(case, model, pixels, rng)
    oracle, few = Oracle(type(model.ordering).__name__, gain), np.flatnonzero(scene.good)[:checked]
    with np.errstate(all="ignore"):
        seen, states = scene.response[few], scene.states[few]
        best, top = oracle.maximum(seen, states, case.sigma, starts, rng)
        best, top = better(best, top, *oracle.climb(np.array(scene.truth)[:, few], seen, states, case.sigma))
    precise = best  # where the fit in double precision ends: a start for single precision
    for dtype, real in (("complex128", float), ("complex64", np.float32)):
        if dtype == "complex64" and case.double_only:
            continue
        result = polinfer.fit(model, cast(scene.given, dtype))
        point = np.array([np.asarray(x, float) for x in result.parameters])
        response = scene.response.astype(dtype).astype(complex)
        part, at = (response[few], states, case.sigma), point[:, few]
        with np.errstate(all="ignore"):
            own = oracle.log_posterior(at, *part)
            peak, reference = better(*oracle.climb(np.nan_to_num(best), *part), *oracle.climb(at, *part))
            peak, reference = better(peak, reference, *oracle.climb(np.nan_to_num(precise), *part))
            rounded = oracle.log_posterior(peak.astype(real).astype(float), *part)
            precise = at if dtype == "complex128" else precise
        raw = np.nan_to_num(reference - own, nan=np.inf)
        deficit = np.nan_to_num(np.minimum(reference, rounded) - own, nan=np.inf)
        row = {"case": case.name, "ordering": type(model.ordering).__name__, "gain": gain, "dtype": dtype,
               "sigma": case.sigma, "deficit": float(deficit.max()), "raw": float(raw.max())}  # fmt: skip
        row |= _errors(case, model, scene, point, few, peak)
        wrong = status_errors(case, model, gain, scene, result, point, dtype, response, peak)
        nan, flagged = nan_counts(result)
        text = ", ".join(f"{name} {count}" for name, count in wrong.items() if count) or "-"
        yield row | {"ok_percent": float(100 * np.mean(result.status == 0)), "nan": nan, "nan_flagged": flagged,
                     "wrong": sum(wrong.values()), "which": text}  # fmt: skip


def _errors(case: Case, model: Model, scene: Scene, point: np.ndarray, few: np.ndarray, peak: np.ndarray) -> dict:
    """Error over the bound, and over that of the oracle's maximum."""
    if not case.error:
        return {"rms": float("nan"), "rms_oracle": float("nan")}
    good, kind = scene.good, case.error
    error = regular_bound.squared_error(model, scene.truth, scene.states, point, kind)
    best = point.copy()
    best[:, few] = peak
    bound = regular_bound.bound(model, scene.truth, scene.states, case.sigma, kind)
    own, least = error[few], regular_bound.squared_error(model, scene.truth, scene.states, best, kind)[few]
    return {"rms": float(np.sqrt(error[good].mean() / bound[good].mean())),
            "rms_oracle": float(np.sqrt(own.mean() / least.mean()))}  # fmt: skip


def better(point: np.ndarray, value: np.ndarray, other: np.ndarray, top: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The better of two in every pixel."""
    wins = np.isnan(value) | (top > value)
    return np.where(wins, other, point), np.where(wins, top, value)


def frame_errors(model: Model, dtype: str) -> int:
    """Frames of 1 x 1, 1 x N and N x 1 against the same pixels in a row: pixels that differ by more than rounding."""
    rng = np.random.default_rng(5)
    row = cast(scenes.measure(Model(model.ordering), scenes.from_priors(model, 50, rng), scenes.balanced_states(),
                              SIGMA), dtype)  # fmt: skip
    whole, wrong = polinfer.fit(model, row), 0
    for shape in ((1, 1), (1, 50), (50, 1)):
        count = int(np.prod(shape))
        result = polinfer.fit(model, replace(row, response=row.response[:count].reshape(*shape, 2, -1)))
        apart = np.abs(result.log_posterior.reshape(-1) - whole.log_posterior[:count])
        wrong += int(np.sum((result.status.reshape(-1) != whole.status[:count]) | ~(apart <= DEFICIT[dtype])))
        wrong += any(x.shape != shape for x in (*result.parameters, *result.std, result.status, result.log_evidence))
    return wrong


def main(size: int | None = None, full: bool = False) -> None:
    """Print tables and bars, save the picture."""
    results, pixels = Results("hard_cases"), size or PIXELS
    checked, starts = (pixels, 32) if full else (min(CHECKED, pixels), STARTS)
    combinations = [(RetarderFirst(), "unit"), (PolariserFirst(), "complex")]
    combinations += [(RetarderFirst(), "complex"), (PolariserFirst(), "unit")] if full else []
    for ordering, gain in combinations:
        for case in cases():
            for row in rows_of(case, Model(ordering, gain=GAINS[gain]), gain, pixels, checked, starts):
                results.add(**row)
    rows = results.rows.copy()
    for dtype, limit in DEFICIT.items():
        mine = [row for row in rows if row["dtype"] == dtype]
        worst = max(mine, key=lambda row: row["deficit"])
        results.bar(f"{dtype}, worst deficit ({_name(worst)})", worst["deficit"], limit, "nat")
    high = [row for row in rows if 1 / row["sigma"] >= LOW_SNR and np.isfinite(row["rms"])]
    low = [row for row in rows if 1 / row["sigma"] < LOW_SNR and np.isfinite(row["rms"])]
    for name, mine, key in (("bound", high, "rms"), ("oracle's error, low SNR", low, "rms_oracle")):
        worst = max(mine, key=lambda row: row[key])
        results.bar(f"rms error over {name}, worst ({_name(worst)})", worst[key], 1.2)
    results.bar("pixels with a wrong status", sum(row["wrong"] for row in rows), 0)
    results.bar("values not finite where the status is OK", sum(row["nan"] for row in rows), 0)
    apart = max(regular_bound.disagreement(Model(o, gain=GAINS[g]), np.random.default_rng(3)) for o, g in combinations)
    results.bar("bound against that from the parameters, relative difference", apart, 1e-3)
    frames = sum(frame_errors(Model(o, gain=GAINS[g]), dtype) for o, g in combinations for dtype in DEFICIT)
    results.bar("pixels that differ in frames of 1 x 1, 1 x N, N x 1", frames, 0)
    results.save(bad_fit.add(results, pixels, combinations))


def _name(row: dict[str, Any]) -> str:
    return ", ".join(str(row[key]) for key in ("case", "ordering", "gain", "dtype"))


if __name__ == "__main__":
    main()
