"""A frame through the compiled sweeps: blocks of pixels on all cores, and more sweeps where chains do not agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import ndtri

from ...fitting.fast.data import times_adjoint
from ...fitting.fast.engine import pairs_of
from ...fitting.fast.frame import judge_states
from ...fitting.fast.overlap import Pauli, pauli
from ...fitting.fast.point import Point
from ...fitting.fast.priors import FACTORS
from ...fitting.generic import Prepared, prepare
from ...model import Model
from ...noise import InferredNoise, KnownNoise
from ...records import Fit, Measurement, Parameters
from ...statistics import Statistics
from ...threads import each, piece
from ..diagnostics import least_effective
from ..raw import Raw
from . import kernel
from .evidence import MOST_DRAWS, Given, log_evidence, unavailable
from .plan import Plan, plan
from .random import begin
from .sampler import Gibbs
from .sweep import Observed, State

__all__ = ["Problem", "draw_gibbs", "part_of", "problem_of"]

BLOCKS, FEW = (16, 512), 128  # numbers of pixels for which code is compiled; up to FEW pixels take small ones
ACCELERATOR = (128, 1024, 1 << 14)  # the same where thousands of threads work side by side
LEAST_BATCHES = 8  # that the diagnostics have
MORE = (2, 4, 16)  # how many times as many sweeps for a draw are tried where chains have not converged
LARGEST_R = 1.05
NEAR = 1.7  # times the effective draws that are asked for: where batches find fewer, they are counted more exactly
EVIDENCE_BLOCK = 32  # pixels
PURPOSES = 8  # streams of a pixel and chain that one attempt may use
SPREAD = 1.5  # standard deviations by which the chains are moved apart at the start


class Problem(NamedTuple):
    """What is drawn from, on the host: statistics by pixels, and the fit that the chains begin at."""

    model: Model
    plan: Plan
    balanced: bool
    statistics: Statistics
    fit: dict[str, np.ndarray]
    dtype: np.dtype


def _statistics(model: Model, measurement: Measurement, good: np.ndarray) -> Statistics:
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        model, measurement = replace(model, noise=KnownNoise()), replace(measurement, sigma=np.ones(()))
    prepared: Prepared = prepare(model, measurement, model.noise.integrated)
    found = prepared.pooled.take(good)
    assert isinstance(found, Statistics)
    return found


def problem_of(model: Model, measurement: Measurement, fit: Fit, good: np.ndarray) -> Problem:
    """The pixels with the flat numbers ``good`` made ready.

    Raises
    ------
    ValueError: a model whose conditional distributions are not known.
    """
    known = plan(model)
    if isinstance(known, str):
        raise ValueError(f"model: the Gibbs sampler cannot draw from it, because {known}; use sampler=Ensemble().")
    statistics = _statistics(model, measurement, good)
    dtype = np.zeros((), jax.dtypes.canonicalize_dtype(measurement.response.dtype)).real.dtype
    lead = (len(good),)
    shapes = {"illumination": (2, 2), "response": (2, 2)}
    statistics = Statistics(
        **{k: np.broadcast_to(v, (*lead, *shapes.get(k, ()))) for k, v in statistics._asdict().items()}
    )
    values = {name: np.asarray(x, float).reshape(-1)[good] for name, x in fit.parameters._asdict().items()}
    values |= {f"std_{name}": np.asarray(x, float).reshape(-1)[good] for name, x in fit.std._asdict().items()}
    values["sigma"] = np.asarray(fit.sigma, float).reshape(-1)[good]
    if fit.gain is not None:
        values["gain"] = np.asarray(fit.gain).reshape(-1)[good]
    usable, balanced = judge_states(np.asarray(statistics.illumination), dtype)
    return Problem(model, known, balanced and bool(usable.all()), statistics, values, dtype)


def part_of(problem: Problem, part: np.ndarray) -> Problem:
    """Some of the pixels, by their place in the problem; a frame that shares its sigma has no parts."""
    statistics = Statistics(*(x[part] for x in problem.statistics))
    return problem._replace(statistics=statistics, fit={name: x[part] for name, x in problem.fit.items()})


def _elements(a: np.ndarray, dtype: np.dtype) -> Any:
    return [[(a[:, i, j].real.astype(dtype), a[:, i, j].imag.astype(dtype)) for j in (0, 1)] for i in (0, 1)]


def _observed(problem: Problem, index: np.ndarray) -> Observed:
    """The statistics of the pixels ``index``; products in double precision before they are rounded."""
    s, dtype = problem.statistics, problem.dtype
    r, y = (_elements(x[index], np.dtype(float)) for x in (s.illumination, s.response))
    cast = lambda k: Pauli(*((re.astype(dtype), im.astype(dtype)) for re, im in k))  # noqa: E731
    return Observed(
        np.ones((), dtype),
        cast(pauli(times_adjoint(y, r))),
        cast(pauli(times_adjoint(r, r))),
        _elements(s.illumination[index], dtype),
        _elements(s.response[index], dtype),
        s.residual[index].astype(dtype),
        s.count[index].astype(dtype),
    )


def _point(problem: Problem, index: np.ndarray, chains: int, apart: list[np.ndarray] | None = None) -> Point:
    """Chains at the fit's parameters, moved ``apart`` by so many standard deviations; all ``(chains, pixels)``."""
    values = []
    for i, name in enumerate(Parameters._fields):
        value = np.broadcast_to(np.nan_to_num(problem.fit[name][index]), (chains, len(index)))
        if apart is not None and problem.plan.fixed[i] is None:
            value = value + np.minimum(np.nan_to_num(problem.fit[f"std_{name}"][index]), 0.5) * apart[i]
        values.append(value)
    values[0] = np.clip(values[0], -0.999, 0.999)
    if problem.plan.bounded:
        values[2] = np.clip(values[2], -0.999 * np.pi, 0.999 * np.pi)
    pairs = pairs_of(Parameters(*values), np.dtype(float))
    for i, known in enumerate(problem.plan.fixed):
        if known is not None:
            pairs[2 * i], pairs[2 * i + 1] = known
    pairs = pairs.astype(problem.dtype)
    return Point(*((pairs[2 * i], pairs[2 * i + 1]) for i in range(5)))


