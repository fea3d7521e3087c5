"""How wrong the retrieved fields are, from the data alone: the closure of the illumination states.

In: fields of the same scene in n known states, with the variance that the image noise explains. Out: the numbers that
turn that variance into the one the closure errors show. Called by ``retrieve_fields``.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize

from polinfer.checks import complex_array, real_array

__all__ = [
    "NoiseScale",
    "closure_errors",
    "closure_phase_maps",
    "closure_phases",
    "closure_tilts",
    "noise_of_groups",
    "noise_scale",
]

FAILED = 4.0  # squared closure errors over the expected, above which a group is not like the others
SETTLED = 1e-4  # relative change of the expected closure errors at which the noise is found

WINDOW = 5.0  # fibrelets: width of the windows in which captures are closed apart
GAIN = 0.02  # by which they must close better


@dataclass(frozen=True)
class NoiseScale:
    """True variance = inflation x stated variance + relative_error^2 x |field|^2 + stray^2 x mean |field|^2.

    inflation >= 1, one of both polarisations or one of each: H is retrieved and V divided by it, and what is stated of
    them need not be wrong alike. The mean is that of a capture, over both polarisations and all fibrelets. No variance
    is inflated to more than the power that there may be.
    """

    inflation: float | tuple[float, float] = 1.0
    relative_error: float = 0.0
    stray: float = 0.0

    def expected(self, errors: np.ndarray) -> np.ndarray:
        """Squared closure errors that are to be expected, (...), of ``errors`` as in :func:`noise_scale`."""
        _, stated, *powers = errors
        own = np.asarray(self.inflation)[..., None] * stated
        factors = np.array([self.relative_error**2, self.stray**2][: len(powers)])
        return np.asarray(own + np.tensordot(factors, powers, 1))

    def variance(self, fields: np.ndarray, stated: np.ndarray, most: Any = np.inf) -> np.ndarray:
        """Variance of ``fields`` (..., 2, m) whose image noise alone gives ``stated``; ``most``: the power of their
        prior, which is all there is to know of a field that the images do not show."""
        power = np.abs(fields) ** 2
        mean = power.mean((-2, -1), keepdims=True)
        inflated = np.minimum(np.asarray(self.inflation)[..., None] * stated, np.maximum(stated, most))
        return inflated + self.relative_error**2 * power + self.stray**2 * mean


def closure_errors(fields: np.ndarray, variance: np.ndarray, states: np.ndarray) -> np.ndarray:
    r"""Squared closure errors, their stated variance and the power they stem from, real (3, n - 2, ...).

    n fields that depend linearly on states U (2, n) obey :math:`\sum_k c_k y_k = 0` for every c with U c = 0; there
    are n - 2 of unit length. Returns :math:`|\sum c_k y_k|^2`, :math:`\sum |c_k|^2 \mathrm{var}_k` and
    :math:`\sum |c_k|^2 |y_k|^2`. ``fields`` complex, ``variance`` real: (n, ...).

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> fields = np.einsum("an,a->n", states, [0.3, 2j])[:, None]
    >>> bool(closure_errors(fields, np.ones((3, 1)), states)[0].max() < 1e-25)
    True
    """
    states = complex_array("states", states, shape=(2, None), finite=True)
    fields = complex_array("fields", fields)
    variance = real_array("variance", variance)
    null = scipy.linalg.null_space(states)
    share = np.abs(null) ** 2
    return np.stack([
        np.abs(np.einsum("kc,k...->c...", null, fields)) ** 2,
        np.einsum("kc,k...->c...", share, variance),
        np.einsum("kc,k...->c...", share, np.abs(fields) ** 2),
    ])  # fmt: skip


def closure_phases(fields: np.ndarray, variance: np.ndarray, states: np.ndarray, iterations: int = 200) -> np.ndarray:
    r"""Phases by which n captures should be turned so that their states close best, (n,) radians of mean 0.

    Minimises :math:`\sum_c \sum |\sum_k c_k e^{i \phi_k} y_k|^2 / \mathrm{var}` over the phases, one after the other
    (each has a closed form), from 0 and from the eigenvector that closes without noise; the better counts. Thousands
    of amplitudes have a say, where a reference spot has a few. With fewer
    than three states nothing can be told and all phases are 0. Shapes as in :func:`closure_errors`.

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> turned = np.exp(1j * np.array([[0.1], [-0.2], [0.1]]))
    >>> fields = turned * np.einsum("an,ax->nx", states, [[0.3, 1.0], [2j, -1.0]])
    >>> closure_phases(fields, np.ones((3, 2)), states).round(6).tolist()
    [-0.1, 0.2, -0.1]
    """
    states = complex_array("states", states, shape=(2, None), finite=True)
    count = states.shape[1]
    if count < 3:
        return np.zeros(count)
    null = scipy.linalg.null_space(states)
    flat = complex_array("fields", fields).reshape(count, -1)
    weight = 1 / real_array("variance", variance).reshape(count, -1).mean(0)
    gram = (flat.conj() * weight) @ flat.T
    matrix = gram * (null.conj() @ null.T)
    first = np.linalg.eigh((matrix + matrix.conj().T) / 2)[1][:, 0]
    np.fill_diagonal(matrix, 0)
    turn = min(
        (_turned(matrix, start, iterations) for start in (np.ones(count, complex), np.exp(1j * np.angle(first)))),
        key=lambda found: float((found.conj() @ matrix @ found).real),
    )
    phases = np.angle(turn / turn[0])
    # only differences of phase are seen: keep the captures, on average, where the reference put them
    return phases - phases.mean()


def _turned(matrix: np.ndarray, start: np.ndarray, iterations: int) -> np.ndarray:
    """Numbers of modulus 1 that make x^H M x small, one after the other; M has no diagonal."""
    turn = start
    for _ in range(iterations):
        before = turn.copy()
        for k in range(len(turn)):
            pull = matrix[k] @ turn
            turn[k] = -pull / abs(pull) if pull != 0 else turn[k]
        if np.abs(turn - before).max() < 1e-12:
            break
    return turn


def closure_phase_maps(fields: np.ndarray, variance: np.ndarray, states: np.ndarray, centres: np.ndarray) -> np.ndarray:
    r"""Phases (n, m), slowly changing over the facet, that make n captures close best; of mean 0 over the captures.

    As :func:`closure_phases`, from where that has put the captures, in Gaussian windows of five fibrelets' width,
    between whose phases is interpolated. Retrieval over hundreds of fibrelets finds the phase between neighbours and
    hardly that from edge to edge, and the captures of one scene need not agree in it. All 0 where the squared closure
    errors fall by less than a fiftieth, which is ten times what noise alone would let them, and with fewer than three
    states.
    ``fields`` (n, ..., m), ``centres`` (m, 2).

    >>> rng, states = np.random.default_rng(0), np.array([[1, 1, 1], [1, 1j, -1]])
    >>> centres = np.stack(np.mgrid[:40, :40], -1).reshape(-1, 2) * 1.0
    >>> clean = np.einsum("an,am->nm", states, rng.normal(size=(2, 1600)))
    >>> bent = np.array([0.0, 1.0, -1.0])[:, None] * np.sin(centres[:, 0] / 15)
    >>> found = closure_phase_maps(np.exp(1j * bent) * clean, np.ones((3, 1600)), states, centres)
    >>> bool(np.std(found + bent) < 0.15 * np.std(bent))
    True
    """
    states, count = np.asarray(states), np.shape(states)[1]
    flat = np.asarray(fields).reshape(count, -1, len(centres))
    if count < 3 or len(centres) < 2:
        return np.zeros((count, len(centres)))
    null = scipy.linalg.null_space(states)
    weight = 1 / np.asarray(variance).reshape(flat.shape).mean(0)
    shares = null.conj() @ null.T
    width = WINDOW * float(np.sqrt(np.prod(np.ptp(centres, axis=0)) / len(centres)))  # the facet in a rectangle
    if not width > 0:
        return np.zeros((count, len(centres)))
    # in single precision, which knows a phase to 1e-7
    along = [((np.arange(u.min(), u.max() + width, width)[:, None] - u) / width).astype(np.float32) for u in centres.T]
    rows, columns = (np.exp(-(u**2) / 2) for u in along)
    matrix = np.zeros((len(rows), len(columns), count, count), complex)
    for k, other in itertools.combinations(range(count), 2):
        each = (shares[k, other] * (flat[k].conj() * weight * flat[other]).sum(0)).astype(np.complex64)
        matrix[..., k, other] = (rows * each) @ columns.T
        matrix[..., other, k] = matrix[..., k, other].conj()
    turn = np.ones(matrix.shape[:3], complex)
    for _ in range(30):
        for k in range(count):
            pull = np.einsum("abl,abl->ab", matrix[..., k, :], turn)
            size = np.abs(pull)
            turn[..., k] = np.where(size > 0, -pull / np.where(size > 0, size, 1), turn[..., k])
    angles = np.angle(turn / turn[..., :1])
    unit = np.exp(1j * (angles - angles.mean(-1, keepdims=True))).astype(np.complex64)
    rows, columns = (np.exp(-((u / 0.7) ** 2) / 2) for u in along)
    phases = np.stack([np.angle((rows * (unit[..., k] @ columns)).sum(0)) for k in range(count)]).astype(float)
    phases -= phases.mean(0)

    def left(fields: np.ndarray) -> float:
        return float((np.abs(np.einsum("kc,kqm->cqm", null, fields)) ** 2 * weight).sum())

    if left(flat * np.exp(1j * phases)[:, None]) > (1 - GAIN) * left(flat):
        return np.zeros_like(phases)
    return phases


def closure_tilts(
    fields: np.ndarray, variance: np.ndarray, states: np.ndarray, centres: np.ndarray, steps: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    r"""Pistons (n,), radians, and tilts (n, 2), radians a metre, that make n captures close best; means of 0.

    As :func:`closure_phases` with the phase :math:`\phi_k + g_k \cdot r`, r = ``centres`` (m, 2) less their mean, by
    Gauss-Newton steps from the pistons alone: what a fibre's beam moves between captures a minute's reference cannot
    follow. ``fields`` (n, ..., m). All 0 with fewer than three states.

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> centres = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    >>> centres -= centres.mean(0)
    >>> tilts = np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, -0.2]])
    >>> clean = np.einsum("an,am->nm", states, np.random.default_rng(1).normal(size=(2, 50)))
    >>> turned = np.exp(1j * tilts @ centres.T) * clean
    >>> found = closure_tilts(turned, np.ones((3, 50)), states, centres)[1]
    >>> bool(np.allclose(found, -tilts, atol=1e-6))
    True
    """
    phases = closure_phases(fields, variance, states)
    count = len(phases)
    tilts = np.zeros((count, 2))
    place = centres - centres.mean(0)
    size = float(np.sqrt((place**2).sum(1).mean()))
    if count < 3 or not size > 0:
        return phases, tilts
    null = scipy.linalg.null_space(np.asarray(states))
    flat = np.asarray(fields).reshape(count, -1, len(place))
    root = 1 / np.sqrt(np.asarray(variance).reshape(flat.shape).mean(0))
    design = np.concatenate([np.ones((len(place), 1)), place / size], axis=1)
    found = np.concatenate([phases[:, None], tilts], axis=1)
    for _ in range(steps):
        turned = flat * np.exp(1j * found @ design.T)[:, None] * root
        left = np.einsum("kc,kqm->cqm", null, turned).ravel()
        slopes = 1j * np.einsum("kc,kqm,mj->cqmkj", null, turned, design).reshape(len(left), -1)
        # the same ramp on all captures changes nothing: of all solutions the smallest
        change = np.linalg.lstsq(
            np.concatenate([slopes.real, slopes.imag]), -np.concatenate([left.real, left.imag]), rcond=1e-8
        )[0]
        found = found + change.reshape(count, 3)
        found -= found.mean(0)
    return found[:, 0], found[:, 1:] / size


def noise_scale(errors: np.ndarray, by_polarisation: bool = False) -> NoiseScale:
    """The noise that makes squared closure errors as large as expected, each being exponential.

    ``errors`` (3 or 4, ...), with ``by_polarisation`` (3 or 4, 2, count): squared, their stated variance, the power
    they stem from, and the mean power of their captures. Phase retrieval errs in three ways: by the image noise, alike
    everywhere; by a phase that wanders over the frame, in proportion to the field; and by light of the bright places
    that it puts into dark ones, in proportion to all the light (0 without the fourth row). Non-negative least squares
    in units of the expectation (reweighted; the maximum likelihood of exponential variables), the first factor never
    below 1, with ``by_polarisation`` one of each; the others are those of both. Without data (fewer than three states)
    nothing is changed.
    """
    squared, stated, *powers = (row if by_polarisation else row.reshape(1, -1) for row in errors)
    if squared.size == 0:
        return NoiseScale((1.0, 1.0) if by_polarisation else 1.0)
    own = np.stack([np.where(np.arange(len(stated))[:, None] == i, stated, 0).ravel() for i in range(len(stated))])
    terms = np.concatenate([own, np.stack([power.ravel() for power in powers])])
    squared, stated = squared.ravel(), stated.ravel()
    factors = np.zeros(len(terms))
    factors[len(own)] = np.sum(np.maximum(squared - stated, 0)) / max(np.sum(powers[0]), 1e-300)
    for _ in range(30):
        expected = stated + factors @ terms
        factors, _ = scipy.optimize.nnls((terms / expected).T, (squared - stated) / expected)
        if np.all(np.abs(stated + factors @ terms - expected) <= SETTLED * expected):
            break
    inflation = tuple((1 + factors[: len(own)]).tolist())
    return NoiseScale(inflation if by_polarisation else inflation[0], *np.sqrt(factors[len(own) :]).tolist())


def noise_of_groups(groups: list[np.ndarray], by_polarisation: bool = False) -> tuple[NoiseScale, np.ndarray]:
    """The noise of most groups of captures, and by how much each group's variance is larger, (groups,), >= 1.

    A retrieval can fail in one capture of many: its group closes far worse than the others, must not set the noise
    of all, and is not to be believed as they are. The worst group is left out if its errors are more than four
    times, on average, what the noise of the others makes expected, then the next, as long as half of all are left;
    those that are out get the factor that they show, all others 1. ``groups``: errors as in :func:`noise_scale`,
    one array a group, empty for groups of fewer than three states.

    >>> rng = np.random.default_rng(0)
    >>> powers = np.ones((3, 500))
    >>> quiet = [np.concatenate([rng.exponential(1.0, (1, 500)), powers * [[1], [0], [0]]]) for _ in range(9)]
    >>> failed = np.concatenate([rng.exponential(50.0, (1, 500)), powers * [[1], [0], [0]]])
    >>> scale, factors = noise_of_groups([*quiet, failed])
    >>> bool(scale.inflation < 1.1), factors[:9].tolist() == [1.0] * 9, bool(factors[9] > 40)
    (True, True, True)
    """
    usable = np.array([errors.size > 0 for errors in groups], bool)
    factors = np.ones(len(groups))
    if not usable.any():
        return noise_scale(np.empty((3, 2, 0)), by_polarisation), factors
    kept = usable.copy()

    def scale_of(chosen: np.ndarray) -> NoiseScale:
        errors = np.concatenate([e for e, k in zip(groups, chosen, strict=True) if k], axis=-1)
        return noise_scale(errors, by_polarisation)

    def factor(scale: NoiseScale, i: int) -> float:
        return float(np.mean(groups[i][0] / np.maximum(scale.expected(groups[i]), 1e-300)))

    scale = scale_of(kept)
    while kept.sum() > max(1, 0.5 * usable.sum()):
        ratios = {int(i): factor(scale, int(i)) for i in np.flatnonzero(kept)}
        worst = max(ratios, key=lambda i: ratios[i])
        others = kept.copy()
        others[worst] = False
        without = scale_of(others)
        # judged by the others: with few groups a bad one makes itself expected
        if factor(without, worst) <= FAILED:
            break
        kept, scale = others, without
    for i in np.flatnonzero(usable & ~kept):
        factors[i] = max(factor(scale, int(i)), 1.0)
    return scale, factors
