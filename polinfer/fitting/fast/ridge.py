"""Long narrow ridges of the posterior: a few pixels, in NumPy and double precision, by steps that follow them.

Where ``|D|`` is near 1 and the gain's phase is free, J hardly changes as ``A_ret -> e^{i alpha n . sigma} A_ret``
(n: the axis of the diattenuator). In the angles of the retarder this is a curved valley; here it is a straight line:
the steps are rotations, ``A_ret -> e^{i w . sigma} A_ret`` (on the right if the polariser comes first), whose
derivatives at w = 0 are products with the Pauli matrices. The gain is a coordinate beside the angles, so that the
misfit is a sum of squares ``|r|^2`` with ``r = g J R - Y``: gradient and curvature are formed from r and its
derivatives, and the system is solved by their singular values. So what is lost to rounding is eps times the
signal-to-noise ratio, not times its square.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ...circular import bessel_ratio, log_scaled_bessel
from .climb import moved
from .likelihoods import Complex, Phase
from .point import Point, matrix, polariser_vectors, retarder_vectors
from .priors import COPIES, log_prior
from .scene import Scene

__all__ = ["follow", "turned"]

STEPS = 100
TOLERANCE = 1e-10  # squared Newton decrement
LONGEST = 0.7  # radians
FLOOR = 1e-12  # of the curvature of an unknown, relative
ANGLES = 5
LARGEST = 1e30  # signal-to-noise ratio: squares of squares must not overflow


class _Place(NamedTuple):
    """Points: u's angles as (cosine, sine) ``(pixels, 2, 2)``, q ``(pixels, 4)``, the gain ``(pixels,)``."""

    pairs: np.ndarray
    q: np.ndarray
    gain: np.ndarray


class _System(NamedTuple):
    """Log posterior; residual ``(pixels, rows)`` and its derivatives; gradient and curvature of all else."""

    value: np.ndarray
    residual: np.ndarray
    first: np.ndarray
    second: np.ndarray
    slope: np.ndarray
    bend: np.ndarray


@cache
def _tensor(retarder_first: bool) -> np.ndarray:
    """B with ``J_ij = sum B[i, j, a, b] u_a q_b``."""
    found = np.empty((2, 2, 3, 4), complex)
    for a, u in enumerate(np.eye(3)):
        for b, q in enumerate(np.eye(4)):
            for i, row in enumerate(matrix(retarder_first, list(u), list(q))):
                for j, (re, im) in enumerate(row):
                    found[i, j, a, b] = complex(re, im)
    return found


@cache
def _turns(retarder_first: bool) -> np.ndarray:
    """E with ``dq / dw_k = E[k] q``: ``i sigma_k A`` or ``A i sigma_k``."""
    side = 1.0 if retarder_first else -1.0
    found = np.zeros((3, 4, 4))
    for k in range(3):
        e = np.eye(3)[k]
        found[k, 0, 1:] = -e
        found[k, 1:, 0] = e
        found[k, 1:, 1:] = -side * np.cross(e, np.eye(3)).T
    return found


def _real(x: np.ndarray) -> np.ndarray:
    """Complex ``(..., 2, 2)`` as real ``(..., 8)``."""
    flat = x.reshape(*x.shape[:-2], 4)
    return np.concatenate([flat.real, flat.imag], axis=-1)


def _point(scene: Scene, place: _Place) -> Point:
    """The angles; of those that describe the same retarder the ones with the highest prior."""
    c, q = place.pairs, place.q
    rho = np.hypot(q[:, 2], q[:, 3])
    there = rho > 0
    xi = (np.where(there, q[:, 2], 1) / np.where(there, rho, 1), q[:, 3] / np.where(there, rho, 1))
    size = np.hypot(q[:, 1], rho)
    theta = (np.where(size > 0, q[:, 1], 1) / np.where(size > 0, size, 1), rho / np.where(size > 0, size, 1))
    point = Point((c[:, 0, 0], c[:, 0, 1]), (c[:, 1, 0], c[:, 1, 1]), (q[:, 0], size), theta, xi)
    best, top = point, log_prior(scene.prior, point)
    for row, copy in zip(scene.copies[1:4], COPIES[1:4], strict=True):
        other = moved(copy, point)
        value = log_prior(scene.prior, other)
        better = value > top
        if row and np.any(better):
            pairs = (
                (np.where(better, a, c), np.where(better, b, d)) for (a, b), (c, d) in zip(other, best, strict=True)
            )
            best, top = Point(*pairs), np.where(better, value, top)
    return best