def _inside(problem: Problem, index: np.ndarray, point: Point) -> Point:
    """Where a prior forbids the moved start, the fit's own."""
    unmoved = _point(problem, index, point[0][0].shape[0])
    allowed: Any = True
    for prior, pair in zip(problem.plan.prior, point, strict=True):
        found = None if prior is None else prior.evaluate(pair)
        if found is not None:
            allowed = allowed & np.isfinite(found[0])
    return jax.tree.map(lambda a, b: np.where(allowed, a, b), point, unmoved)


def _start(problem: Problem, index: np.ndarray, chains: int, numbers: np.ndarray, seed: int, attempt: int) -> State:
    """Where the chains begin; of the frame a pixel's start depends on its number only."""
    words = [begin(seed, numbers, chains, PURPOSES * attempt + 1 + i)[0] for i in range(5)]
    apart = [SPREAD * ndtri((w + 0.5) / 2.0**32) for w in words]
    point = _inside(problem, index, _point(problem, index, chains, apart))
    shape, dtype = (chains, len(index)), problem.dtype
    gain = (np.ones(shape, dtype), np.zeros(shape, dtype))
    if "gain" in problem.fit:
        g = np.broadcast_to(problem.fit["gain"][index], shape)
        if problem.plan.gain == "phase":
            g = np.where(np.abs(g) > 0, g / np.maximum(np.abs(g), 1e-30), 1)
        gain = (g.real.astype(dtype), g.imag.astype(dtype))
    precision = np.ones(shape, dtype)
    if problem.plan.noise != "known":
        precision = np.broadcast_to(problem.fit["sigma"][index] ** -2.0, shape).astype(dtype)
    return State(point, gain, precision)


def _reference(problem: Problem, index: np.ndarray) -> Any:
    """Cosines and sines of what :func:`kernel._aligned` compares, of the fit."""
    value = {name: np.nan_to_num(problem.fit[name][index]) for name in Parameters._fields}
    found: list[Any] = [value["diattenuation"].astype(problem.dtype)]
    for name, factor in zip(Parameters._fields[1:], FACTORS[1:], strict=True):
        angle = value[name] * (1.0 if name == "retardance" else factor)
        found.append(tuple(f(angle).astype(problem.dtype) for f in (np.cos, np.sin)))
    return tuple(found)


