"""Which fibrelet is which at the two ends of the bundle, and the affine map between the facets.

In: centres of fibrelets in images of both facets. Out: the map, the pairs and what it leaves over. Called by users who
set up a bench: its map turns places at the distal facet into places on the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.spatial

from fibre.fibrelets import lattice_pitch
from polinfer.checks import real_array, real_number
from polinfer.storage import array

__all__ = ["Registration", "register_facets"]

FIRST, GROWTH = 4.0, 1.4  # pitches: the patch that is matched first, and by how much it grows
MANY, FEW = 60, 8  # candidates that are followed to a larger patch, and to the whole facet


@dataclass(frozen=True)
class Registration:
    """The affine map from the distal to the proximal facet: proximal = matrix @ (row, column, 1).

    matrix: (2, 3), metres (the last column) and numbers. pairs: (k, 2) int, which distal and which proximal fibrelet
    are one. residuals: (k, 2) metres, what the map leaves over in each pair. margin: rms residual of the next best way
    to lay one lattice on the other, over that of this one; near 1 the two cannot be told apart.
    """

    matrix: np.ndarray = array(("row_column", "term"), "1")
    pairs: np.ndarray = array(("pair", "facet"), "1")
    residuals: np.ndarray = array(("pair", "row_column"), "m")
    margin: float = np.inf

    @property
    def rms(self) -> float:
        """Root mean square length of the residuals, metres."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))

    def __call__(self, points: Any) -> np.ndarray:
        """Places (p, 2) at the distal facet as places at the proximal one, metres."""
        points = real_array("points", points, shape=(None, 2), finite=True)
        return _moved(self.matrix, points)


def register_facets(distal: Any, proximal: Any, turn: float = np.pi) -> Registration:
    r"""Match the lattices of the two facets of a coherent bundle.

    .. math:: \min_{M, \text{pairs}} \sum_{\text{pairs}} |r^\text{proximal}_{j} - M (r^\text{distal}_{i}, 1)|^2

    A perfect lattice fits itself after a step of one pitch or a sixth of a turn; it is the jitter of real ones that
    tells. From every such start nearest neighbours are matched in a patch around the middle, the map is fitted, and the
    patch grows; of all ways the one with the least residual is taken.
    A fibrelet whose nearest neighbour has another nearest neighbour stays without partner: dead ones do no harm.

    Parameters
    ----------
    distal, proximal: (m, 2) and (k, 2) metres (row, column), as from :func:`fibre.find_fibrelets` times the pixel size;
    a mirrored image must be mirrored back. turn: radians, how far at most the facets are turned against each other; pi:
    no matter how, and slower.

    Raises
    ------
    ValueError: fewer than 20 fibrelets; shapes; nothing that fits better than chance (three tenths of the pitch).

    Source: iterative closest points, Besl and McKay (1992).

    >>> from fibre import Bundle, register_facets
    >>> bundle = Bundle.hexagonal(radius=40e-6, registration=[[0.99, -0.17, 2e-6], [0.17, 1.0, -1e-6]], rng=0)
    >>> found = register_facets(bundle.distal_centres, bundle.centres, turn=0.3)
    >>> bool(np.all(found.pairs[:, 0] == found.pairs[:, 1])), found.rms < 1e-9
    (True, True)
    """
    distal = real_array("distal", distal, shape=(None, 2), finite=True)
    proximal = real_array("proximal", proximal, shape=(None, 2), finite=True)
    turn = real_number("turn", turn, low=0, high=np.pi)
    if min(len(distal), len(proximal)) < 20:
        raise ValueError(f"distal and proximal must be 20 fibrelets or more, got {len(distal)} and {len(proximal)}.")
    trees = [scipy.spatial.cKDTree(points) for points in (distal, proximal)]
    pitches = [lattice_pitch(tree.data) for tree in trees]
    starts = _settled(np.array(_starts(distal, proximal, pitches, turn)), distal, trees[1], pitches)
    patch, ways = 2.5 * FIRST * pitches[0], []
    for limit in (patch, np.inf):
        grown = [_grown(start, distal, trees[1], pitches, limit) for start in starts]
        ways = _different(sorted((g for g in grown if g is not None), key=lambda g: g.rms), pitches[1])
        starts = [way.matrix for way in ways]
    ranked = ways
    if not ranked or ranked[0].rms > 0.3 * pitches[1]:
        raise ValueError("distal and proximal do not match; are both in metres, and neither mirrored?")
    best = ranked[0]
    margin = ranked[1].rms / max(best.rms, 1e-300) if len(ranked) > 1 else np.inf
    return Registration(best.matrix, best.pairs, best.residuals, float(margin))


def _moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(points @ matrix[:, :2].T + matrix[:, 2])


