"""The columns of the transmission matrix from calibration captures in which many points were lit at once.

In: :class:`fibre.CalibrationFields`. Out: for every distal point the columns of A near it, with variances. Called by
the recovery methods.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.spatial
from scipy.linalg.blas import zherk
from scipy.linalg.lapack import zpotrf, ztrtri
from threadpoolctl import threadpool_limits

from fibre.fibrelets import lattice_pitch, reference_region
from fibre.records import Calibration, CalibrationFields

__all__ = [
    "Columns",
    "Profile",
    "columns",
    "coupling_profile",
    "lit_points",
    "profile_of_patterns",
    "response_covariance",
    "spot_spacing",
    "unmeasured",
    "usual_response",
]


DENSE = 2.0  # fibrelets between neighbouring spots, below which no fibrelet belongs to a single spot
PATTERN_REACH = 8.0  # fibrelets: how far coupling is looked for where patterns are lit
FAINT = 1e-5  # of the coupling's peak: fainter responses are left out

_MADE: dict[int, dict[str, Any]] = {}


def _once(fields: CalibrationFields, name: str, make: Callable[[], Any]) -> Any:
    """What is made once of a calibration, and forgotten with it; a record's arrays do not change."""
    if id(fields) not in _MADE:
        _MADE[id(fields)] = {}
        weakref.finalize(fields, _MADE.pop, id(fields), None)
    made = _MADE[id(fields)]
    if name not in made:
        made[name] = make()
    return made[name]


@dataclass(frozen=True)
class Columns:
    """Columns of the transmission matrix A, point by point, as far as the spots light the fibrelets.

    values: sparse complex (2 m, 2 p), rows h of all fibrelets then v, columns h of all points then v. variance:
    sparse real, the same pattern, E|error|^2. positions: (p, 2) metres, the points on the camera.
    """

    values: scipy.sparse.csr_array
    variance: scipy.sparse.csr_array
    positions: np.ndarray


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
    return _once(fields, "profile", lambda: _coupling_profile(fields))


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


@dataclass(frozen=True)
class _Regressions:
    r"""The regression of some fibrelets on the inputs near them, padded to a common number q of points.

    cores: (k,). chosen: (k, 2 q), indices of the inputs (h of the points, then v). root: (k, 2 q), the root of T, 0
    where padded. scaled: (k, 2 q, captures), T^1/2 X. weight: 1/var, (2, k, captures) for either polarisation of the
    output.
    """

    cores: np.ndarray
    chosen: np.ndarray
    root: np.ndarray
    scaled: np.ndarray
    weight: np.ndarray

    def roots(self, polarisation: int) -> np.ndarray:
        r"""W with :math:`W^H W = (1 + T^{1/2} X \, \mathrm{diag}(1/\mathrm{var}) X^H T^{1/2})^{-1}`, (k, 2 q, 2 q)."""
        size = self.root.shape[1]
        found = np.empty((len(self.cores), size, size), complex)
        white = self.scaled * np.sqrt(self.weight[polarisation])[:, None]
        # threads that wait for each other take twice as long for matrices as small as these
        with threadpool_limits(1, user_api="blas"):
            for rows, root in zip(white, found, strict=True):
                # triangles only, a quarter of the work of an inverse; Fortran's order turns a matrix into its conjugate
                system = zherk(1.0, rows.T, trans=2)
                system.ravel(order="K")[:: size + 1] += 1
                factor, failed = zpotrf(system, lower=0, overwrite_a=1)
                inverse, singular = ztrtri(factor, lower=0, overwrite_c=1)
                if failed or singular:
                    raise np.linalg.LinAlgError("fields and variances of the calibration make no finite system.")
                root[:] = inverse.T
        return found


