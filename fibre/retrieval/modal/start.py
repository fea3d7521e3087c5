"""Where Gauss-Newton begins: products of neighbouring amplitudes, which the images hold linearly, put together.

In: the geometry once, then images of any number of fields. Out: amplitudes of all modes, within some per cent. Called
by :class:`fibre.Modal`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
from scipy.sparse.linalg import cg, splu

from fibre.fibrelets import lattice_pitch
from fibre.records import Fibrelets
from fibre.retrieval.modal.views import Views

__all__ = ["Neighbours", "make_neighbours", "spreads", "synchronise"]

FAINT = 0.02  # products of modes below this, of their own squares, are left out
PAIRS = 8  # most pairs a fibrelet: beyond, images are no longer local enough
RIDGE = 1e-3
EDGE = 2.2  # radii, beyond which a mode's light is left out


@dataclass(frozen=True)
class Neighbours:
    r"""Linear equations between images and products of amplitudes.

    Image i is :math:`\sum_k |h_{ik}|^2 P_k + 2\,\mathrm{Re} \sum_{k<l} h_{ik} h_{il}^* X_{kl}` with powers
    :math:`P_k = |c_k|^2` and products :math:`X_{kl} = c_k c_l^*`, h the mode k as image i sees it.

    planes: the images that are local enough. pairs: (p, 2) modes. design: sparse float32 (pixels of these images,
    m + 2 p), columns of unit length. normal: its normal matrix and a ridge. scale: (m + 2 p,), which divided the
    columns.
    """

    planes: np.ndarray
    pairs: np.ndarray
    design: scipy.sparse.csr_array
    normal: scipy.sparse.csr_array
    scale: np.ndarray

    def products(self, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Powers (m,) and products (p,) that explain ``images`` (image, y, x) best."""
        right = self.design @ images[self.planes].ravel()
        solution, _ = cg(self.normal, right, rtol=3e-3, maxiter=60)
        solution = solution / self.scale
        count = len(self.scale) - 2 * len(self.pairs)
        real, imaginary = np.split(solution[count:], 2)
        return solution[:count], real + 1j * imaginary


