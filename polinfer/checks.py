"""Checks of arguments at the border of the packages.

Every function names the argument, says what came and what to do, in one line. They return plain NumPy arrays,
so the code behind them need not look again. A number without an answer inside an array (NaN) is not an error
here unless ``finite`` asks for it: what a NaN means is for the caller to say.
"""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["as_generator", "broadcast", "complex_array", "integer", "one_of_types", "real_array", "real_number"]


def _array(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype == object or array.dtype.kind not in "biufc":
        raise TypeError(f"{name} must be an array of numbers, got {_came(value)}; pass a NumPy or JAX array.")
    return array


def _came(value: Any) -> str:
    """Describe a value shortly, for an error message."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{type(value).__name__} of shape {tuple(value.shape)} and type {value.dtype}"
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) < 60 else text[:57] + '...'}"


def _shape_matches(shape: tuple[int, ...], trailing: tuple[int | None, ...], exact: bool) -> bool:
    if len(shape) < len(trailing) or (exact and len(shape) != len(trailing)):
        return False
    tail = shape[len(shape) - len(trailing) :]
    return all(want is None or have == want for have, want in zip(tail, trailing, strict=True))


def _check(
    name: str,
    array: np.ndarray,
    trailing: tuple[int | None, ...] | None,
    shape: tuple[int | None, ...] | None,
    finite: bool,
) -> None:
    for wanted, exact, lead in ((trailing, False, "..., "), (shape, True, "")):
        if wanted is not None and not _shape_matches(array.shape, wanted, exact):
            text = ", ".join("any" if n is None else str(n) for n in wanted)
            raise ValueError(f"{name} must have shape ({lead}{text}), got {array.shape}; reshape or transpose it.")
    if finite and not np.all(np.isfinite(array)):
        bad = int(np.size(array) - np.count_nonzero(np.isfinite(array)))
        raise ValueError(f"{name} must be finite, got {bad} values that are NaN or infinite; mask or mend them first.")


def real_array(
    name: str,
    value: Any,
    *,
    trailing: tuple[int | None, ...] | None = None,
    shape: tuple[int | None, ...] | None = None,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    finite: bool = False,
) -> np.ndarray:
    """A real array; float types are kept, integers become float64.

    ``trailing`` fixes the last axes and ``shape`` all of them (None = any length); ``low`` and ``high`` are
    inclusive bounds, ``above`` an exclusive lower one (NaN passes the bounds: use ``finite``).

    >>> real_array("sigma", [1, 2], above=0)
    array([1., 2.])
    >>> real_array("sigma", [1.0, -2.0], above=0)
    Traceback (most recent call last):
    ...
    ValueError: sigma must be > 0, got -2.0; mend the values.
    """
    array = _array(name, value)
    if array.dtype.kind == "c":
        raise TypeError(f"{name} must be real, got {array.dtype}; take .real or abs() of it, whichever is meant.")
    if array.dtype.kind != "f":
        array = array.astype(np.float64)
    _check(name, array, trailing, shape, finite)
    with np.errstate(invalid="ignore"):
        if low is not None and np.any(array < low):
            raise ValueError(f"{name} must be >= {low:g}, got {float(np.nanmin(array))}; mend the values.")
        if above is not None and np.any(array <= above):
            raise ValueError(f"{name} must be > {above:g}, got {float(np.nanmin(array))}; mend the values.")
        if high is not None and np.any(array > high):
            raise ValueError(f"{name} must be <= {high:g}, got {float(np.nanmax(array))}; mend the values.")
    return array


def complex_array(
    name: str,
    value: Any,
    *,
    trailing: tuple[int | None, ...] | None = None,
    shape: tuple[int | None, ...] | None = None,
    finite: bool = False,
) -> np.ndarray:
    """A complex array; complex64 is kept, float32 becomes complex64, all else complex128.

    >>> complex_array("jones", [[1, 0], [0, 1]], trailing=(2, 2)).dtype
    dtype('complex128')
    """
    array = _array(name, value)
    if array.dtype.kind != "c":
        array = array.astype(np.complex64 if array.dtype == np.float32 else np.complex128)
    _check(name, array, trailing, shape, finite)
    return array


def boolean_array(name: str, value: Any) -> np.ndarray:
    """A bool array; anything else (also 0 and 1) is refused, so that an index list is never read as a mask."""
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise TypeError(f"{name} must be a bool array, got {_came(value)}; write `{name} != 0` if that is meant.")
    return array


def real_number(
    name: str, value: Any, *, low: float | None = None, high: float | None = None, above: float | None = None
) -> float:
    """One finite real number.

    >>> real_number("scale", 2, above=0)
    2.0
    """
    array = real_array(name, value, low=low, high=high, above=above, finite=True)
    if array.shape != ():
        raise ValueError(f"{name} must be one number, got shape {array.shape}; pass a float.")
    return float(array)


def integer(name: str, value: Any, *, low: int | None = None, high: int | None = None) -> int:
    """One integer (a bool or a float is refused)."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be an integer, got {_came(value)}; pass an int.")
    if (low is not None and value < low) or (high is not None and value > high):
        limits = f">= {low}" if high is None else f"<= {high}" if low is None else f"from {low} to {high}"
        raise ValueError(f"{name} must be {limits}, got {value}.")
    return int(value)


def one_of_types(name: str, value: Any, types: tuple[type, ...], advice: str) -> None:
    """Raise TypeError unless ``value`` is an instance of one of ``types``."""
    if not isinstance(value, types):
        names = " or ".join(t.__name__ for t in types)
        raise TypeError(f"{name} must be {names}, got {_came(value)}; {advice}")


def broadcast(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """The common shape of the named shapes, or an error that names the one that does not fit.

    >>> broadcast(response=(3, 4), sigma=(4,))
    (3, 4)
    >>> broadcast(response=(3, 4), sigma=(3,))
    Traceback (most recent call last):
    ...
    ValueError: sigma has pixel shape (3,), which does not broadcast with response (3, 4); make them agree.
    """
    common: tuple[int, ...] = ()
    seen: list[str] = []
    for name, shape in shapes.items():
        try:
            common = np.broadcast_shapes(common, shape)
        except ValueError:
            raise ValueError(
                f"{name} has pixel shape {shape}, which does not broadcast with {', '.join(seen)} {common}; "
                "make them agree."
            ) from None
        seen.append(name)
    return common


def as_generator(rng: int | np.random.Generator | None) -> tuple[np.random.Generator, int | None]:
    """A NumPy generator and the seed to record.

    ``None`` draws a fresh seed from the operating system and returns it, so that every result can be repeated; an
    ``int`` is the seed; a ``Generator`` is used as it is and its seed is not known (None).

    >>> as_generator(7)[1]
    7
    """
    if rng is None:
        seed = int(np.random.SeedSequence().entropy % (1 << 63))  # type: ignore[operator]
        return np.random.default_rng(seed), seed
    if isinstance(rng, np.random.Generator):
        return rng, None
    return np.random.default_rng(integer("rng", rng, low=0)), int(rng)