def _regressions(fields: CalibrationFields, fraction: float, chunk: int) -> Iterator[_Regressions]:
    count = len(fields.points)
    positions, clean = positions_on_camera(fields), clean_fibrelets(fields)
    lit_points(fields)
    profile = coupling_profile(fields)
    near = scipy.spatial.cKDTree(positions).query_ball_point(fields.fibrelets.centres, profile.reach(fraction))
    inputs = np.vstack([fields.inputs.toarray(), np.zeros(fields.inputs.shape[1])])  # last row: no point at all
    usable = [core for core in np.flatnonzero(clean) if near[core]]
    if not usable:
        raise ValueError("calibration_fields have no fibrelet within reach of a point; check the registration.")
    for start in range(0, len(usable), chunk):
        cores = np.array(usable[start : start + chunk])
        points = np.full((len(cores), max(len(near[core]) for core in cores)), -1)
        for i, core in enumerate(cores):
            points[i, : len(near[core])] = near[core]
        away = np.hypot(*np.moveaxis(positions[points] - fields.fibrelets.centres[cores][:, None], -1, 0))
        root = np.sqrt(np.tile(np.where(points >= 0, profile(away), 0), 2))
        chosen = np.where(root > 0, np.concatenate([points, points + count], axis=1), 2 * count)
        scaled = root[..., None] * inputs[chosen]
        weight = 1 / fields.variance[:, :, cores].transpose(1, 2, 0)
        yield _Regressions(cores, chosen, root, scaled, weight)


def unmeasured(fields: CalibrationFields) -> np.ndarray:
    r"""Power on each fibrelet, (m,), of light that enters where no spot was, in proportion to an even light's.

    The facet has more fibrelets than points where the points are far apart: with n fibrelets to a point, light has n
    dimensions there and the calibration has seen one. What comes of the others is known on average,

    .. math:: \frac{1 - 1/n}{n^2} \sum_l \tau^2(|r_k - r_l|)

    over all fibrelets l, with the :func:`coupling_profile`: an even light is the sum of spots at all points, and
    its amplitude on a fibrelet falls as the points' density, 1/n. 0 where points are as dense as fibrelets.
    """
    centres, positions = fields.fibrelets.centres, positions_on_camera(fields)
    if len(positions) < 2:
        return np.zeros(len(centres))
    tree, profile = scipy.spatial.cKDTree(centres), coupling_profile(fields)
    # circles as large as the square cell of a point
    around = tree.query_ball_point(positions, lattice_pitch(positions) / np.sqrt(np.pi), return_length=True)
    count = max(float(around.mean()), 1.0)
    share = (1 - 1 / count) / count**2
    pairs = tree.sparse_distance_matrix(tree, profile.reach(FAINT), output_type="coo_matrix")
    return share * np.bincount(pairs.row, profile(pairs.data), len(centres))


def columns(fields: CalibrationFields, fraction: float = FAINT, chunk: int = 128) -> Columns:
    r"""Columns of A by linear regression with a local prior, one fibrelet at a time.

    A fibrelet's amplitude in capture c is :math:`y_c = \sum_j A_j x_{jc} + n_c` over all points j lit within reach.
    With the prior :math:`A_j \sim CN(0, \tau^2(d_j))` of the measured :func:`coupling_profile`, T = diag tau^2 and
    N = diag var,

    .. math:: \hat A = y N^{-1} X^H \Sigma, \quad \Sigma = (T^{-1} + X N^{-1} X^H)^{-1}
              = T^{1/2} (1 + T^{1/2} X N^{-1} X^H T^{1/2})^{-1} T^{1/2}

    so spots that were lit together are told apart as well as the translations allow, and what stays ambiguous between
    them is in the covariance. Points beyond the distance at which the profile has fallen to ``fraction`` of its peak
    are left out. Fibrelets that carry the reference spot get no columns. ``chunk`` fibrelets are worked on at a time.
    Made once for a calibration.
    """
    return _once(fields, f"columns, {fraction!r}", lambda: _columns(fields, fraction, chunk))