def spreads(fibrelets: Fibrelets, masks: np.ndarray, pixel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """What becomes of a mode in each image: its field (image, y, x) around the frame's corner, in a camera pixel's
    units, and its radius (image,), metres: root of twice the mean squared distance, as 1/e of a Gaussian's field."""
    shape, w = masks.shape[-2:], float(np.median(fibrelets.mode_radius))
    y, x = (np.fft.fftfreq(s, 1 / s) * pixel_size for s in shape)
    squared = y[:, None] ** 2 + x**2
    mode = np.sqrt(2 / np.pi) * pixel_size / w * np.exp(-squared / w**2)
    fields = np.fft.ifft2(np.fft.fft2(mode) * masks)
    power = np.abs(fields) ** 2
    # far away only rounding and wrapped light is left
    near = np.where(power > 1e-6 * power.max(axis=(1, 2), keepdims=True), power, 0)
    return fields, np.sqrt(2 * (near * squared).sum((1, 2)) / near.sum((1, 2)))


def make_neighbours(
    fibrelets: Fibrelets, views: Views, fields: np.ndarray, radii: np.ndarray, fine: float
) -> Neighbours | None:
    """The equations, or None where no defocused image is local enough. ``fields``, ``radii``: of :func:`spreads`, on
    the camera's pixels of size ``fine``."""
    tree = scipy.spatial.cKDTree(fibrelets.centres)
    pitch = lattice_pitch(fibrelets.centres)
    order = np.argsort(radii)
    planes = order[radii[order] <= 0.6 * pitch]
    # one image in focus has no phases in it, two have them with one sign or the other
    if len(planes) < 3:
        planes = order[:3]
    reach = float(np.sqrt(-2 * np.log(FAINT)) * radii[planes].max())
    pairs = tree.query_pairs(reach, output_type="ndarray")
    blind = np.all(radii[planes] < 1.02 * radii.min())
    if len(planes) < 2 or blind or len(pairs) > PAIRS * len(fibrelets.centres):
        return None
    planes = np.sort(planes)
    rows = [_equations(tree, pairs, views, fields[i], float(radii[i]), fine) for i in planes]
    design = scipy.sparse.vstack(rows).tocsc()
    scale = np.sqrt(np.maximum(np.asarray(design.power(2).sum(axis=0)).ravel(), 1e-30))
    design = scipy.sparse.csr_array((design @ scipy.sparse.diags_array(1 / scale)).T).astype(np.float32)
    # columns have length 1: a small multiple of the unit matrix holds what no pixel sees
    normal = design @ design.T + RIDGE * scipy.sparse.eye_array(design.shape[0], dtype=np.float32)
    return Neighbours(planes, pairs, design, scipy.sparse.csr_array(normal), scale)


def _equations(
    tree: scipy.spatial.cKDTree, pairs: np.ndarray, views: Views, field: np.ndarray, radius: float, fine: float
) -> scipy.sparse.csc_array:
    """Rows of one image: its pixels times powers and products."""
    centres, shape = np.asarray(tree.data), views.masks.shape[-2:]
    middle = [(s - 1) / 2 * views.pixel_size for s in shape]
    reach = int(np.ceil(EDGE * radius / views.pixel_size))
    offset = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach
    place = np.rint((centres + middle) / views.pixel_size).astype(int)[:, None] + offset
    away = place * views.pixel_size - middle - centres[:, None]
    use = ((place >= 0) & (place < shape)).all(-1) & ((away**2).sum(-1) <= (EDGE * radius) ** 2)
    core = np.broadcast_to(np.arange(len(centres))[:, None], use.shape)[use]
    at = (away[use] / fine).T
    values = _interpolate(field, at)
    row = np.ravel_multi_index(tuple(place[use].T), shape)
    modes = scipy.sparse.csc_array((values, (row, core)), shape=(shape[0] * shape[1], len(centres)))
    product = modes[:, pairs[:, 0]].multiply(modes[:, pairs[:, 1]].conj()).tocsc()
    power = modes.multiply(modes.conj()).real
    return scipy.sparse.hstack([power, 2 * product.real, -2 * product.imag], format="csc").astype(np.float32)


def _interpolate(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Complex values of a field around its corner at places (2, n) in pixels, by cubic splines."""
    half = int(np.ceil(np.abs(at).max())) + 8
    half = min(half, *((s - 1) // 2 for s in field.shape))
    window = np.roll(field, (half, half), (0, 1))[: 2 * half + 1, : 2 * half + 1]
    parts = [scipy.ndimage.map_coordinates(part, at + half, order=3, mode="nearest")
             for part in (window.real, window.imag)]  # fmt: skip
    return parts[0] + 1j * parts[1]


def synchronise(pairs: np.ndarray, powers: np.ndarray, products: np.ndarray, rounds: int = 1) -> np.ndarray:
    r"""Amplitudes (m,) from powers (m,) and products (p,) :math:`c_k c_l^*` of pairs (p, 2).

    Phases are carried along the tree of the strongest products, then differences of all pairs are fitted by least
    squares, weighted by the products' squares, those that contradict their neighbours less. Where no light leads from
    one part of the facet to another, nothing is known of the phase between them.
    """
    count, strength, angle = len(powers), np.abs(products), np.angle(products)
    i, j = pairs.T
    phase, above = np.zeros(count), np.arange(count)
    cost = 1 / np.maximum(strength, 1e-9 * strength.max() + 1e-300)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_array((cost, (i, j)), shape=(count, count)))
    number = scipy.sparse.csr_array((np.arange(1, len(i) + 1), (i, j)), shape=(count, count))
    _, part = scipy.sparse.csgraph.connected_components(tree, directed=False)
    for root in (np.flatnonzero(part == p)[np.argmax(powers[part == p])] for p in range(part.max() + 1)):
        order, parent = scipy.sparse.csgraph.breadth_first_order(tree, root, directed=False)
        child = order[1:]
        mother = parent[child]
        forward = np.asarray(number[child, mother]).ravel()
        backward = np.asarray(number[mother, child]).ravel()
        phase[child] = np.where(forward > 0, angle[forward - 1], -angle[backward - 1])
        above[child], above[root] = mother, root
    # every node adds what its ancestor has, which then stands for twice as many steps up the tree
    while np.any(above != above[above]):
        phase, above = phase + np.where(above == np.arange(count), 0, phase[above]), above[above]
    diagonal = np.arange(count)
    for _ in range(rounds):
        left = np.angle(np.exp(1j * (angle - phase[i] + phase[j])))
        weight = strength**2 * np.cos(left / 2) ** 4
        weight = weight + 1e-9 * weight.mean()
        total = np.bincount(i, weight, count) + np.bincount(j, weight, count)
        laplacian = scipy.sparse.csc_array(
            (np.r_[-weight, -weight, total * (1 + 1e-9)], (np.r_[i, j, diagonal], np.r_[j, i, diagonal]))
        )
        pull = np.bincount(i, weight * left, count) - np.bincount(j, weight * left, count)
        phase = phase + splu(
            laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve(pull)
    return np.sqrt(np.maximum(powers, 0)) * np.exp(1j * phase)
