"""What the fast route must know of a model, decided once, outside compiled code."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from math import asin, cos, pi, sin

import jax

from ...model import Model
from ...orderings import PolariserFirst, RetarderFirst
from ...records import Parameters
from ..local_gaussian import distinct_copies
from .known import Known
from .likelihoods import Likelihood, likelihood
from .priors import FACTORS, Term, copies, terms

__all__ = ["Outline", "Scene", "scene"]

BOUNDS = {"diattenuation": (-1.0, 1.0), "retardance": (-pi, pi)}


@dataclass(frozen=True)
class Outline:
    """Of a scene what the description of a maximum depends on: the fields as there, neither ordering nor likelihood."""

    prior: tuple[Term | None, ...]
    free: tuple[int, ...]
    values: tuple[float | None, ...]
    copies: tuple[bool, ...]
    groups: tuple[tuple[tuple[Term | None, ...], int], ...]
    bounded: bool


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["likelihood"],
    meta_fields=["retarder_first", "prior", "constant", "free", "fixed", "values", "copies", "groups", "bounded"],
)
@dataclass(frozen=True)
class Scene:
    """A model in the form in which the fast route evaluates it.

    ``free`` are the angles that move; ``fixed`` the (cosine, sine) of the others, known while tracing; ``values`` the
    fixed values to report (0 for parameters that drop out). ``copies`` are which of the eight equivalent sets the model
    tells apart, ``groups`` their distinct priors as functions of the point, with the number of copies that share each;
    the first is that of the point itself. ``bounded`` says that the retardance ends at -pi and pi. Code is compiled for
    all but the numbers of the likelihood, which are its arguments.
    """

    retarder_first: bool
    likelihood: Likelihood
    prior: tuple[Term | None, ...]
    constant: float
    free: tuple[int, ...]
    fixed: tuple[tuple[Known, Known] | None, ...]
    values: tuple[float | None, ...]
    copies: tuple[bool, ...]
    groups: tuple[tuple[tuple[Term | None, ...], int], ...]
    bounded: bool

    @cached_property
    def outline(self) -> Outline:
        """See :class:`Outline`."""
        return Outline(self.prior, self.free, self.values, self.copies, self.groups, self.bounded)


@lru_cache(maxsize=256)
def scene(model: Model) -> Scene | None:
    """The scene of a model, or None if a part of it has no fast form: then the general route takes it."""
    kind, prior = likelihood(model), terms(model)
    shipped = type(model.ordering) in (RetarderFirst, PolariserFirst)
    bounds = all(BOUNDS.get(name) == pair for name, pair in model.bounds.items())
    # of a retarder of which only some parameters are known the closed form is too poor a start
    retarder = {"retardance", "retardance_angle", "circularity"} & set(model.fixed)
    partly = bool(retarder) and model.fixed.get("retardance") != 0
    if kind is None or prior is None or not shipped or not bounds or not model.free or partly:
        return None
    rows = distinct_copies(model)
    counts: dict[tuple[Term | None, ...], int] = {prior: 0}
    for one in copies(prior, rows):
        counts[one] = counts.get(one, 0) + 1
    fixed: list[tuple[Known, Known] | None] = []
    values: list[float | None] = []
    for name, factor in zip(Parameters._fields, FACTORS, strict=True):
        if name in model.free:
            fixed.append(None)
            values.append(None)
            continue
        value = model.fixed.get(name, 0.0)
        angle = 0.5 * asin(value) if name == "diattenuation" else factor * value
        fixed.append((Known(cos(angle)), Known(sin(angle))))
        values.append(value)
    return Scene(
        retarder_first=type(model.ordering) is RetarderFirst,
        likelihood=kind,
        prior=prior,
        constant=sum(t.constant for t in prior if t is not None),
        free=tuple(i for i, name in enumerate(Parameters._fields) if name in model.free),
        fixed=tuple(fixed),
        values=tuple(values),
        copies=tuple(bool(row) for row in rows),
        groups=tuple(counts.items()),
        bounded="retardance" in model.bounds,
    )
