"""Gauss-Newton steps on mode amplitudes, preconditioned by what neighbours' phases mean to the images.

In: a start, images and their inverse variances on the coarse grid. Out: amplitudes, and what was found of the focus and
the planes' gains. Called by :class:`fibre.Modal`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.sparse
from scipy.sparse.linalg import SuperLU, splu

from fibre.fibrelets import lattice_pitch
from fibre.retrieval.modal.views import Views

__all__ = ["Coupling", "Found", "Problem", "make_coupling", "refine"]

NEAR = 3.2  # pitches: the farthest neighbours in the preconditioner
DAMPING = 1e-3


@dataclass(frozen=True)
class Coupling:
    """How strongly images see the phase between neighbours: pairs (p, 2), the middle of each as place (p,) in the
    flattened coarse grid, strength (image, p) of unit amplitudes and weights; own (image,) of a mode with itself, its
    place (m,); radii (image,) in coarse pixels, for smoothing the weights."""

    pairs: np.ndarray
    middles: np.ndarray
    strength: np.ndarray
    own: np.ndarray
    places: np.ndarray
    radii: np.ndarray


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


@dataclass(frozen=True)
class Found:
    """amplitudes (m,); focus, metres; gains (image,); cost: mean weighted squared residual; step: the last relative
    change of the amplitudes; steps: how many."""

    amplitudes: np.ndarray
    focus: float
    gains: np.ndarray
    cost: float = np.inf
    step: float = np.inf
    steps: int = 0


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
    return Coupling(pairs, middles, strength, own, places(centres), radii / views.pixel_size)


class _Preconditioner:
    """An approximate inverse of the normal matrix: amplitude by its diagonal, phase by the Laplacian of neighbours."""

    def __init__(self, coupling: Coupling, weights: np.ndarray) -> None:
        smooth = [scipy.ndimage.gaussian_filter(w, r / 2, mode="nearest") for w, r in
                  zip(_harmonic(weights), coupling.radii, strict=True)]  # fmt: skip
        smooth = [1 / np.maximum(s.ravel(), 1e-30) for s in smooth]
        self.pairs = coupling.pairs
        self.phase: SuperLU | None = None
        self.damping = 0.0
        self.strength = sum(s[coupling.middles] * g for s, g in zip(smooth, coupling.strength, strict=True))
        self.own = sum(s[coupling.places] * g for s, g in zip(smooth, coupling.own, strict=True))

    def at(self, amplitudes: np.ndarray) -> None:
        """Turn to the phases of these amplitudes. Their sizes matter less: the first ones are factorised, and kept."""
        i, j = self.pairs.T
        count, size = len(amplitudes), np.abs(amplitudes)
        self.turn = amplitudes / np.maximum(size, 1e-30)
        if self.phase is not None:
            return
        pull = np.bincount(i, self.strength * size[j] ** 2, count) + np.bincount(j, self.strength * size[i] ** 2, count)
        diagonal = pull + self.own * size**2
        self.damping = DAMPING * float(diagonal.mean())
        off = -self.strength * size[i] * size[j]
        each = np.arange(count)
        self.phase = splu(scipy.sparse.csc_array(
            (np.r_[off, off, pull + self.damping], (np.r_[i, j, each], np.r_[j, i, each]))
        ), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})  # fmt: skip
        self.amplitude = diagonal + self.damping

    def __call__(self, gradient: np.ndarray) -> np.ndarray:
        assert self.phase is not None
        straight = gradient * self.turn.conj()
        return (straight.real / self.amplitude + 1j * self.phase.solve(straight.imag)) * self.turn


def _harmonic(weights: np.ndarray) -> np.ndarray:
    """Variances to smooth: an unusable pixel counts as a poor one."""
    known = weights > 0
    poor = [float(w[k].min()) if k.any() else 1.0 for w, k in zip(weights, known, strict=True)]
    return np.where(known, 1 / np.where(known, weights, 1), 3 / np.array(poor)[:, None, None])


class _State:
    """Fields and residuals at one point."""

    def __init__(self, views: Views, problem: Problem, at: Found) -> None:
        self.views, self.problem, self.at = views, problem, at
        masks = views.masks
        if problem.turn is not None:
            masks = masks * np.exp(1j * at.focus * problem.turn).astype(np.complex64)
        self.turned = replace(views, masks=masks)
        self.spectrum = self.turned.spectrum(at.amplitudes)
        self.fields = self.turned.fields(self.spectrum)
        power = self.fields.real**2 + self.fields.imag**2
        self.gains = at.gains.astype(np.float32)[:, None, None]
        self.residual = self.gains * power - problem.images
        self.power = power
        usable = np.count_nonzero(problem.weights)
        self.cost = float(np.sum(problem.weights * self.residual**2, dtype=float)) / max(int(usable), 1)

    def nuisance(self) -> np.ndarray | None:
        """Derivatives of the images to focus and gains, in units of their spreads: (k, image, y, x), or None."""
        problem, rows = self.problem, []
        if problem.turn is not None:
            along = self.turned.fields(self.spectrum * (1j * problem.turn).astype(np.complex64))
            rows.append(problem.focus_spread * 2 * self.gains * (self.fields.conj() * along).real)
        if problem.gain_spread > 0:
            for i, power in enumerate(self.power):
                rows.append(np.zeros_like(self.power))
                rows[-1][i] = problem.gain_spread * power
        return np.stack(rows) if rows else None

    def forward(self, step: np.ndarray) -> np.ndarray:
        change = self.turned.fields(self.turned.spectrum(step))
        return 2 * self.gains * (self.fields.real * change.real + self.fields.imag * change.imag)

    def adjoint(self, images: np.ndarray) -> np.ndarray:
        return self.turned.adjoint(2 * self.gains * images * self.fields)


def refine(
    views: Views, coupling: Coupling, problem: Problem, start: Found, steps: int, inner: int, tolerance: float
) -> Found:
    r"""At most ``steps`` Gauss-Newton steps on :math:`\sum_i \sum_x w_i (g_i |u_i|^2 - I_i)^2`.

    Each solves its linear equations by at most ``inner`` conjugate gradients; they end when a step changes the
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
            return replace(found, step=_size(shrink * change, found), steps=count)
        size = _size(shrink * change, moved)
        gained = 1 - trial.cost / state.cost
        state, found = trial, replace(moved, cost=trial.cost, step=size, steps=count)
        if size < tolerance or gained < 1e-3:
            break
    return found


def _size(change: np.ndarray, at: Found) -> float:
    """Of a change of the amplitudes, relative to them."""
    return float(np.linalg.norm(change)) / max(float(np.linalg.norm(at.amplitudes)), 1e-300)


def _step(state: _State, precondition: _Preconditioner, inner: int) -> tuple[np.ndarray, np.ndarray | None]:
    """The step of amplitudes, and of focus and gains in units of their spreads."""
    problem = state.problem
    precondition.at(state.at.amplitudes)
    weights = problem.weights
    rows = state.nuisance()
    right = -state.adjoint(weights * state.residual)
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
        change = state.forward(direction[0])
        if rows is not None:
            change = change + np.tensordot(direction[1].astype(np.float32), rows, 1)
        change *= weights
        image = state.adjoint(change) + precondition.damping * direction[0]
        other = direction[1] if rows is None else (flat @ change.ravel()).astype(float) + direction[1]
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
