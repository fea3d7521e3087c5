"""Gauss-Newton steps on mode amplitudes, preconditioned by what neighbours' phases mean to the images.

In: a start, images and their inverse variances on the coarse grid. Out: amplitudes, and what was found of the focus and
the planes' gains. Called by :class:`fibre.Modal`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.ndimage
import scipy.sparse
from scipy.sparse.linalg import SuperLU, splu

from fibre.fibrelets import lattice_pitch
from fibre.retrieval.modal.views import Views, squared

__all__ = ["Coupling", "Found", "Problem", "make_coupling", "refine"]

NEAR = 3.2  # pitches: the farthest neighbours in the preconditioner
DAMPING = 1e-3
ENOUGH = 6  # planes, from which on half of them make the curvature
BLOCK = 4  # coarse pixels in a block along an axis, for the preconditioner's weights: a mode's diameter


@dataclass(frozen=True)
class Coupling:
    """How strongly images see the phase between neighbours: pairs (p, 2), the middle of each as place (p,) in the
    flattened coarse grid, strength (image, p) of unit amplitudes and weights; own (image,) of a mode with itself, its
    place (m,); radii (image,) in coarse pixels, for smoothing the weights; order (m,) in which modes are eliminated."""

    pairs: np.ndarray
    middles: np.ndarray
    strength: np.ndarray
    own: np.ndarray
    places: np.ndarray
    radii: np.ndarray
    order: np.ndarray


@dataclass(frozen=True)
class Problem:
    """Images (image, y, x) of one field, their inverse variances (0: unusable), and what is not known of the bench.

    turn: (y, x) radians a metre of defocus for every frequency, or None where the focus is known; focus_spread: metres;
    gain_spread: relative, 0 where the gains are known.
    """

    images: np.ndarray
    weights: np.ndarray
    turn: np.ndarray | None = None
    focus_spread: float = 0.0
    gain_spread: float = 0.0

    @cached_property
    def usable(self) -> int:
        """How many pixels say something."""
        return int(np.count_nonzero(self.weights))


@dataclass(frozen=True)
class Found:
    """amplitudes (m,); focus, metres; gains (image,); cost: mean weighted squared residual; step: the last relative
    change of the amplitudes; steps: how many. powers: what the images should be without their gains, (image, y, x)."""

    amplitudes: np.ndarray
    focus: float
    gains: np.ndarray
    cost: float = np.inf
    step: float = np.inf
    steps: int = 0
    powers: np.ndarray | None = None


def make_coupling(tree: scipy.spatial.cKDTree, views: Views, radii: np.ndarray) -> Coupling:
    """Of Gaussian beams of 1/e radii (image,), metres: squares of two overlap by exp(-d^2 / w^2) / (pi w^2)."""
    centres = np.asarray(tree.data)
    pitch = lattice_pitch(centres)
    reach = min(1.9 * float(radii.max()), NEAR * pitch)
    pairs = tree.query_pairs(reach, output_type="ndarray")
    squared = ((centres[pairs[:, 0]] - centres[pairs[:, 1]]) ** 2).sum(-1)
    # a mode in focus has no phase that its neighbours could see there
    defocused = radii > 1.02 * radii.min()
    own = (views.pixel_size / views.step) ** 2 * 4 / (np.pi * radii**2) / views.step**2
    strength = np.where(defocused, own, 0)[:, None] * np.exp(-squared / radii[:, None] ** 2)
    shape = views.masks.shape[-2:]

    def places(points: np.ndarray) -> np.ndarray:
        middle = (np.array(shape) - 1) / 2
        at = np.clip(np.rint(points / views.pixel_size + middle).astype(int), 0, np.array(shape) - 1)
        return np.ravel_multi_index(tuple(at.T), shape)

    middles = places((centres[pairs[:, 0]] + centres[pairs[:, 1]]) / 2)
    order = _elimination_order(pairs, len(centres))
    return Coupling(pairs, middles, strength, own, places(centres), radii / views.pixel_size, order)


class _Preconditioner:
    """An approximate inverse of the normal matrix: amplitude by its diagonal, phase by the Laplacian of neighbours."""

    def __init__(self, coupling: Coupling, weights: np.ndarray) -> None:
        shape = weights.shape[-2:]
        middles, places = (_blocked(shape, at) for at in (coupling.middles, coupling.places))
        strength, own = np.zeros(len(middles)), np.zeros(len(places))
        for weight, radius, pair, single in zip(weights, coupling.radii, coupling.strength, coupling.own, strict=True):
            # smoothed over the mode as the image sees it: blocks are smaller than that
            smooth = scipy.ndimage.gaussian_filter(_blocks(_harmonic(weight)), radius / (2 * BLOCK), mode="nearest")
            known = 1 / np.maximum(smooth.ravel(), 1e-30)
            strength += known[middles] * pair
            own += known[places] * single
        self.pairs, self.order = coupling.pairs, coupling.order
        self.planes = _telling(coupling.radii)
        self.phase: SuperLU | None = None
        self.damping = 0.0
        self.strength, self.own = strength, own

    def at(self, amplitudes: np.ndarray) -> None:
        """Turn to the phases of these amplitudes. Their sizes matter less: the first ones are factorised, and kept."""
        i, j = self.pairs.T
        count, size = len(amplitudes), np.abs(amplitudes)
        # a mode that starts dark may still be lit: its phase is as good as any
        self.turn = np.where(size > 0, amplitudes / np.maximum(size, 1e-30), 1)
        if self.phase is not None:
            return
        pull = np.bincount(i, self.strength * size[j] ** 2, count) + np.bincount(j, self.strength * size[i] ** 2, count)
        diagonal = pull + self.own * size**2
        self.damping = DAMPING * float(diagonal.mean())
        off = -self.strength * size[i] * size[j]
        each = np.arange(count)
        place = self.order[np.stack([np.r_[i, j, each], np.r_[j, i, each]])]
        # in single precision: it is approximate anyway, and takes two thirds of the time
        values = np.r_[off, off, pull + self.damping].astype(np.float32)
        laplacian = scipy.sparse.csc_array((values, tuple(place)))
        self.phase = _factorised(laplacian, "NATURAL")
        self.amplitude = diagonal + self.damping

    def __call__(self, gradient: np.ndarray) -> np.ndarray:
        assert self.phase is not None
        straight = gradient * self.turn.conj()
        turned = np.empty(len(straight), np.float32)
        turned[self.order] = straight.imag
        return (straight.real / self.amplitude + 1j * self.phase.solve(turned)[self.order]) * self.turn


def _factorised(matrix: scipy.sparse.csc_array, order: str) -> SuperLU:
    """Of a symmetric positive definite matrix."""
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _elimination_order(pairs: np.ndarray, count: int) -> np.ndarray:
    """At which place each mode is eliminated so that few new entries come up, (m,): the same for all fields."""
    i, j = pairs.T
    each = np.arange(count)
    degree = np.bincount(i, minlength=count) + np.bincount(j, minlength=count) + 1.0
    graph = (np.r_[-np.ones(2 * len(pairs)), degree], (np.r_[i, j, each], np.r_[j, i, each]))
    return np.asarray(_factorised(scipy.sparse.csc_array(graph), "MMD_AT_PLUS_A").perm_c)


def _blocks(image: np.ndarray) -> np.ndarray:
    """Means of blocks of pixels, the last ones of what is there."""
    rows, columns = (np.arange(0, n, BLOCK) for n in image.shape)
    total = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
    counts = [np.diff(np.r_[start, n]) for start, n in zip((rows, columns), image.shape, strict=True)]
    return np.asarray(total / np.outer(*counts))


def _blocked(shape: tuple[int, int], places: np.ndarray) -> np.ndarray:
    """Places in the flattened image as places in the flattened image of blocks."""
    row, column = np.unravel_index(places, shape)
    return np.ravel_multi_index((row // BLOCK, column // BLOCK), tuple(-(-n // BLOCK) for n in shape))


def _telling(radii: np.ndarray) -> np.ndarray:
    """Planes from which the curvature is taken: where there are many, every other one by how far they spread a mode,
    since planes before and behind the focus tell much the same. The gradient is that of all planes."""
    if len(radii) < ENOUGH:
        return np.arange(len(radii))
    return np.sort(np.argsort(-radii, kind="stable")[: 2 * (len(radii) // 2) : 2])


def _harmonic(weight: np.ndarray) -> np.ndarray:
    """Variances to smooth, of one image: an unusable pixel counts as a poor one."""
    known = weight > 0
    poor = float(weight[known].min()) if known.any() else 1.0
    return np.where(known, 1 / np.where(known, weight, 1), 3 / poor)


class _State:
    """Fields and residuals at one point, plane by plane: what is worked on stays in the processor's cache."""

    def __init__(self, views: Views, problem: Problem, at: Found) -> None:
        self.views, self.problem, self.at = views, problem, at
        masks = views.masks
        if problem.turn is not None:
            masks = masks * np.exp(1j * at.focus * problem.turn).astype(np.complex64)
            views = replace(views, masks=masks)
        self.turned = views
        self.spectrum = views.spectrum(at.amplitudes)
        self.gains = at.gains.astype(np.float32)
        self.fields = np.empty(masks.shape, np.complex64)
        self.residual = np.empty(masks.shape, np.float32)
        total = 0.0
        for i, gain in enumerate(self.gains):
            self.fields[i] = views.field(self.spectrum, i)
            power = squared(self.fields[i])
            power *= gain
            np.subtract(power, problem.images[i], out=self.residual[i])
            np.multiply(self.residual[i], problem.weights[i], out=power)
            total += float(np.vdot(power, self.residual[i]))
        self.cost = total / max(problem.usable, 1)

    def nuisance(self) -> np.ndarray | None:
        """Derivatives of the images to focus and gains, in units of their spreads: (k, image, y, x), or None."""
        problem, rows = self.problem, []
        if problem.turn is not None:
            along = self.turned.fields(self.spectrum * (1j * problem.turn).astype(np.complex64))
            gains = self.gains[:, None, None]
            rows.append(problem.focus_spread * 2 * gains * (self.fields.conj() * along).real)
        if problem.gain_spread > 0:
            for i, field in enumerate(self.fields):
                rows.append(np.zeros_like(self.residual))
                rows[-1][i] = problem.gain_spread * squared(field)
        return np.stack(rows) if rows else None

    def gradient(self) -> np.ndarray:
        """The adjoint of the derivative, of the weighted residuals: complex (m,)."""
        return self.adjoint(self.residual * self.problem.weights)

    def curvature(self, step: np.ndarray, planes: np.ndarray) -> np.ndarray:
        """The derivative along ``step``, weighted, and sent back by the adjoint (m,): of these planes, for all."""
        spectrum = self.turned.spectrum(step)
        total = np.zeros_like(spectrum)
        share = np.float32(len(self.gains) / len(planes))
        for i in planes:
            change = self.turned.field(spectrum, i)
            change *= self.fields[i].conj()
            image = change.real * (share * (2 * self.gains[i]) ** 2)
            image *= self.problem.weights[i]
            np.multiply(image, self.fields[i], out=change)
            self.turned.collect(total, change, i)
        return self.turned.amplitudes(total)

    def forward(self, step: np.ndarray) -> np.ndarray:
        """The derivative along ``step``, (image, y, x)."""
        spectrum = self.turned.spectrum(step)
        changes = (self.turned.field(spectrum, i) * self.fields[i].conj() for i in range(len(self.gains)))
        return np.stack([2 * gain * change.real for gain, change in zip(self.gains, changes, strict=True)])

    def adjoint(self, images: np.ndarray) -> np.ndarray:
        """The adjoint of :meth:`forward`: complex (m,)."""
        total = np.zeros_like(self.spectrum)
        for i, image in enumerate(images):
            self.turned.collect(total, 2 * self.gains[i] * image * self.fields[i], i)
        return self.turned.amplitudes(total)