class _Chains:
    """Draws of all pixels, and the sums of their batches."""

    def __init__(self, problem: Problem, chains: int, draws: int, pixels: int) -> None:
        dtype = problem.dtype
        self.parameters = np.empty((5, chains, draws, pixels), dtype)
        self.gain = None
        if problem.plan.gain != "unit":
            self.gain = np.empty((chains, draws, pixels), np.result_type(dtype, np.complex64))
        self.precision = None if problem.plan.noise == "known" else np.empty((chains, draws, pixels), dtype)
        self.sums: np.ndarray | None = None
        # all batches have the same length; what is left of the last is dropped
        self.length = min(kernel.BATCH, -(-draws // LEAST_BATCHES))
        self.batches = -(-draws // self.length)

    def store(self, number: int, take: Any, count: int, batch: kernel.Batch) -> None:
        """Batch ``number`` of the pixels ``take``, of which ``count`` are meant."""
        begin = number * self.length
        kept = min(self.length, self.parameters.shape[2] - begin)
        span = slice(begin, begin + kept)
        new = np.asarray(batch.parameters)[:kept, ..., :count]
        self.parameters[:, :, span, take] = np.moveaxis(new, (0, 1, 2), (2, 0, 1))
        if self.gain is not None:
            pair = np.asarray(batch.gain)[:kept, ..., :count]  # (draws, 2, chains, pixels)
            self.gain.real[:, span, take], self.gain.imag[:, span, take] = np.moveaxis(pair, (0, 2), (2, 1))
        if self.precision is not None:
            self.precision[:, span, take] = np.moveaxis(np.asarray(batch.precision)[:kept, ..., :count], 0, 1)
        assert self.sums is not None
        self.sums[number][..., take] = np.asarray(batch.sums, float)[..., :count]


def _span(places: np.ndarray) -> Any:
    """The same places as a slice where they follow each other: arrays of indices take ten times as long."""
    follow = len(places) > 0 and np.array_equal(places, np.arange(places[0], places[0] + len(places)))
    return slice(int(places[0]), int(places[-1]) + 1) if follow else places


def convergence(sums: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Split R-hat and effective draws of the invariants, (invariants, pixels).

    ``sums`` ``(batches, 2, invariants, chains, pixels)`` of batches of ``length`` draws. The effective number comes
    from the variance of the batch means.
    """
    firsts, (batches, invariants, chains, pixels) = sums[:, 0], sums[:, 0].shape
    n, half = batches * length, max(batches // 2, 1)
    size = half * length
    # the sums are about a centre near the mean, so that differences of squares are exact enough
    halves = np.stack([firsts[:half].sum(0), firsts[-half:].sum(0)]) / size  # (2, invariants, chains, pixels)
    whole = firsts.sum(0) / n
    within = sums[:, 1].sum(0) / n - whole**2  # (invariants, chains, pixels)
    variance = np.maximum(within.mean(axis=1), 0)
    spread = halves.swapaxes(0, 1).reshape(invariants, -1, pixels).var(axis=1, ddof=1)
    still = variance <= 1e-12 * np.max(variance, axis=0, initial=1e-30)  # what a fixed parameter makes constant
    with np.errstate(divide="ignore", invalid="ignore"):
        r_hat = np.sqrt((size - 1) / size + spread / variance)
        count = batches * chains
        squares = np.einsum("bicp,bicp->ip", firsts, firsts) / length**2  # of the batch means
        total = np.maximum(squares - count * whole.mean(1) ** 2, 0) / (count - 1) * length
        effective = chains * n * (variance + spread) / np.maximum(total, 1e-300)
    r_hat = np.where(still, 1.0, r_hat)
    effective = np.where(still, chains * n, np.minimum(effective, 2 * chains * n))
    return r_hat, effective


def _judged(problem: Problem, store: _Chains, near: dict[str, np.ndarray]) -> np.ndarray:
    """Least effective draws by the sum of all autocorrelations, which is slower than batches and sees longer ones.

    ``near``: the invariants that matter, for each a bool per pixel; infinite where none does.
    """
    # of a logarithm: that of the precision is as good as that of sigma
    return least_effective(problem.model, Parameters(*store.parameters), store.gain, store.precision, near)


def _run(
    problem: Problem, store: _Chains, pixels: np.ndarray, numbers: np.ndarray, chains: int, sampler: Gibbs, thin: int,
    seed: int, attempt: int, done: Callable[[int], Any],
) -> None:  # fmt: skip
    """Draw for the pixels with the places ``pixels`` and the numbers ``numbers`` in the frame."""
    frame = problem.plan.noise == "frame"
    sizes = BLOCKS if piece(0, 1) == 0 else ACCELERATOR
    small = [s for s in sizes[:-1] if len(pixels) <= max(s, FEW)]
    size = len(pixels) if frame else small[0] if small else sizes[-1]

    def block(begin_at: int) -> None:
        own = pixels[begin_at : begin_at + size]
        count, take = len(own), _span(own)
        index = np.concatenate([own, np.full(size - count, own[0])])
        stream = begin(seed, numbers[index], chains, PURPOSES * attempt)
        data, reference = _observed(problem, index), _reference(problem, index)
        state = _start(problem, index, chains, numbers[index], seed, attempt)
        first = jax.tree.map(lambda x: x[:1], state)._replace(point=_point(problem, index, 1))
        found = kernel.invariants(problem.plan, first).values()
        centre = np.stack([np.broadcast_to(np.asarray(x), (1, size))[0] for x in found])
        run = (problem.plan, problem.balanced)
        warm = -(-sampler.warmup // store.length)
        for number in range(-warm, store.batches):
            state, stream, batch = kernel.advance(*run, store.length, thin, data, reference, centre, state, stream)
            if number >= 0:
                store.store(number, take, count, batch)
        done(count)

    each(block, range(0, len(pixels), size))


def _evidence(problem: Problem, store: _Chains, count: int) -> np.ndarray:
    """Log evidence and its standard error, (2, pixels)."""
    found = np.empty((2, count))
    _, chains, draws, _ = store.parameters.shape
    factors = np.array([0.5, 2.0, 1.0])[:, None, None, None]
    kept = np.linspace(0, draws - 1, max(min(draws, MOST_DRAWS // chains) // 10 * 10, 10)).astype(int)

    def block(begin_at: int) -> None:
        index = np.arange(begin_at, min(begin_at + EVIDENCE_BLOCK, count))
        double = problem._replace(dtype=np.dtype(float))
        observed = _observed(double, index)
        fit = [np.nan_to_num(problem.fit[name][index]) for name in Parameters._fields]
        point = np.stack([0.5 * np.arcsin(np.clip(fit[0], -1, 1)), 2 * fit[1], 0.5 * fit[2], 2 * fit[3], fit[4]])
        power = np.sum(np.abs(problem.statistics.response[index]) ** 2, axis=(-1, -2))
        retarder = store.parameters[2:, :, kept][..., index].astype(float) * factors
        gain = None if store.gain is None else store.gain[:, kept][..., index].reshape(-1, len(index))
        given = Given(
            observed.product, observed.power, problem.balanced, point, problem.statistics.constant[index] - power,
            retarder.reshape(3, -1, len(index)), gain, chains,
        )  # fmt: skip
        found[:, index] = log_evidence(problem.plan, given)

    each(block, range(0, count, EVIDENCE_BLOCK))
    return found


def draw_gibbs(
    problem: Problem, numbers: np.ndarray, sampler: Gibbs, chains: int, draws: int, seed: int,
    done: Callable[[int], Any] = lambda _: None,
) -> Raw:  # fmt: skip
    """Draws of all pixels of a problem; ``numbers`` are their flat places in the frame, which choose random numbers."""
    known, count = problem.plan, len(numbers)
    store = _Chains(problem, chains, draws, count)
    names = list(kernel.invariants(known, _start(problem, np.zeros(1, int), 1, numbers[:1], seed, 0)))
    store.sums = np.zeros((store.batches, 2, len(names), chains, count))
    pixels = np.arange(count)
    # few draws cannot reach the number asked for, and their R-hat scatters
    enough, largest = min(sampler.effective, 0.2 * chains * draws), LARGEST_R + 2 / np.sqrt(chains * draws)
    # the number from so many batches is uncertain: twice its standard error
    surely = min(enough * (1 + 2 * (2 / (chains * store.batches)) ** 0.5), 0.25 * chains * draws)
    r_hat, effective = np.empty(count), np.empty(count)
    for attempt, more in enumerate((1, *MORE)):
        _run(problem, store, pixels, numbers, chains, sampler, sampler.thin * more, seed, attempt, done)
        sums = store.sums if len(pixels) == count else store.sums[..., pixels]
        found, number = convergence(sums, store.length)
        near = np.zeros((len(names), count), bool)
        near[:, pixels] = number < NEAR * enough
        least = _judged(problem, store, dict(zip(names, near, strict=True)))
        r_hat[pixels], effective[pixels] = found.max(axis=0), np.minimum(number.min(axis=0), least[pixels])
        pixels = pixels[(r_hat[pixels] > largest) | (effective[pixels] < surely)]
        if known.noise == "frame" or len(pixels) == 0:
            break
    converged = (r_hat <= largest) & (effective >= enough)
    evidence = np.full((2, count), np.nan)
    if sampler.evidence and unavailable(known) is None:
        evidence = _evidence(problem, store, count)
    sigma = None if store.precision is None else store.precision**-0.5
    return Raw(Parameters(*store.parameters), store.gain, sigma, evidence[0], evidence[1], converged)
