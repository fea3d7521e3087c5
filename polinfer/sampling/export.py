"""Draws in the form that ArviZ takes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from .draws import Draws

__all__ = ["groups", "to_arviz"]


def groups(draws: Draws) -> dict[str, Any]:
    """Datasets by the name of their group."""
    dataset = draws.to_dataset()
    names = {f"parameters.{name}": name for name in draws.model.free}
    names |= {"gain.real": "gain_real", "gain.imag": "gain_imag", "sigma": "sigma"}
    # a dot in a name would be the path of a group
    posterior = dataset[[name for name in names if name in dataset]].rename(
        {name: new for name, new in names.items() if name in dataset}
    )
    posterior.attrs = {"inference_library": "polinfer", "convention": dataset.attrs["convention"]}
    if draws.log_evidence.size == 1:
        posterior.attrs["log_evidence"] = float(np.reshape(draws.log_evidence, ()))
    data = {"measurement.response.real": "response_real", "measurement.response.imag": "response_imag"}
    observed = dataset[list(data)].rename(data)
    observed.attrs = {"convention": dataset.attrs["convention"]}
    return {"posterior": posterior, "observed_data": observed}


def to_arviz(draws: Draws) -> Any:
    """An ``arviz.InferenceData`` (ArviZ before version 1) or an :class:`xarray.DataTree`; see ``Draws.to_arviz``.

    Raises
    ------
    ImportError: ArviZ is not installed.
    """
    try:
        import arviz
    except ImportError as error:
        raise ImportError("to_arviz needs ArviZ, which is not installed: pip install 'polinfer[arviz]'.") from error
    found = groups(draws)
    # version 1 answers for the old name, too, with something else
    if int(arviz.__version__.split(".")[0]) < 1:
        return arviz.InferenceData(**found)
    import xarray

    return xarray.DataTree.from_dict(found)
