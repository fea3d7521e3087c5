"""Find fibrelets in an image, and express camera fields in their modes.

In: an image of the facet; then complex fields with variances. Out: centres, and one complex amplitude per fibrelet
with its variance. Called by ``retrieve_fields``, which keeps fields in this basis: hundreds of numbers, not a frame.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial

from fibre.records import Fibrelets
from polinfer.checks import complex_array, real_array, real_number

__all__ = ["LocalPower", "ModeBasis", "find_fibrelets", "lattice_pitch", "locate_fibrelets", "mode_matrix",
           "reference_region"]  # fmt: skip

BESIDE = 1.6  # pitches: fibrelets whose light is taken to be about as strong
REFERENCE = 0.03  # of the strongest: fibrelets with more of the reference spot's power belong to it


def find_fibrelets(image: Any) -> np.ndarray:
    r"""Centres of the fibrelets in an image of the evenly lit facet, (m, 2) pixels (row, column), sub-pixel.

    The lattice pitch p comes from the strongest ring of the image's power spectrum (first order of a hexagonal
    lattice, :math:`2/(\sqrt 3 p)`); maxima of the slightly smoothed image at least 0.6 p apart are taken, and each is
    refined by a quadratic fit to the logarithm of its 3 x 3 neighbourhood. Left out are maxima below a tenth of the
    typical one, those within six standard deviations of the noise that is seen where no fibrelet is near, and those at
    the frame's edge.

    ``image``: real (y, x), non-negative up to noise, pitch at least 4 pixels. Raises ValueError when no lattice is
    found.

    >>> y, x = np.mgrid[:60, :60]
    >>> centres = [(8 + 7 * r, 8 + 8 * c + 4 * (r % 2)) for r in range(7) for c in range(6)]
    >>> image = sum(np.exp(-((y - r) ** 2 + (x - c) ** 2) / 5) for r, c in centres)
    >>> found = find_fibrelets(image)
    >>> len(found), bool(np.abs(found - np.array(centres)).max() < 0.05)
    (42, True)
    """
    image = real_array("image", image, shape=(None, None), finite=True)
    return _peaks(image, 0.1)


def locate_fibrelets(image: Any, pixel_size: float) -> Fibrelets:
    r"""Centres and mode radii of the fibrelets in an intensity image, in metres from the frame's middle.

    The common radius w is the one whose sum of spots :math:`\sum_k p_k e^{-2 |r - r_k|^2 / w^2}`, with heights p by
    least squares, leaves the least of the image over; from it each fibrelet's own is refined. ``image`` should be an
    incoherent sum of many fields, so that neighbours do not interfere in it.
    """
    image = real_array("image", image, shape=(None, None), finite=True)
    pixel_size = real_number("pixel_size", pixel_size, above=0)
    # faint neighbours of lit fibrelets matter: light without a mode of its own would be ascribed to others
    centres = _peaks(image, 0.003)
    middle = (np.array(image.shape) - 1) / 2
    positions = (centres - middle) * pixel_size
    pitch = _pitch(image) * pixel_size

    def left_over(radius: float) -> float:
        # the square of a mode of radius w is a spot of intensity with w / sqrt 2 in the same formula
        spots = mode_matrix(Fibrelets(positions, radius / np.sqrt(2)), image.shape, pixel_size)
        normal = (spots.T @ spots).tocsc()
        heights = scipy.sparse.linalg.spsolve(normal, spots.T @ image.ravel())
        return float(((image.ravel() - spots @ heights) ** 2).sum())

    best = scipy.optimize.minimize_scalar(
        left_over, bounds=(0.15 * pitch, 0.6 * pitch), method="bounded", options={"xatol": 1e-4 * pitch}
    )
    return Fibrelets(positions, _own_radii(image, pixel_size, positions, float(best.x)))


def _own_radii(
    image: np.ndarray, pixel_size: float, positions: np.ndarray, common: float, spread: float = 0.03
) -> np.ndarray:
    """Radii of the single modes, (m,): Gauss-Newton steps on heights and radii from the common radius.

    A prior of relative width ``spread`` holds the radius of a faint fibrelet at the common one. It matters: a mode that
    is 2 % too narrow leaves a tail that its dark neighbour is then thought to carry.
    """
    radii = np.full(len(positions), common)
    target, step = image.ravel(), 0.01
    for _ in range(3):
        spots, wider, narrower = (
            mode_matrix(Fibrelets(positions, radii * factor / np.sqrt(2)), image.shape, pixel_size)
            for factor in (1, 1 + step, 1 - step)
        )
        # of a spot of constant height, against the logarithm of its radius
        slope = ((1 + step) * wider - (1 - step) * narrower) / (2 * step)
        heights = scipy.sparse.linalg.spsolve((spots.T @ spots).tocsc(), spots.T @ target)
        left = target - spots @ heights
        scaled = slope @ scipy.sparse.diags_array(heights)
        both = scipy.sparse.hstack([spots, scaled])
        prior = np.concatenate([np.zeros(len(radii)), np.full(len(radii), np.mean(left**2) / spread**2)])
        normal = (both.T @ both + scipy.sparse.diags_array(prior)).tocsc()
        pull = prior * np.concatenate([np.zeros(len(radii)), np.log(common / radii)])
        change = scipy.sparse.linalg.spsolve(normal, both.T @ left + pull)[len(radii) :]
        radii = radii * np.exp(np.clip(change, -0.05, 0.05))
    return radii


def _pitch(image: np.ndarray) -> float:
    """Lattice pitch in pixels from the first ring of the power spectrum."""
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    power = np.abs(np.fft.fft2((image - image.mean()) * window)) ** 2
    fy, fx = np.fft.fftfreq(image.shape[0]), np.fft.fftfreq(image.shape[1])
    radius = np.hypot(fy[:, None], fx[None, :])
    bins = max(image.shape)
    ring = np.minimum((radius * bins).astype(int), bins)
    # noise is in every ring in proportion to its size, and in a wide dark frame it is more than the lattice's light;
    # half of the frequencies have less than log 2 of its mean
    noise = np.median(power) / np.log(2)
    total = np.bincount(ring.ravel(), power.ravel() - noise, bins + 1)
    frequency = (np.arange(bins + 1) + 0.5) / bins
    # envelope and shading live at low frequencies, noise is flat: look between 40 and 4 pixels of pitch
    allowed = (frequency > 2 / np.sqrt(3) / 40) & (frequency < 2 / np.sqrt(3) / 4)
    if not np.any(total[allowed] > 0):
        raise ValueError("image shows no lattice of fibrelets; light the whole facet evenly and focus on it.")
    best = frequency[allowed][np.argmax(total[allowed])]
    return float(2 / np.sqrt(3) / best)


def _peaks(image: np.ndarray, faintest: float) -> np.ndarray:
    """Sub-pixel centres (m, 2), row by row."""
    pitch = _pitch(image)
    smooth = scipy.ndimage.gaussian_filter(image, 0.08 * pitch)
    highest = smooth == scipy.ndimage.maximum_filter(smooth, 2 * max(1, int(0.3 * pitch)) + 1)
    # two pixels are kept for the neighbourhood in which a maximum is refined
    highest[:2] = highest[-2:] = highest[:, :2] = highest[:, -2:] = False
    peaks = np.argwhere(highest)
    if len(peaks) == 0:
        raise ValueError("image shows no fibrelets; light the whole facet evenly and focus on it.")
    heights = smooth[tuple(peaks.T)]
    order = np.argsort(-heights, kind="stable")
    peaks, heights = peaks[order], heights[order]
    # typical is the maximum to which the brighter ones hold half of the power: noise in a wide dark margin has many
    # maxima, but little power
    light = np.cumsum(np.maximum(heights - np.median(smooth), 0) ** 2)
    typical = heights[np.searchsorted(light, 0.5 * light[-1])]
    lit = heights > faintest * typical
    bright = heights > max(faintest, 0.3) * typical
    for _ in range(3):
        # noise is seen where no fibrelet is near; each time round fainter ones are known and kept out of it
        near = np.zeros(image.shape)
        near[tuple(peaks[bright].T)] = 1
        dark = smooth[scipy.ndimage.maximum_filter(near, 2 * int(np.ceil(1.2 * pitch)) + 1) == 0]
        if len(dark) < 100:  # the facet fills the frame
            bright = lit
            break
        level = np.median(dark)
        bright = lit & (heights > level + 6 * 1.4826 * np.median(np.abs(dark - level)))
    peaks = _apart(peaks[bright], 0.6 * pitch)
    offsets = np.indices((3, 3)).reshape(2, -1).T - 1
    around = smooth[peaks[:, None, 0] + offsets[:, 0], peaks[:, None, 1] + offsets[:, 1]]
    logs = np.log(np.maximum(around, 1e-3 * around.max(1, keepdims=True)))
    # quadratic in (row, column): a + b r + c s + d r^2 + e s^2 + f r s, least squares on nine points
    r, s = offsets.T
    fit = np.linalg.pinv(np.stack([np.ones(9), r, s, r**2, s**2, r * s], 1)) @ logs.T
    _, b, c, d, e, f = fit
    determinant = 4 * d * e - f**2
    peaked = (d < 0) & (e < 0) & (determinant > 0)
    step = np.zeros((len(peaks), 2))
    safe = np.where(peaked, determinant, 1.0)
    step[:, 0] = np.where(peaked, (f * c - 2 * e * b) / safe, 0)
    step[:, 1] = np.where(peaked, (f * b - 2 * d * c) / safe, 0)
    centres = peaks + np.clip(step, -1, 1)
    # by the rows of pixels: rounding in the last digit of a centre must not decide about the order
    return centres[np.lexsort((peaks[:, 1], peaks[:, 0]))]


def _apart(peaks: np.ndarray, distance: float) -> np.ndarray:
    """Peaks, brightest first, without those that are nearer than ``distance`` to a brighter one that is kept."""
    pairs = scipy.spatial.cKDTree(peaks).query_pairs(distance, output_type="ndarray")
    kept = np.ones(len(peaks), bool)
    for bright, faint in sorted(map(tuple, np.sort(pairs, axis=1).tolist())):
        kept[faint] &= not kept[bright]
    return peaks[kept]


def lattice_pitch(centres: np.ndarray) -> float:
    """Typical distance between neighbours of ``centres`` (m, 2), in their unit."""
    return float(np.median(scipy.spatial.cKDTree(centres).query(centres, k=2)[0][:, 1]))


def reference_region(power: np.ndarray) -> np.ndarray:
    """Which fibrelets carry the reference spot, bool (m,), by its power (m,) in each."""
    return np.asarray(power > REFERENCE * power.max())


def mode_matrix(fibrelets: Fibrelets, shape: tuple[int, int], pixel_size: float) -> scipy.sparse.csr_array:
    """Modes as columns over the pixels of a frame, sparse real (y x, m), each with a sum of squares of 1.

    A mode ends three of its radii from its centre. Of one at the frame's edge the sum is that over the pixels beyond it
    too.
    """
    reach = int(np.ceil(3 * fibrelets.mode_radius.max() / pixel_size))
    w = fibrelets.mode_radius[:, None]
    middle = (np.array(shape) - 1) / 2
    pixel = fibrelets.centres / pixel_size + middle
    offset = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach
    place = np.rint(pixel).astype(int)[:, None] + offset
    inside = ((place >= 0) & (place < np.array(shape))).all(-1)
    distance2 = ((place - pixel[:, None]) ** 2).sum(-1) * pixel_size**2
    near = distance2 <= (3 * w) ** 2
    inside &= near
    values = np.where(near, np.exp(-distance2 / w**2), 0)
    values /= np.sqrt((values**2).sum(1, keepdims=True))
    mode = np.broadcast_to(np.arange(len(pixel))[:, None], inside.shape)
    row = np.ravel_multi_index(tuple(place[inside].T), shape)
    return scipy.sparse.csr_array((values[inside], (row, mode[inside])), shape=(shape[0] * shape[1], len(pixel)))


class LocalPower:
    r"""The power that a mode may carry, from an image of the power, as the prior of its amplitude.

    For every mode the matched filter :math:`\sum_x w\,g_k^2 I / \sum_x w\,g_k^4`, averaged over the mode and its
    neighbours, and two standard errors of that mean: what lights a fibrelet lights those beside it, and their fields
    interfere.

    ``squares``: of the modes, sparse (m, y x). ``centres`` (m, 2), metres.
    """

    def __init__(self, squares: scipy.sparse.csr_array, centres: np.ndarray) -> None:
        self._squares, self._fourths = squares, squares.power(2)
        near = BESIDE * lattice_pitch(centres) if len(centres) > 1 else 1.0
        i, j = scipy.spatial.cKDTree(centres).query_pairs(near, output_type="ndarray").T
        each = np.arange(len(centres))
        pairs = np.r_[i, j, each], np.r_[j, i, each]
        beside = scipy.sparse.csr_array((np.ones(len(pairs[0])), pairs))
        self._mean = scipy.sparse.csr_array(scipy.sparse.diags_array(1 / beside.sum(axis=1)) @ beside)
        self._squared_mean = self._mean.power(2)

    def __call__(self, power: np.ndarray, weight: np.ndarray, most: float) -> np.ndarray:
        """(m,), at most ``most``, from an image of the power (y, x) and its inverse variances, 0 where unusable."""
        known = weight.ravel()
        strength = np.maximum(self._fourths @ known, 1e-30)
        seen = self._squares @ (known * np.where(known > 0, power.ravel(), 0)) / strength
        error = np.sqrt(self._squared_mean @ (1 / strength))
        return np.minimum(np.maximum(self._mean @ seen, 0) + 2 * error, most)


class ModeBasis:
    """The modes of a frame (:func:`mode_matrix`), ready for weighted least squares of many fields."""

    def __init__(self, modes: scipy.sparse.csr_array) -> None:
        self.modes = modes
        self.transposed = scipy.sparse.csr_array(modes.T)
        self.squares = self.transposed.power(2)

    @cached_property
    def _gram(self) -> scipy.sparse.csr_array:
        return scipy.sparse.csr_array(self.transposed @ self.modes)

    def _normal(self, weight: np.ndarray) -> scipy.sparse.csr_array:
        """G^T diag(weight) G."""
        if weight.min() == weight.max():
            return self._gram * float(weight[0])
        rows = self.transposed
        weighted = scipy.sparse.csr_array((rows.data * weight[rows.indices], rows.indices, rows.indptr), rows.shape)
        return scipy.sparse.csr_array(weighted @ self.modes)

    def amplitudes(self, field: Any, variance: Any, prior_power: Any) -> tuple[np.ndarray, np.ndarray]:
        r"""Amplitudes c of the modes G in one field by weighted least squares with a weak prior.

        .. math:: \min_c \sum_x |E(x) - (G c)(x)|^2 / \mathrm{var}(x) + |c|^2 / P

        ``field`` complex (y, x); ``variance`` real (y, x), infinite where the field says nothing; ``prior_power`` P,
        what a mode may carry, one number or (m,): where the field says nothing the amplitude is 0 with variance P.
        Returns complex (m,) and the variance (m,): one over the diagonal of the normal matrix, which neighbours that
        overlap by a few per cent leave right to the square of that.
        """
        field = complex_array("field", field, shape=(None, None))
        variance = real_array("variance", variance, shape=field.shape, above=0)
        usable = np.isfinite(variance)
        weight = np.where(usable, 1 / variance, 0).ravel()
        known = weight * np.where(usable, field, 0).ravel()
        diagonal = self.squares @ weight + 1 / prior_power
        # scaled to a diagonal of ones; neighbours overlap by a few per cent, so that a dozen steps are exact
        scale = scipy.sparse.diags_array(1 / np.sqrt(diagonal))
        normal = scale @ self._normal(weight) @ scale
        normal += scipy.sparse.diags_array(1 / (prior_power * diagonal))
        right = (self.transposed @ np.stack([known.real, known.imag], axis=1)) / np.sqrt(diagonal)[:, None]
        parts = [scipy.sparse.linalg.cg(normal, column, rtol=1e-12, maxiter=200)[0] for column in right.T]
        return (parts[0] + 1j * parts[1]) / np.sqrt(diagonal), 1 / diagonal
