"""The verbs: expectation and entropy of images, one or several, in a sliding window."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import boolean_array, integer, one_of_types, real_array
from ..neighbours import plane
from ..priors import VonMises
from .families import distribution_of
from .frames import broadcast_to, filtered
from .joint import Joint, MultivariateVonMises
from .joint_frames import each_of, joint_filtered
from .records import Texture

__all__ = ["cooccurrence_entropy", "describe", "entropy", "expectation"]


def describe(
    image: Any,
    size: int = 15,
    distribution: Any = VonMises,
    mask: Any | None = None,
    std: Any | None = None,
    fewest: int = 5,
) -> Texture:
    r"""Expectation and entropy of the distribution that fits the pixels around each pixel.

    In a window of ``size`` x ``size`` pixels, cut off at the edges of the frame, the pixels that are finite and not
    masked are taken for independent draws of one distribution. Its most probable member is found from sums over the
    window, so that the cost hardly depends on ``size``; expectation and entropy are corrected for the bias of few
    pixels. Neighbours that are alike, as in smooth maps, are fewer independent draws than there are pixels: the
    correction is then too small, by about half the number of parameters over the number of independent pixels.

    Parameters
    ----------
    image: float ``(*frames, y, x)``, angles in radians; a single axis is a row. float32 stays float32.
    size: side of the window in pixels, odd, >= 3.
    distribution: what is fitted. ``VonMises``: angles with period 2 pi. ``AxialVonMises``: with period pi.
        ``TruncatedNormal``: values in [-1, 1], such as D. Or an object: :class:`Angle`, :class:`Chi` for amplitudes,
        :class:`Bounded`, :class:`Rescaled`.
    mask: bool, broadcasts to the image: True = use.
    std: float >= 0, broadcasts to the image, in its unit: standard deviation of each pixel's own noise, for instance
        the width of its posterior. The entropy is then that of what is left without it, so that noise is not read as
        disorder; minus infinity where noise alone explains the dispersion. NaN: leave the pixel out.
    fewest: least number of pixels for an answer, >= 3; where noise makes angles worth less than a pixel each, the
        number that they are worth.

    Returns
    -------
    Texture: ``expectation``, ``entropy``, ``noise_entropy`` (with ``std``), ``count``, each of the shape of the image.

    Raises
    ------
    ValueError, TypeError: shapes, sizes, values outside the distribution's range.

    Notes
    -----
    An entropy may exceed that of the uniform distribution a little: cut off there, it would be biased. float32 sums are
    exact enough up to a concentration of 500; strips of the frame with more are summed in float64, which has no limit
    up to about 1e10. A window of equal pixels has the entropy minus infinity, or what rounding makes of it.

    >>> angles = np.random.default_rng(1).vonmises(0.5, 4.0, (40, 40))
    >>> found = describe(angles, size=15)
    >>> round(float(found.expectation[20, 20]), 1), float(found.count[20, 20]), float(found.count[0, 0])
    (0.5, 225.0, 64.0)
    >>> bool(abs(found.entropy[20, 20] - 0.83) < 0.15)                    # the truth is 0.83
    True
    """
    family = distribution_of("distribution", distribution)
    maps = filtered(("expectation", "entropy", "count"), image, size, family, mask, std, fewest)
    return Texture(maps["expectation"], maps["entropy"], maps.get("noise_entropy"), maps["count"], int(size), family)


def expectation(
    image: Any,
    size: int = 15,
    distribution: Any = VonMises,
    mask: Any | None = None,
    std: Any | None = None,
    fewest: int = 5,
) -> np.ndarray:
    """Mean of the distribution that fits the pixels around each pixel: :func:`describe`, which has the arguments.

    For angles it is the mean direction, within half a period of 0; with ``std`` noisy pixels count less. For amplitudes
    it is the mean of the fitted chi distribution, for values between bounds that of the pixels.

    >>> expectation(np.full((3, 3), np.pi), size=3, fewest=4)[1].tolist() == [np.pi] * 3       # no jump at the wrap
    True
    """
    return filtered(("expectation",), image, size, distribution, mask, std, fewest)["expectation"]


def entropy(
    images: Any,
    size: int = 15,
    distribution: Any = VonMises,
    mask: Any | None = None,
    std: Any | None = None,
    fewest: int = 5,
    stride: int = 1,
    joint: Joint = MultivariateVonMises(),  # noqa: B008
) -> np.ndarray:
    r"""Differential entropy of the distribution that fits the pixels around each pixel, in nats.

    One image: as :func:`describe`. Several: the entropy of their joint distribution, fitted by score matching in closed
    form. Independent images have the sum of their entropies, and what they know of each other is missing from it. All
    of them must be angles, or amplitudes and the like in the disguise of :class:`Rescaled`.

    Parameters
    ----------
    images: an array, or a list of arrays of one shape.
    size, mask, fewest: as for :func:`describe`. The windows of d images need more pixels than fitted parameters.
    distribution, std: one for all images, or a list with one for each.
    stride: only every so many rows and columns, for joint distributions take their time: about 5 microseconds a window
        for two images, 200 for three.
    joint: what is fitted to several images, :class:`MultivariateVonMises` or :class:`TorusGraph`.

    Returns
    -------
    shape of an image, every ``stride``-th row and column. NaN where the window has too few pixels or the data do not
    determine the fit; minus infinity where an image is constant, or noise explains all of its dispersion.

    Raises
    ------
    ValueError, TypeError: shapes, sizes, values outside the distribution's range, a joint distribution of others than
    angles.

    >>> rng = np.random.default_rng(1)
    >>> one = rng.vonmises(0, 5, (31, 31))
    >>> other = one + rng.vonmises(0, 5, (31, 31))
    >>> apart = entropy(one, 31)[15, 15] + entropy(other, 31)[15, 15]
    >>> bool(apart - entropy([one, other], 31)[15, 15] > 0.25)            # half a bit of common information
    True
    """
    stride = integer("stride", stride, low=1)
    if not isinstance(images, list | tuple):
        kept = filtered(("entropy",), images, size, distribution, mask, std, fewest)["entropy"]
        return kept[..., ::stride, ::stride] if kept.ndim > 1 else kept[..., ::stride]
    one_of_types("joint", joint, (Joint,), "pass MultivariateVonMises() or TorusGraph().")
    values = [real_array(f"images[{i}]", x) for i, x in enumerate(images)]
    families = [distribution_of("distribution", x) for x in each_of("distribution", distribution, len(values))]
    widths = each_of("std", std, len(values))
    if len(values) == 1:
        return entropy(values[0], size, families[0], mask, widths[0], fewest, stride)
    return joint_filtered(values, size, families, mask, widths, fewest, stride, joint)


def cooccurrence_entropy(
    images: Any,
    size: int = 15,
    distribution: Any = VonMises,
    mask: Any | None = None,
    std: Any | None = None,
    fewest: int = 5,
    stride: int = 1,
    joint: Joint = MultivariateVonMises(),  # noqa: B008
    offset: tuple[int, int] = (0, 4),
) -> np.ndarray:
    """Entropy of the joint distribution of pixels and of those that are ``offset`` (rows, columns) away, in nats.

    The window holds the first pixel of each pair; pairs of which one is masked, not finite or outside the frame are
    left out. Arguments as for :func:`entropy`; P images give a distribution of 2 P values. It is twice the entropy of
    one image where such pixels are independent, and less where they know of each other.

    Raises
    ------
    ValueError, TypeError: as for :func:`entropy`; an offset of (0, 0).

    >>> angles = np.random.default_rng(1).vonmises(0.5, 4.0, (24, 24))
    >>> twice = 2 * entropy(angles, 21)[12, 10]
    >>> bool(abs(cooccurrence_entropy(angles, 21, offset=(0, 4))[12, 10] - twice) < 0.15)
    True
    """
    rows, columns = (integer("offset", n) for n in offset)
    if (rows, columns) == (0, 0):
        raise ValueError("offset must not be (0, 0): a pixel is no pair with itself.")
    first = list(images) if isinstance(images, list | tuple) else [images]
    first = [real_array(f"images[{i}]", x) for i, x in enumerate(first)]
    families, widths = each_of("distribution", distribution, len(first)), each_of("std", std, len(first))
    if mask is not None:
        inside = boolean_array("mask", mask)
        first = [np.where(broadcast_to("mask", inside, x.shape), x, np.nan) for x in first]
    second = [_moved(x, rows, columns) for x in first]
    spread = None
    if any(x is not None for x in widths):
        own = [
            np.broadcast_to(np.asarray(0.0 if w is None else w, float), x.shape)
            for w, x in zip(widths, first, strict=True)
        ]
        # where there is no partner the image says so
        spread = own + [np.nan_to_num(_moved(x, rows, columns)) for x in own]
    return entropy(first + second, size, families * 2, None, spread, fewest, stride, joint)


def _moved(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The image whose pixel (y, x) is that of (y + rows, x + columns); NaN outside."""
    high, wide = plane(values.shape)
    frame = values.reshape(-1, high, wide)
    moved = np.full(frame.shape, np.nan, values.dtype)
    if abs(rows) < high and abs(columns) < wide:
        there = (slice(None), slice(max(rows, 0), high + min(rows, 0)), slice(max(columns, 0), wide + min(columns, 0)))
        here = (slice(None), slice(max(-rows, 0), high - max(rows, 0)), slice(max(-columns, 0), wide - max(columns, 0)))
        moved[here] = frame[there]
    return moved.reshape(values.shape)