def refine(
    views: Views, coupling: Coupling, problem: Problem, start: Found, steps: int, inner: int, tolerance: float
) -> Found:
    r"""At most ``steps`` Gauss-Newton steps on :math:`\sum_i \sum_x w_i (g_i |u_i|^2 - I_i)^2`.

    Each solves its linear equations by at most ``inner`` conjugate gradients, of many planes with the curvature of half
    of them, where nothing of the bench is sought along; they end when a step changes the
    amplitudes by less than ``tolerance``, or the cost no more.
    """
    precondition = _Preconditioner(coupling, problem.weights)
    state = _State(views, problem, start)
    found = replace(start, cost=state.cost)
    for count in range(1, steps + 1):
        change, bench = _step(state, precondition, inner)
        for shrink in (1.0, 0.5, 0.25, 0.125):
            gains, focus = found.gains, found.focus
            if bench is not None:
                split = 0 if problem.turn is None else 1
                focus = focus + shrink * problem.focus_spread * float(bench[:split].sum())
                gains = gains + shrink * problem.gain_spread * bench[split:] if problem.gain_spread > 0 else gains
            moved = replace(found, amplitudes=found.amplitudes + shrink * change, focus=focus, gains=gains)
            trial = _State(views, problem, moved)
            if trial.cost < state.cost:
                break
        else:
            # no way down: at the minimum if even the smallest step was a small one
            found = replace(found, step=_size(shrink * change, found), steps=count)
            break
        size = _size(shrink * change, moved)
        gained = 1 - trial.cost / state.cost
        state, found = trial, replace(moved, cost=trial.cost, step=size, steps=count)
        if size < tolerance or gained < 1e-3:
            break
    return replace(found, powers=squared(state.fields))