def _columns(fields: CalibrationFields, fraction: float, chunk: int) -> Columns:
    count, cores = len(fields.points), len(fields.fibrelets.centres)
    inputs = np.vstack([fields.inputs.toarray().conj(), np.zeros(fields.inputs.shape[1])])
    seen, noise = (x.reshape(-1, 2 * cores).T for x in (fields.fields, fields.variance))
    rows, cols, values, variances = [], [], [], []
    for own, chosen, roots in _covariance_roots(fields, fraction, chunk):
        real = chosen < 2 * count
        right = np.einsum("kjc,kc->kj", inputs[chosen], seen[own] / noise[own])
        found = np.einsum("kl,kli->ki", np.einsum("kj,klj->kl", right, roots.conj()), roots)
        rows.append(np.broadcast_to(own[:, None], real.shape)[real])
        cols.append(chosen[real])
        values.append(found[real])
        variances.append((roots.real**2 + roots.imag**2).sum(1)[real])
    place = (np.concatenate(rows), np.concatenate(cols))
    shape = (2 * cores, 2 * count)
    return Columns(
        scipy.sparse.csr_array((np.concatenate(values), place), shape=shape),
        scipy.sparse.csr_array((np.concatenate(variances), place), shape=shape),
        positions_on_camera(fields),
    )


def response_covariance(
    fields: CalibrationFields, inputs: np.ndarray, fraction: float = FAINT, chunk: int = 128
) -> np.ndarray:
    r"""How uncertain the calibration leaves each fibrelet's response to given distal fields.

    For fields Z (2 p, s) and the error :math:`\delta A` of a row of A, :math:`E[(\delta A Z)^H \delta A Z] = Z^H \Sigma
    Z` with the covariance of :func:`columns`: complex (2 m, s, s), rows h of all fibrelets then v, 0 where there are
    no columns. Errors of different rows are independent. What does not depend on Z is made once for a calibration.
    """
    inputs = np.vstack([inputs, np.zeros(inputs.shape[1])])
    cores = len(fields.fibrelets.centres)
    covariance = np.zeros((2 * cores, inputs.shape[1], inputs.shape[1]), complex)
    kept = _once(fields, _roots_name(fraction), lambda: list(_covariance_roots(fields, fraction, chunk)))
    for rows, chosen, roots in kept:
        whitened = roots @ inputs[chosen]
        covariance[rows] = whitened.conj().swapaxes(-1, -2) @ whitened
    return covariance


def _roots_name(fraction: float) -> str:
    return f"roots of the covariance, {fraction!r}"


def _covariance_roots(
    fields: CalibrationFields, fraction: float, chunk: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    r"""Rows of A (k,), the inputs that reach them (k, 2 q), and roots of their covariance: :math:`\Sigma = W^H W`.

    They are large, so that only :func:`response_covariance`, which asks for them again and again, keeps them; once they
    are there they serve :func:`columns` too.
    """
    cores = len(fields.fibrelets.centres)
    if (kept := _MADE.get(id(fields), {}).get(_roots_name(fraction))) is not None:
        yield from kept
        return
    for part in _regressions(fields, fraction, chunk):
        for polarisation in range(2):
            yield polarisation * cores + part.cores, part.chosen, part.roots(polarisation) * part.root[:, None]


def usual_response(
    fields: CalibrationFields, inputs: np.ndarray, fraction: float = FAINT, chunk: int = 128
) -> np.ndarray:
    r"""Covariance of responses to given distal fields before looking closer: :math:`Z^H T Z`.

    T are the variances of the :func:`coupling_profile`. Complex (2 m, s, s), as :func:`response_covariance`.
    """
    inputs = np.vstack([inputs, np.zeros(inputs.shape[1])])
    cores = len(fields.fibrelets.centres)
    covariance = np.zeros((2 * cores, inputs.shape[1], inputs.shape[1]), complex)
    for part in _regressions(fields, fraction, chunk):
        z = part.root[..., None] * inputs[part.chosen]
        covariance[part.cores] = covariance[cores + part.cores] = z.conj().swapaxes(-1, -2) @ z
    return covariance