def _stack(components: list[Any], pixels: int) -> np.ndarray:
    return np.stack([x + np.zeros(pixels) for x in components], axis=-1)


def _vectors(scene: Scene, place: _Place, point: Point) -> tuple[dict[Any, np.ndarray], dict[Any, np.ndarray]]:
    """u and q with their derivatives by (y0, y1) and by w; keys are the indices of the unknowns 0 to 4."""
    pixels = len(place.q)
    u, du = polariser_vectors(point)
    left: dict[Any, np.ndarray] = {(): _stack(u, pixels)} | {key: _stack(x, pixels) for key, x in du.items()}
    left[0, 0] = -left[()]
    right: dict[Any, np.ndarray] = {(): place.q}
    for k, e in enumerate(_turns(scene.retarder_first)):
        right[2 + k,] = place.q @ e.T
        right[2 + k, 2 + k] = -place.q
    return left, right


def _priors(scene: Scene, point: Point, right: dict[Any, np.ndarray]) -> tuple[Any, np.ndarray, np.ndarray]:
    """Log prior up to its constant, with its derivatives by the five unknowns."""
    pixels = len(right[()])
    value, slope, bend = np.zeros(pixels), np.zeros((pixels, ANGLES)), np.zeros((pixels, ANGLES, ANGLES))
    _, dq = retarder_vectors(point)
    by_angle = {key: _stack(vector, pixels) for key, vector in dq.items()}
    by_angle[2, 2] = -right[()]
    # how the angles follow the rotation: dq/dw = sum dq/dy dy/dw, and once more
    follow, bent = np.zeros((3, pixels, 3)), np.zeros((3, pixels, 3, 3))
    sizes = {j: np.sum(by_angle[j,] ** 2, axis=-1) for j in (2, 3, 4)}
    for j, size in sizes.items():
        inverse = np.where(size > 1e-12, 1 / np.maximum(size, 1e-12), 0)  # at a pole the angle has no prior
        for k in range(3):
            follow[j - 2, :, k] = inverse * np.sum(by_angle[j,] * right[2 + k,], axis=-1)
    curved = np.zeros((pixels, 3, 3, 4))
    for k in range(3):
        curved[:, k, k] = -right[()]
    for a in (2, 3, 4):
        for b in (2, 3, 4):
            both = follow[a - 2][:, :, None] * follow[b - 2][:, None, :]
            curved -= both[..., None] * by_angle[min(a, b), max(a, b)][:, None, None, :]
    for j, size in sizes.items():
        inverse = np.where(size > 1e-12, 1 / np.maximum(size, 1e-12), 0)
        bent[j - 2] = inverse[:, None, None] * np.einsum("pj,pklj->pkl", by_angle[j,], curved)
    for i, term in enumerate(scene.prior):
        found = None if term is None else term.evaluate(point[i])
        if found is None:
            continue
        value = value + found[0]
        if i < 2:
            slope[:, i] += found[1]
            bend[:, i, i] += found[2]
        else:
            y, yy = follow[i - 2], bent[i - 2]
            slope[:, 2:] += found[1][:, None] * y
            bend[:, 2:, 2:] += found[2][:, None, None] * y[:, :, None] * y[:, None, :] + found[1][:, None, None] * yy
    return value, slope, bend


