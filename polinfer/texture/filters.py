"""Sliding-window filters of one image."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi
from typing import Any

import numpy as np

from ..checks import boolean_array, integer, one_of_types, real_array
from ..neighbours import plane
from ..priors import AxialVonMises, Prior, TruncatedNormal, VonMises
from ..storage import array
from .angles import Angle, Rescaled
from .base import Distribution, Wanted
from .bounded import Bounded
from .joint import Joint, MultivariateVonMises
from .moments import joint_windows
from .windows import Sweep, sweep

__all__ = ["FAMILIES", "Texture", "describe", "distribution_of", "entropy", "expectation"]

#: The distribution that each class of densities stands for.
FAMILIES: dict[type[Prior], Distribution] = {
    VonMises: Angle(2 * pi),
    AxialVonMises: Angle(pi),
    TruncatedNormal: Bounded(-1.0, 1.0),
}


@dataclass(frozen=True, eq=False)
class Texture:
    """What :func:`describe` found in the window around each pixel, shape P. NaN where the window has too few pixels.

    Attributes
    ----------
    expectation: mean of the fitted distribution, in the unit of the image.
    entropy: its differential entropy, nats; that of the tissue alone where the noise was given.
    noise_entropy: entropy of the noise in the window, nats; None where no noise was given.
    count: pixels in the window; where noise was given for angles, the number without noise that they are worth.
    size: side of the window, pixels. distribution: what was fitted.
    """

    expectation: np.ndarray = array(("*P",), "unit of the image")
    entropy: np.ndarray = array(("*P",), "nat")
    noise_entropy: np.ndarray | None = array(("*P",), "nat")
    count: np.ndarray = array(("*P",), "1")
    size: int = 15
    distribution: Distribution = FAMILIES[VonMises]


def distribution_of(name: str, distribution: Any) -> Distribution:
    """The distribution that an argument names: a :class:`Distribution`, or a class of densities in ``FAMILIES``."""
    if isinstance(distribution, Distribution):
        return distribution
    if isinstance(distribution, type) and distribution in FAMILIES:
        return FAMILIES[distribution]
    known = ", ".join(x.__name__ for x in FAMILIES)
    raise TypeError(
        f"{name} must be one of the classes {known}, or an object such as Chi(1), Bounded(low, high), Angle(period) or "
        f"Rescaled(centre, scale), got {distribution!r}."
    )


class _Frame(Sweep):
    """One frame: its pixels, and the maps that are filled."""

    def __init__(
        self,
        values: np.ndarray,
        noise: np.ndarray | None,
        used: np.ndarray | None,
        distribution: Distribution,
        fewest: int,
        maps: dict[str, np.ndarray],
    ) -> None:
        self.values, self.noise, self.used = values, noise, used
        self.distribution, self.fewest, self.maps = distribution, fewest, maps
        self.features = distribution.features(noise is not None)
        self.single = values.dtype == np.float32 and distribution.single and noise is None
        self.again: list[slice] = []

    def run(self, size: int) -> None:
        """Fill the maps."""
        shape = self.values.shape
        if self.single:
            sweep(self, shape, size, np.dtype(np.float32))
            self.single = False
            if self.again:
                sweep(self, shape, size, np.dtype(np.float64), self.again)
        else:
            sweep(self, shape, size, np.dtype(np.float64))

    def load(self, rows: slice, out: np.ndarray) -> None:
        values = self.values[rows]
        noise = None if self.noise is None else self.noise[rows]
        used = np.isfinite(values)
        if self.used is not None:
            used &= self.used[rows]
        if noise is not None:
            used &= np.isfinite(noise)
            noise = np.where(used, noise, 0).astype(out.dtype, copy=False)
        values = np.where(used, values, 0).astype(out.dtype, copy=False)
        self.distribution.load(values, noise, used, out)

    def finish(self, rows: slice, sums: np.ndarray, spare: np.ndarray) -> None:
        high, wide = rows.stop - rows.start, self.values.shape[1]
        wanted = Wanted("expectation" in self.maps, "entropy" in self.maps)
        found = self.distribution.finish(sums, spare, self.noise is not None, wanted)
        few = found.count.reshape(high, -1)[:, :wide] < self.fewest
        for name, target in self.maps.items():
            target[rows] = getattr(found, name).reshape(high, -1)[:, :wide]
            if name != "count":
                target[rows][few] = np.nan
        if self.single and wanted.entropy and np.any(self.maps["entropy"][rows] < self.distribution.single_floor):
            self.again.append(rows)


def _filtered(
    names: tuple[str, ...], image: Any, size: int, distribution: Any, mask: Any, std: Any, fewest: int
) -> dict[str, np.ndarray]:
    """The maps of these names, after a check of the arguments."""
    values = real_array("image", image)
    family = distribution_of("distribution", distribution)
    size = checked_size(size)
    fewest = integer("fewest", fewest, low=3)
    used = None if mask is None else broadcast_to("mask", boolean_array("mask", mask), values.shape)
    noise = None if std is None else broadcast_to("std", real_array("std", std, low=0), values.shape)
    family.check("image", values if used is None else np.where(used, values, np.nan))
    kept = values.dtype if values.dtype in (np.float32, np.float64) else np.dtype(np.float64)
    if noise is not None:
        names = (*names, "noise_entropy") if "count" in names else names
    maps = {name: np.empty(values.shape, kept) for name in names}
    for frame in range(int(np.prod(values.shape[:-2]))):
        one = [None if x is None else _frame(x, frame) for x in (values, noise, used)]
        _Frame(*one, family, fewest, {name: _frame(x, frame) for name, x in maps.items()}).run(size)  # type: ignore[arg-type]
    return maps


def _frame(values: np.ndarray, number: int) -> np.ndarray:
    """One of the frames that stand in the leading axes, a view."""
    rows, columns = plane(values.shape)
    return values.reshape(-1, rows, columns)[number]


def checked_size(size: int) -> int:
    """Side of a window: odd, from 3."""
    size = integer("size", size, low=3)
    if size % 2 == 0:
        raise ValueError(f"size must be odd, so that the window has a centre, got {size}.")
    return size


def broadcast_to(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """``values`` with the shape of the image, or an error."""
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {values.shape}, which does not fit the image, {shape}.") from None


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
    maps = _filtered(("expectation", "entropy", "count"), image, size, family, mask, std, fewest)
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
    return _filtered(("expectation",), image, size, distribution, mask, std, fewest)["expectation"]


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
    determine the fit; minus infinity where the pixels lie on a line, two images being equal, for instance.

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
        kept = _filtered(("entropy",), images, size, distribution, mask, std, fewest)["entropy"]
        return kept[(..., *(slice(None, None, stride),) * min(kept.ndim, 2))]
    one_of_types("joint", joint, (Joint,), "pass MultivariateVonMises() or TorusGraph().")
    values = [real_array(f"images[{i}]", x) for i, x in enumerate(images)]
    if not values:
        raise ValueError("images is an empty list; pass at least one image.")
    if len({x.shape for x in values}) > 1:
        raise ValueError(f"images must have one shape, got {', '.join(str(x.shape) for x in values)}.")
    families = [distribution_of("distribution", x) for x in _each("distribution", distribution, len(values))]
    widths = [None if x is None else real_array("std", x, low=0) for x in _each("std", std, len(values))]
    if len(values) == 1:
        return entropy(values[0], size, families[0], mask, widths[0], fewest, stride)
    size, fewest = checked_size(size), integer("fewest", fewest, low=3)
    shape = values[0].shape
    used = np.ones(shape, bool) if mask is None else broadcast_to("mask", boolean_array("mask", mask), shape).copy()
    for x in values:
        used &= np.isfinite(x)
    angles, noise, jacobian = [], [], 0.0
    for i, (x, family, width) in enumerate(zip(values, families, widths, strict=True)):
        family.check(f"images[{i}]", np.where(used, x, np.nan))
        centre = family.centre if isinstance(family, Rescaled) else 0.0
        angle = family.angle if isinstance(family, Rescaled) else family
        if not isinstance(angle, Angle):
            raise TypeError(f"distribution of images[{i}] is {family!r}: joint distributions are of angles; pass "
                            "Rescaled(centre, scale) for what is none.")  # fmt: skip
        s = np.zeros(shape) if width is None else broadcast_to("std", width, shape)
        used &= np.isfinite(s)
        angles.append(angle.frequency * (x.astype(float) - centre))
        noise.append(angle.frequency * s)
        jacobian -= log(angle.frequency)
    planes = (-1, *plane(shape))
    found = joint_windows(
        [x.reshape(planes) for x in angles],
        None if all(w is None for w in widths) else [x.reshape(planes) for x in noise],
        used.reshape(planes), size, joint, max(fewest, joint.degrees(len(values)) + 1), stride,
    )  # fmt: skip
    single = all(x.dtype == np.float32 for x in values)
    return (found + jacobian).reshape(_strided(shape, stride)).astype(np.float32 if single else float)


def _each(name: str, given: Any, number: int) -> list[Any]:
    """One for each image: those of a list, or the same for all."""
    if not isinstance(given, list | tuple):
        return [given] * number
    if len(given) != number:
        raise ValueError(f"{name} is a list of {len(given)} for {number} images; pass one for each, or one for all.")
    return list(given)


def _strided(shape: tuple[int, ...], stride: int) -> tuple[int, ...]:
    return (*shape[:-2], *(-(-n // stride) for n in shape[-2:]))


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
    families, widths = _each("distribution", distribution, len(first)), _each("std", std, len(first))
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
