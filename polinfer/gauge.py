"""One of the eight equivalent parameter sets in every pixel, such that neighbours agree."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from .checks import broadcast
from .degeneracy import REFERENCE, distance, reduce_ranges
from .records import Parameters, Status

__all__ = ["smooth_gauge"]

_NO_ANSWER = int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)
_REFERENCE = Parameters(*map(np.float64, REFERENCE))
_LEAST = 1e-24  # squared length below which a direction still votes, though never against a longer one


def _turn(x: np.ndarray) -> np.ndarray:
    """An angle wrapped to (-pi, pi]."""
    return x - 2 * pi * np.ceil(x / (2 * pi) - 0.5)


def _edges(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of the known neighbours along the last two axes of ``(frames, y, x)``."""
    index = np.arange(known.size).reshape(known.shape)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:, :, :-1], index[:, :, 1:])]
    first, second = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    both = known.ravel()[first] & known.ravel()[second]
    return first[both], second[both]


def _votes(
    edges: tuple[np.ndarray, np.ndarray], directions: tuple[np.ndarray, ...], radius: np.ndarray, length: np.ndarray,
    circle: bool,
) -> np.ndarray:  # fmt: skip
    """How much nearer two neighbours are as they stand than with one of them reversed; > 0: leave them.

    A reversal is ``(radius, direction) -> (-radius, -direction)``. The difference of the two squared distances is
    weighted like an estimate whose directions have variances ``1 / length^2``.
    """
    i, j = edges
    cosine = sum(e[i] * e[j] for e in directions)
    angle = np.arccos(np.clip(cosine, -1, 1))
    near, far = radius[i] - radius[j], radius[i] + radius[j]
    if circle:
        near, far = _turn(near), _turn(far)
    square = np.maximum(length**2, _LEAST)
    weight = square[i] * square[j] / (square[i] + square[j])
    return weight * ((pi - angle) ** 2 - angle**2 + far**2 - near**2)