def _system(scene: Scene, illumination: np.ndarray, response: np.ndarray, place: _Place) -> _System:
    kind, pixels = scene.likelihood, len(place.q)
    point = _point(scene, place)
    left, right = _vectors(scene, place, point)
    tensor = _tensor(scene.retarder_first)

    def seen(u: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.einsum("ijab,pa,pb->pij", tensor, u, q) @ illumination

    m = seen(left[()], right[()])
    single = [seen(left[i,], right[()]) for i in (0, 1)] + [seen(left[()], right[k,]) for k in (2, 3, 4)]
    double: dict[tuple[int, int], np.ndarray] = {}
    for i in range(ANGLES):
        for j in range(i, ANGLES):
            if j < 2:
                double[i, j] = seen(left[i, j], right[()])
            elif i < 2:
                double[i, j] = seen(left[i,], right[j,])
            else:  # rotations that do not commute: the mean of both orders, of which only the square is left
                double[i, j] = -m if i == j else np.zeros_like(m)
    unknowns = ANGLES + {Complex: 2, Phase: 1}.get(type(kind), 0)
    rows = 10 if isinstance(kind, Complex) else 8
    residual, first = np.zeros((pixels, rows)), np.zeros((pixels, rows, unknowns))
    second = np.zeros((pixels, unknowns, unknowns))
    g = place.gain[:, None, None]
    rest = _real(g * m - response)
    residual[:, :8] = rest
    for i in range(ANGLES):
        first[:, :8, i] = _real(g * single[i])
    for (i, j), d in double.items():
        second[:, i, j] = second[:, j, i] = np.sum(rest * _real(g * d), axis=-1)
    if isinstance(kind, Complex):
        first[:, :8, 5], first[:, :8, 6] = _real(m), _real(1j * m)
        root = np.sqrt(kind.precision)
        residual[:, 8], residual[:, 9] = root * place.gain.real, root * place.gain.imag
        first[:, 8, 5] = first[:, 9, 6] = root
        for i in range(ANGLES):
            for n, d in ((5, single[i]), (6, 1j * single[i])):
                second[:, i, n] = second[:, n, i] = np.sum(rest * _real(d), axis=-1)
    elif isinstance(kind, Phase):
        first[:, :8, 5] = _real(1j * g * m)
        second[:, 5, 5] = -np.sum(rest * _real(g * m), axis=-1)
        for i in range(ANGLES):
            second[:, i, 5] = second[:, 5, i] = np.sum(rest * _real(1j * g * single[i]), axis=-1)
    value, own_slope, own_bend = _priors(scene, point, right)
    value = value + scene.constant - np.sum(residual**2, axis=-1)
    slope, bend = np.zeros((pixels, unknowns)), np.zeros((pixels, unknowns, unknowns))
    slope[:, :ANGLES], bend[:, :ANGLES, :ANGLES] = own_slope, own_bend
    more = _volume(kind, m, response, place.gain, single, double)
    if more is not None:
        value = value + more[0]
        slope[:, :ANGLES] += more[1]
        bend[:, :ANGLES, :ANGLES] += more[2]
    return _System(value, residual, first, second, slope, bend)


def _volume(
    kind: Any, m: np.ndarray, response: np.ndarray, gain: np.ndarray, single: list[np.ndarray],
    double: dict[tuple[int, int], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:  # fmt: skip
    """What integrating over the gain adds to the density at the best one, with its derivatives by the angles.

    With a complex gain ``-log(1 + t^2 |M|^2)``; with a phase ``log(e^-x I_0(x))`` at ``x = 2 |<M, Y>|``.
    """
    if not isinstance(kind, (Complex, Phase)):
        return None
    other = m if isinstance(kind, Complex) else gain.conj()[:, None, None] * response
    flat = _real(other)
    x = np.sum(_real(m) * flat, axis=-1)
    grown = [2 * np.sum(_real(d) * flat, axis=-1) for d in single]
    across = [2 * np.sum(_real(1j * d) * flat, axis=-1) for d in single]
    if isinstance(kind, Complex):
        total = x + kind.precision
        value, rate, bend = -np.log1p(x / kind.precision), -1 / total, 1 / total**2
    else:
        x = 2 * x
        ratio = np.asarray(bessel_ratio(x), float)
        value, rate = np.asarray(log_scaled_bessel(x), float), ratio - 1
        bend = 1 - ratio / np.maximum(x, 1e-300) - ratio**2
        bend = np.where(x > 1e3, 0.5 / np.maximum(x, 1) ** 2, bend)
    first = np.stack([rate * d for d in grown], axis=-1)
    second = np.empty((len(x), ANGLES, ANGLES))
    for (i, j), d in double.items():
        twice = 2 * np.sum(_real(d) * flat, axis=-1)
        if isinstance(kind, Complex):
            twice = twice + 2 * np.sum(_real(single[i]) * _real(single[j]), axis=-1)
        else:  # the best phase turns
            twice = twice + across[i] * across[j] / np.maximum(x, 1e-300)
        second[:, i, j] = second[:, j, i] = bend * grown[i] * grown[j] + rate * twice
    return value, first, second


def _place(scene: Scene, points: np.ndarray) -> _Place:
    """From (cosine, sine) of the five angles ``(10, pixels)``, at gain 1."""
    pairs = points.astype(float).reshape(5, 2, -1)
    (c, s), (x, y), (a, b) = pairs[2], pairs[3], pairs[4]
    q = np.stack([c, s * x, s * y * a, s * y * b], axis=-1)
    if not scene.bounded:  # the other sign of J, which a free phase takes up
        q = np.where(q[:, :1] < 0, -q, q)
    return _Place(np.moveaxis(pairs[:2], -1, 0).copy(), q, np.ones(points.shape[1], complex))


def _pairs(scene: Scene, place: _Place) -> np.ndarray:
    return np.concatenate([np.stack(pair) for pair in _point(scene, place)])


def turned(scene: Scene, points: np.ndarray, alpha: float, strength: np.ndarray) -> np.ndarray:
    """Points ``(10, pixels)`` with the retarder turned by ``alpha`` about the axis of the diattenuator.

    ``|D| = 1`` would say nothing of this angle: D is set off its bound by the noise, at a signal-to-noise ratio of
    ``strength`` (pixels).
    """
    place = _place(scene, points)
    sign = np.where(place.pairs[:, 0, 1] < 0, -1.0, 1.0)
    axis = sign[:, None] * place.pairs[:, 1]
    step = np.concatenate([np.zeros_like(axis), alpha * axis, np.zeros_like(axis[:, :1])], axis=1)
    angle = np.abs(np.arctan2(place.pairs[:, 0, 1], place.pairs[:, 0, 0]))
    step[:, 0] = sign * np.minimum(0.25 * np.pi - 1 / np.maximum(strength, 10) - angle, 0)
    return _pairs(scene, _moved(scene, place, step))


def _moved(scene: Scene, place: _Place, step: np.ndarray) -> _Place:
    """After a step ``(pixels, unknowns)``; D stops at its bound, and the retardance where it has one."""
    angle = np.arctan2(place.pairs[:, :, 1], place.pairs[:, :, 0]) + step[:, :2]
    angle[:, 0] = np.clip(angle[:, 0], -0.25 * np.pi, 0.25 * np.pi)
    pairs = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    w = step[:, 2:ANGLES]
    size = np.sqrt(np.sum(w * w, axis=-1))
    turned = np.einsum("kab,pb,pk->pa", _turns(scene.retarder_first), place.q, w)
    q = np.cos(size)[:, None] * place.q + np.sinc(size / np.pi)[:, None] * turned
    if scene.bounded:
        q[:, 0] = np.maximum(q[:, 0], 0)
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    return _Place(pairs, q, place.gain)


def _with_gain(scene: Scene, illumination: np.ndarray, response: np.ndarray, place: _Place) -> _Place:
    """With the best gain at a point."""
    kind, point = scene.likelihood, _point(scene, place)
    if not isinstance(kind, (Complex, Phase)):
        return place
    u = _stack(polariser_vectors(point)[0], len(place.q))
    m = np.einsum("ijab,pa,pb->pij", _tensor(scene.retarder_first), u, place.q) @ illumination
    a = np.sum(m.conj() * response, axis=(-1, -2))
    if isinstance(kind, Complex):
        return place._replace(gain=a / (np.sum(np.abs(m) ** 2, axis=(-1, -2)) + kind.precision))
    return place._replace(gain=np.where(a != 0, a / np.where(a != 0, np.abs(a), 1), 1))


def _newton(system: _System, held: np.ndarray, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Damped step ``(pixels, unknowns)``, the decrement of the one without damping, and whether all curves down.

    ``held`` says in which pixels D does not move.
    """
    first = system.first.copy()
    first[held, :, 0] = 0
    rest = 2 * system.second - system.bend
    slope = system.slope - 2 * np.einsum("pri,pr->pi", first, system.residual)
    slope[held, 0] = 0
    rest[held, 0, :] = rest[held, :, 0] = 0
    rest[held, 0, 0] = 1
    size = np.sqrt(np.sum(first**2, axis=1) + np.abs(np.einsum("pii->pi", rest)) + 1e-300)
    _, values, axes = np.linalg.svd(first / size[:, None, :], full_matrices=True)
    turned = axes @ (rest / size[:, :, None] / size[:, None, :]) @ np.swapaxes(axes, -1, -2)
    unknowns = size.shape[-1]
    turned[:, range(unknowns), range(unknowns)] += 2 * values**2
    # soft directions beside stiff ones: bring all to the same size before the eigenvalues are taken
    own = np.sqrt(np.maximum(np.abs(np.einsum("pii->pi", turned)), 1e-30))
    curvature, ways = np.linalg.eigh(turned / own[:, :, None] / own[:, None, :])
    directions = np.einsum("pij,pi,pik->pjk", axes, 1 / own, ways) / size[:, :, None]
    along = np.einsum("pjk,pj->pk", directions, slope)
    strength = np.maximum(np.abs(curvature), FLOOR)
    step = np.einsum("pjk,pk->pj", directions, along / (strength + damping[:, None]))
    longest = np.max(np.abs(step[:, :ANGLES]), axis=-1)
    step = step * np.minimum(1, LONGEST / np.maximum(longest, 1e-300))[:, None]
    return step, np.sum(along**2 / strength, axis=-1), curvature[:, 0] > FLOOR


def follow(
    scene: Scene, illumination: np.ndarray, response: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Climb from ``points`` ((cosine, sine) of the five angles, ``(10, pixels)``), all five of which are free.

    ``illumination`` R and ``response`` Y, complex ``(pixels, 2, 2)``. Returns the points that are reached, their log
    posteriors (without the statistics' constant) and whether they are maxima.
    """
    place = _with_gain(scene, illumination, response, _place(scene, points))
    system = _system(scene, illumination, response, place)
    pixels = points.shape[1]
    damping, arrived = np.zeros(pixels), np.zeros(pixels, bool)
    scale = np.sqrt(np.sum(np.abs(response) ** 2, axis=(-1, -2)))
    active = np.flatnonzero(np.isfinite(system.value) & (scale < LARGEST))
    slack = 10 * np.finfo(float).eps * (1 + scale) * np.sqrt(1 + np.sum(system.residual**2, axis=-1))
    for _ in range(STEPS if len(active) else 0):
        here = _Place(*(x[active] for x in place))
        now = _System(*(x[active] for x in system))
        gradient = now.slope[:, 0] - 2 * np.einsum("pr,pr->p", now.first[:, :, 0], now.residual)
        cosine, sine = here.pairs[:, 0, 0], here.pairs[:, 0, 1]
        held = (np.abs(sine) >= cosine * (1 - 4 * np.finfo(float).eps)) & (gradient * sine >= 0)
        step, decrement, down = _newton(now, held, damping[active])
        arrived[active] = (decrement < TOLERANCE) & down & (damping[active] == 0)
        trial = _moved(scene, here, step)
        trial = _with_gain(scene, illumination[active], response[active], trial)
        new = _system(scene, illumination[active], response[active], trial)
        better = new.value >= now.value - slack[active]
        for old, fresh in (*zip(place, trial, strict=True), *zip(system, new, strict=True)):
            old[active[better]] = fresh[better]
        smaller = np.where(damping[active] < 1e-6, 0, 0.1 * damping[active])
        damping[active] = np.where(better, smaller, np.maximum(10 * damping[active], 1e-4))
        active = active[~arrived[active] & (damping[active] < 1e12)]
        if len(active) == 0:
            break
    return _pairs(scene, place), system.value, arrived