def _size(change: np.ndarray, at: Found) -> float:
    """Of a change of the amplitudes, relative to them."""
    return float(np.linalg.norm(change)) / max(float(np.linalg.norm(at.amplitudes)), 1e-300)


def _step(state: _State, precondition: _Preconditioner, inner: int) -> tuple[np.ndarray, np.ndarray | None]:
    """The step of amplitudes, and of focus and gains in units of their spreads."""
    problem = state.problem
    precondition.at(state.at.amplitudes)
    weights = problem.weights
    rows = state.nuisance()
    right = -state.gradient()
    if rows is None:
        bench = np.zeros(0)
        small = np.zeros((0, 0))
    else:
        flat = rows.reshape(len(rows), -1)
        small = ((flat * weights.ravel()) @ flat.T).astype(float) + np.eye(len(rows))
        deviation = (state.at.gains - 1) / problem.gain_spread if problem.gain_spread > 0 else np.zeros(0)
        focus = [] if problem.turn is None else [state.at.focus / problem.focus_spread]
        bench = -(flat @ (weights * state.residual).ravel()).astype(float) - np.r_[focus, deviation]

    def solve(amplitudes: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return precondition(amplitudes), np.linalg.solve(small, other) if len(other) else other

    def product(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
        return float(np.vdot(a[0], b[0]).real + a[1] @ b[1])

    left = (right, bench)
    total = (np.zeros_like(right), np.zeros_like(bench))
    direction = toward = solve(*left)
    size = first = product(left, toward)
    for _ in range(inner):
        if not size > 0:
            break
        if rows is None:
            image, other = state.curvature(direction[0], precondition.planes), direction[1]
        else:
            change = state.forward(direction[0]) + np.tensordot(direction[1].astype(np.float32), rows, 1)
            change *= weights
            image, other = state.adjoint(change), (flat @ change.ravel()).astype(float) + direction[1]
        image = image + precondition.damping * direction[0]
        length = size / product(direction, (image, other))
        total = (total[0] + length * direction[0], total[1] + length * direction[1])
        left = (left[0] - length * image, left[1] - length * other)
        toward = solve(*left)
        new = product(left, toward)
        if new < 1e-2 * first:
            break
        direction = (toward[0] + new / size * direction[0], toward[1] + new / size * direction[1])
        size = new
    return total[0], None if rows is None else total[1]