def _agree(count: int, edges: tuple[np.ndarray, np.ndarray], votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs (count,) that the votes ask for, and the island of every pixel.

    Borůvka's spanning tree, with the votes between two groups summed once the groups have formed: every group joins
    the neighbour about which its votes are clearest, so what is doubtful is decided last, and by all of its border.
    """
    from scipy.sparse import coo_array

    signs, group = np.ones(count), np.arange(count)
    (i, j), groups = edges, count
    while len(i):
        order = np.argsort(np.abs(votes), kind="stable")
        clearest = np.full(groups, -1)
        # the last of repeated indices is the one that stays: the largest vote
        clearest[np.stack([i[order], j[order]], axis=-1).ravel()] = np.repeat(order, 2)
        own = np.arange(groups)
        parent = np.where(clearest < 0, own, np.where(i[clearest] == own, j[clearest], i[clearest]))
        relative = np.where((clearest >= 0) & (votes[clearest] < 0), -1.0, 1.0)
        root = (parent[parent] == own) & (own <= parent)
        parent, relative = np.where(root, own, parent), np.where(root, 1.0, relative)
        while np.any(parent[parent] != parent):
            relative, parent = relative * relative[parent], parent[parent]
        _, joined = np.unique(parent, return_inverse=True)
        signs, group = signs * relative[group], joined[group]
        votes, i, j = votes * relative[i] * relative[j], joined[i], joined[j]
        groups, between = int(joined.max()) + 1, i != j
        ends = np.minimum(i, j)[between], np.maximum(i, j)[between]
        summed = coo_array((votes[between], ends), shape=(groups, groups)).tocsr().tocoo()
        votes, (i, j) = summed.data, summed.coords
    return signs, group


def _copy(p: Parameters, reverse: Any, turn: Any, swap: Any) -> Parameters:
    """An equivalent set: the polariser reversed, the retarder reversed, ``sin 2 theta_eta`` reversed, where True."""
    quarter, half = (np.asarray(x, p.retardance_angle.dtype) for x in (pi / 2, pi))
    angle = np.where(turn, p.retardance_angle + quarter, p.retardance_angle)
    return reduce_ranges(
        Parameters(
            np.where(reverse, -p.diattenuation, p.diattenuation),
            np.where(reverse, p.diattenuation_angle + quarter, p.diattenuation_angle),
            np.where(turn, -p.retardance, p.retardance),
            np.where(swap, -angle, angle),
            np.where(swap, p.circularity + half, p.circularity),
        )
    )


def _anchored(signs: np.ndarray, island: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The same signs, that of the first known pixel of every island positive."""
    index = np.flatnonzero(known)[::-1]
    first = np.zeros(int(island.max()) + 1, int)
    first[island[index]] = index
    return signs * signs[first][island]


def _nearest(copies: list[Parameters], island: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Number of the copy that is nearest to the reference on the whole, for the island of every pixel."""
    totals = np.stack([np.bincount(island, np.where(known, distance(copy, _REFERENCE), 0)) for copy in copies])
    return np.argmax(totals <= totals.min(axis=0) + 1e-12 * (1 + totals.max(axis=0)), axis=0)[island]


def _polariser(p: Parameters, known: np.ndarray) -> np.ndarray:
    """Which pixels to reverse so that the signed D and its axis are smooth."""
    edges, flat = _edges(known), known.ravel()
    start = np.where(p.diattenuation < 0, -1.0, 1.0)
    axis = (start * np.cos(2 * p.diattenuation_angle), start * np.sin(2 * p.diattenuation_angle))
    size = np.abs(p.diattenuation)
    signs, island = _agree(flat.size, edges, _votes(edges, axis, size, size, circle=False))
    reverse = _anchored(signs, island, flat) != start
    best = _nearest([_copy(p, reverse ^ r, False, False) for r in (False, True)], island, flat)
    return flat & (reverse ^ (best == 1))


def _retarder(p: Parameters, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels to reverse so that eta and its axis on the sphere are smooth, then the angles of that axis."""
    edges, flat = _edges(known), known.ravel()
    start = np.where(p.retardance < 0, -1.0, 1.0)
    polar, length = 2 * p.retardance_angle, np.abs(np.sin(0.5 * p.retardance))
    sine = start * np.sin(polar)
    axis = (start * np.cos(polar), sine * np.cos(p.circularity), sine * np.sin(p.circularity))
    signs, island = _agree(flat.size, edges, _votes(edges, axis, np.abs(p.retardance), length, circle=True))
    turn = _anchored(signs, island, flat) != start
    polar = _turn(polar + np.where(turn, pi, 0))
    start = np.where(polar < 0, -1.0, 1.0)
    azimuth = (start * np.cos(p.circularity), start * np.sin(p.circularity))
    length = length * np.abs(np.sin(polar))
    signs, island = _agree(flat.size, edges, _votes(edges, azimuth, np.abs(polar), length, circle=True))
    swap = _anchored(signs, island, flat) != start
    best = _nearest([_copy(p, False, turn ^ t, swap ^ s) for t in (False, True) for s in (False, True)], island, flat)
    return flat & (turn ^ (best >= 2)), flat & (swap ^ (best % 2 == 1))


def smooth_gauge(parameters: Parameters, status: Any = None) -> Parameters:
    """Of the eight equivalent parameter sets of each pixel, the one that makes the maps smooth.

    :func:`polinfer.canonicalise` judges each pixel by itself and flickers where two copies are equally near to its
    reference. Here neighbours along the last two axes decide together, so that D and eta may pass through 0 and
    become negative, and axes turn through all angles: neighbours are as near as the physical field lets them be, in
    the distance of :func:`polinfer.canonicalise`. J does not change.

    Parameters
    ----------
    parameters: five real arrays that broadcast to shape P = ``(..., y, x)``, ``(x,)`` or ``()``, radians; NaN where
        there is no answer. Axes before the last two are separate frames.
    status: integer, broadcasts to P, :class:`Status` bits, or None. Pixels that are masked, not finite or not
        converged are left as they came and connect nothing.

    Returns
    -------
    Parameters of shape P. Each pixel is one of its eight copies, up to rounding, in the precision that came. Pixels
    that no path of known neighbours connects are islands; each island as a whole is the copy with the least sum of
    squared distances to the reference of :func:`polinfer.canonicalise` (equally near: the one whose first pixel has
    D >= 0, eta >= 0 and theta_eta in [0, pi/2]). The copies that came play no part. A NaN in D or theta_D leaves the
    polariser of its pixel as it is, and one in eta, theta_eta or xi the retarder.

    Raises
    ------
    TypeError, ValueError: arrays that are not real or do not broadcast, a status that is not integer.

    Notes
    -----
    The copies of polariser and retarder are independent. Three signs are chosen, one after the other: that of
    ``(D, axis)``; that of ``(eta, axis on the sphere)``, with the axis ``(cos 2 theta_eta, sin 2 theta_eta cos xi,
    sin 2 theta_eta sin xi)``; and that of ``(2 theta_eta, xi)``, the polar angles of this axis. Each pair of
    neighbours votes with the difference of the squared distances with and without a reversal, weighted by how well
    |D|, |sin(eta/2)| and |sin(eta/2) sin 2 theta_eta| determine the direction. Groups of pixels are joined along
    their clearest votes first, which are then summed over their common border.

    At eta = +-pi eta is treated as a circle: the axis continues and eta changes its sign. With a free gain nothing
    jumps there; with unit gain such neighbours have matrices of opposite sign, a jump of the data themselves.

    A field is followed where the doubled axes, and xi, turn by less than about pi/2 from pixel to pixel. Where one
    changes faster (a border, a vortex of an axis by a quarter turn around D = 0), a closed path may ask for an odd
    number of reversals: some jump is inevitable, and it lies where the votes against it are weakest.
    With noise, the sign on the far side of a line of zeros is decided by the sum over the whole line. For a line of
    64 pixels that is reliable where D, say, changes by at least its standard deviation from pixel to pixel, wrong in
    3 of 100 cases at half of it, and little better than a guess at a tenth.

    >>> x = np.linspace(-0.3, 0.3, 4)
    >>> flickering = Parameters(abs(x), np.where(x < 0, 0.3, 0.3 - np.pi / 2), 1.0, 0.4, 0.2)
    >>> smooth = smooth_gauge(flickering)
    >>> smooth.diattenuation.round(3).tolist(), smooth.diattenuation_angle.round(3).tolist()
    ([0.3, 0.1, -0.1, -0.3], [0.3, 0.3, 0.3, 0.3])
    """
    p = reduce_ranges(parameters)
    shape = p.diattenuation.shape
    used = np.ones(shape, bool)
    if status is not None:
        flags = np.asarray(status)
        if flags.dtype.kind not in "iu":
            raise TypeError(f"status must be integer, got {flags.dtype}; pass the status of a Fit.")
        if broadcast(parameters=shape, status=flags.shape) != shape:
            raise ValueError(f"status has shape {flags.shape}, more than the parameters' {shape}; make them agree.")
        used = (np.broadcast_to(flags, shape) & _NO_ANSWER) == 0
    if used.size == 0:
        return p
    frames = (-1, *(1, 1, *shape)[-2:])

    def part(names: tuple[str, ...]) -> tuple[Parameters, np.ndarray]:
        """The named parameters in double precision and flat, the others and unknown ones as in the reference."""
        known = used & np.isfinite(sum(getattr(p, name) for name in names))
        values = _REFERENCE._asdict() | {
            name: np.where(known, getattr(p, name), 0).astype(float).ravel() for name in names
        }
        return Parameters(**values), known.reshape(frames)

    reverse = _polariser(*part(Parameters._fields[:2])).reshape(shape)
    turn, swap = (x.reshape(shape) for x in _retarder(*part(Parameters._fields[2:])))
    return _copy(p, reverse, turn, swap)