def _starts(distal: np.ndarray, proximal: np.ndarray, pitches: list[float], turn: float) -> list[np.ndarray]:
    """Maps to begin with: turned by all angles that matter, shifted by up to two pitches."""
    # a patch of FIRST pitches bears half of a third of a pitch at its rim
    step = 1 / (3 * FIRST)
    count = int(np.ceil(turn / step))
    angles = np.linspace(-turn, turn, 2 * count + 1)[: 2 * count + (turn < np.pi)]
    scale = pitches[1] / pitches[0]
    grid = np.indices((9, 9)).reshape(2, -1).T / 2.0 - 2
    shifts = grid[np.hypot(*grid.T) <= 2] * pitches[1]
    starts = []
    for angle in angles:
        turned = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        middle = proximal.mean(0) - turned @ distal.mean(0)
        starts += [np.column_stack([turned, middle + shift]) for shift in shifts]
    return starts


def _settled(
    starts: np.ndarray, distal: np.ndarray, tree: scipy.spatial.cKDTree, pitches: list[float]
) -> list[np.ndarray]:
    """A few rounds of matching and fitting of the first patch from all starts at once; the best ones that differ."""
    centre = distal.mean(0)
    patch = distal[np.hypot(*(distal - centre).T) <= FIRST * pitches[0]]
    # in pitches from the middle, for the sake of the normal equations
    design = np.column_stack([(patch - centre) / pitches[0], np.ones(len(patch))])
    targets = np.asarray(tree.data)
    maps = np.concatenate([starts[:, :, :2] * pitches[0], (starts[:, :, :2] @ centre + starts[:, :, 2])[..., None]], 2)
    for _ in range(5):
        distance, near = tree.query(np.einsum("ni,sji->snj", design, maps))
        used = distance < 0.5 * pitches[1]
        normal = np.einsum("ni,sn,nj->sij", design, used, design) + 1e-6 * np.eye(3)
        right = np.einsum("ni,sn,snj->sij", design, used, targets[near])
        maps = np.linalg.solve(normal, right).swapaxes(1, 2)
    rms = np.sqrt((np.minimum(distance, 0.5 * pitches[1]) ** 2).mean(1))
    linear = maps[:, :, :2] / pitches[0]
    found = np.concatenate([linear, (maps[:, :, 2] - linear @ centre)[..., None]], axis=2)
    # ends that agree within a tenth of a pitch are one
    ends = np.einsum("ni,sji->snj", np.array([[0, 0, 1], [4, 0, 1], [0, 4, 1]]), maps).reshape(len(maps), -1)
    order = np.argsort(rms, kind="stable")
    _, first = np.unique(np.rint(ends[order] / (0.1 * pitches[1])).astype(int), axis=0, return_index=True)
    return list(found[order][np.sort(first)[:MANY]])


def _grown(
    matrix: np.ndarray, distal: np.ndarray, tree: scipy.spatial.cKDTree, pitches: list[float], limit: float
) -> Registration | None:
    """Match a patch, fit, and let it grow up to the ``limit``; None where too few find a partner."""
    away = np.hypot(*(distal - distal.mean(0)).T)
    radius, found = FIRST * pitches[0], None
    while True:
        chosen = np.flatnonzero(away <= radius)
        distance, near = tree.query(_moved(matrix, distal[chosen]), distance_upper_bound=0.5 * pitches[1])
        matched = np.isfinite(distance)
        # two that want the same partner: the nearer one has it
        order = np.argsort(distance[matched], kind="stable")
        _, once = np.unique(near[matched][order], return_index=True)
        mine, other = chosen[matched][order][once], near[matched][order][once]
        if len(mine) < max(6, 0.6 * len(chosen)):
            return None
        # scikit-image's estimate_transform would take a matrix of k x k for k pairs
        design = np.column_stack([distal[mine] / pitches[0], np.ones(len(mine))])
        matrix = np.linalg.lstsq(design, np.asarray(tree.data)[other])[0].T / [pitches[0], pitches[0], 1]
        left = np.asarray(tree.data)[other] - _moved(matrix, distal[mine])
        found = Registration(matrix, np.stack([mine, other], axis=1), left)
        if radius > min(limit, away.max()):
            return found
        radius *= GROWTH


def _different(ways: list[Registration], pitch: float) -> list[Registration]:
    """The best few that put the lattice elsewhere: by half a pitch or more in the middle, or at one pitch from it."""
    chosen: list[Registration] = []
    corners = np.array([[0, 0], [4, 0], [0, 4]]) * pitch
    for way in ways:
        places = way(corners)
        if all(np.abs(places - other(corners)).max() > 0.5 * pitch for other in chosen):
            chosen.append(way)
        if len(chosen) == FEW:
            break
    return chosen
