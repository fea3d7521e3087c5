"""Where the points of a calibration lie on the camera, and how the coupling between points and fibrelets falls with
their distance.

In: :class:`fibre.CalibrationFields`. Out: positions, the fibrelets clear of the reference spot, the mean profile.
Called by the columns of A, by the recovery methods and by the watch over an ageing calibration.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.spatial

from fibre.fibrelets import lattice_pitch, reference_region
from fibre.records import Calibration, CalibrationFields

__all__ = [
    "Profile",
    "clean_fibrelets",
    "coupling_profile",
    "fibrelets_a_point",
    "lit_points",
    "made",
    "once",
    "positions_on_camera",
    "profile_of_patterns",
    "spot_spacing",
]

DENSE = 2.0  # fibrelets between neighbouring spots, below which no fibrelet belongs to a single spot
PATTERN_REACH = 8.0  # fibrelets: how far coupling is looked for where patterns are lit

_MADE: dict[int, dict[str, Any]] = {}


def once(fields: CalibrationFields, name: str, make: Callable[[], Any]) -> Any:
    """What is made once of a calibration, and forgotten with it; a record's arrays do not change."""
    if id(fields) not in _MADE:
        _MADE[id(fields)] = {}
        weakref.finalize(fields, _MADE.pop, id(fields), None)
    own = _MADE[id(fields)]
    if name not in own:
        own[name] = make()
    return own[name]


def made(fields: CalibrationFields, name: str) -> Any:
    """What :func:`once` has made under this name; None: nothing yet."""
    return _MADE.get(id(fields), {}).get(name)


@dataclass(frozen=True)
class Profile:
    """Mean |A|^2 against the distance between point and fibrelet: what is expected before looking closer.

    distance, power: bins (b,), metres and squared amplitude, power falling. Beyond the last bin it goes on
    exponentially with ``decay`` (1/metre).
    """

    distance: np.ndarray
    power: np.ndarray
    decay: float

    def __call__(self, distance: np.ndarray) -> np.ndarray:
        """Expected |A|^2 at the distances, metres."""
        inside = np.exp(np.interp(distance, self.distance, np.log(self.power)))
        return inside * np.exp(-self.decay * np.maximum(distance - self.distance[-1], 0))

    def reach(self, fraction: float) -> float:
        """Distance beyond which less than ``fraction`` of the peak is expected."""
        below = np.flatnonzero(self.power < fraction * self.power[0])
        if len(below):
            return float(self.distance[below[0]])
        return float(self.distance[-1] + np.log(self.power[-1] / (fraction * self.power[0])) / self.decay)


def lit_points(fields: CalibrationFields) -> list[np.ndarray]:
    """Points lit in each capture; every point must be lit somewhere, in two states or more."""
    inputs, count = fields.inputs.tocsc(), len(fields.points)
    lit = [np.unique(inputs.indices[inputs.indptr[c] : inputs.indptr[c + 1]] % count) for c in range(inputs.shape[1])]
    missing = sorted(set(range(count)) - {int(point) for points in lit for point in points})
    if missing:
        raise ValueError(f"inputs must light every point, but never light {len(missing)} of them, first {missing[0]}.")
    h, v = inputs[:count], inputs[count:]
    powers = [np.asarray(abs(part).power(2).sum(axis=1)).ravel() for part in (h, v)]
    overlap = np.asarray(h.conj().multiply(v).sum(axis=1)).ravel()
    single = np.flatnonzero(powers[0] * powers[1] - np.abs(overlap) ** 2 < 1e-9 * (powers[0] + powers[1]) ** 2)
    if len(single):
        raise ValueError(
            f"inputs must light every point in two states of polarisation or more, but {len(single)} points have one, "
            f"first {single[0]}."
        )
    return lit


def positions_on_camera(fields: CalibrationFields | Calibration) -> np.ndarray:
    """The distal points on the camera, (p, 2) metres, by the registration."""
    return fields.points @ fields.registration[:, :2].T + fields.registration[:, 2]


def fibrelets_a_point(fields: CalibrationFields) -> float:
    """How many fibrelets there are to a calibrated point, >= 1: as many as a circle as large as its square cell holds,
    on average. Made once for a calibration."""
    return float(once(fields, "fibrelets a point", lambda: _fibrelets_a_point(fields)))


def _fibrelets_a_point(fields: CalibrationFields) -> float:
    positions = positions_on_camera(fields)
    if len(positions) < 2:
        return 1.0
    tree = scipy.spatial.cKDTree(fields.fibrelets.centres)
    around = tree.query_ball_point(positions, lattice_pitch(positions) / np.sqrt(np.pi), return_length=True)
    return max(float(around.mean()), 1.0)


def clean_fibrelets(fields: CalibrationFields) -> np.ndarray:
    """Fibrelets that do not carry the reference spot, bool (m,)."""
    power = (np.abs(fields.reference) ** 2).sum(0)
    return ~reference_region(power)


def coupling_profile(fields: CalibrationFields) -> Profile:
    r"""How the response to a spot falls with distance, averaged over the bundle.

    Every fibrelet of a capture is ascribed to the lit point that is nearest; squared amplitudes, less their noise, are
    averaged in bins of distance and made to fall monotonically. Near the middle between two spots both contribute, so
    the profile is a little too broad there: a weaker prior, not a wrong one. Spots nearer than two fibrelets to each
    other: :func:`profile_of_patterns`. Made once for a calibration.
    """
    return once(fields, "profile", lambda: _coupling_profile(fields))


def _coupling_profile(fields: CalibrationFields) -> Profile:
    positions, clean = positions_on_camera(fields), clean_fibrelets(fields)
    centres = fields.fibrelets.centres[clean]
    distance, power, weight = [], [], []
    lit = lit_points(fields)
    pitch = lattice_pitch(centres)
    if spot_spacing(fields) < DENSE * pitch:
        # a fibrelet without any field is not dark, but unknown
        known = clean & np.any(fields.fields != 0, axis=(0, 1))
        powers = (np.abs(fields.fields) ** 2 - fields.variance).mean(1)[:, known]
        return profile_of_patterns(fields.fibrelets.centres[known], positions, fields.inputs, powers, pitch)
    for capture, points in enumerate(lit):
        if len(points) == 0:
            continue
        away, owner = scipy.spatial.cKDTree(positions[points]).query(centres)
        share = np.asarray(abs(fields.inputs[:, [capture]]).power(2).sum()) / len(points)
        distance.append(away)
        amplitude = np.abs(fields.fields[capture][:, clean]) ** 2 - fields.variance[capture][:, clean]
        power.append(amplitude.mean(0) / share)
        weight.append(np.ones(len(owner)))
    away, squared = np.concatenate(distance), np.concatenate(power)
    furthest = np.quantile(away, 0.98) if sum(len(p) for p in lit) > len(lit) else np.median(away)
    # coupling falls within a few fibrelets, however far apart the spots are
    edges = np.linspace(0, furthest, max(12, int(np.ceil(furthest / (0.7 * pitch)))) + 1)
    index = np.digitize(away, edges) - 1
    middle, mean = [], []
    for b in range(len(edges) - 1):
        inside = squared[index == b]
        # from the first bin that noise could have made, the tail is extrapolated
        if len(inside) < 5 or inside.mean() < 4 * inside.std() / np.sqrt(len(inside)):
            break
        middle.append(away[index == b].mean())
        mean.append(inside.mean())
    if len(middle) < 3:
        raise ValueError("calibration_fields have too few lit fibrelets to see how the coupling falls with distance.")
    falling = np.minimum.accumulate(mean)
    tail = slice(len(middle) // 2, None)
    slope = np.polyfit(middle[tail], np.log(falling[tail]), 1)[0]
    return Profile(np.array(middle), falling, float(max(-slope, 1 / furthest)))


def spot_spacing(fields: CalibrationFields) -> float:
    """Least distance on the camera, metres, between spots that are lit together; infinite if none are."""
    positions = positions_on_camera(fields)
    several = [positions[points] for points in lit_points(fields) if len(points) > 1]
    return min((float(scipy.spatial.cKDTree(p).query(p, k=2)[0][:, 1].min()) for p in several), default=np.inf)


def profile_of_patterns(
    centres: np.ndarray, positions: np.ndarray, inputs: scipy.sparse.csr_array, powers: np.ndarray, pitch: float
) -> Profile:
    r"""The coupling profile where many neighbouring points are lit at once with random phases.

    .. math:: E|y_{kc}|^2 = \sum_b \tau_b^2 \sum_{j: d_{kj} \in b} |x_{jc}|^2

    for the random phases of A: non-negative least squares for the powers of all bins b of distance, each mean power
    with a variance that is its square, as that of speckle is. ``powers``: (captures, m), less their noise.
    """
    edges = np.linspace(0, PATTERN_REACH * pitch, int(PATTERN_REACH / 0.5) + 1)
    tree = scipy.spatial.cKDTree(centres)
    pairs = tree.sparse_distance_matrix(scipy.spatial.cKDTree(positions), edges[-1], output_type="coo_matrix")
    count = len(positions)
    lit = np.asarray((abs(inputs[:count]).power(2) + abs(inputs[count:]).power(2)).toarray())
    bins = np.digitize(pairs.data, edges) - 1
    design = np.stack(
        [
            (scipy.sparse.csr_array(((bins == b) * 1.0, (pairs.row, pairs.col)), shape=pairs.shape) @ lit).T.ravel()
            for b in range(len(edges) - 1)
        ],
        axis=1,
    )
    target = powers.ravel()
    reached = design.sum(1) > 0
    if np.count_nonzero(reached) < 10 * len(edges):
        raise ValueError("calibration_fields have too few lit fibrelets to see how the coupling falls with distance.")
    design, target = design[reached], target[reached]
    weight = np.full(len(target), 1 / max(float(target.mean()), 1e-300))
    for _ in range(4):
        found = scipy.optimize.nnls(design * weight[:, None], target * weight)[0]
        expected = design @ found
        weight = 1 / np.maximum(expected, 1e-3 * expected.max())
    # from the first bin that speckle could have made, the tail is extrapolated
    uncertain = np.sqrt(np.diag(np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))))
    good = np.flatnonzero(found < 3 * uncertain)
    last = int(good[0]) if len(good) else len(found)
    if last < 3:
        raise ValueError("calibration_fields do not show how the coupling falls with distance; light fewer points.")
    middle, falling = (edges[:-1] + edges[1:])[:last] / 2, np.minimum.accumulate(found[:last])
    slope = np.polyfit(middle[last // 2 :], np.log(falling[last // 2 :]), 1)[0]
    return Profile(middle, falling, float(max(-slope, 1 / edges[-1])))
