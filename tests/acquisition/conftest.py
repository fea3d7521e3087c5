"""Programs that tests start are no tests; fits of small frames take longer to compile than to compute."""

import jax
import pytest

import polinfer
from acquisition import streaming
from tests.conftest import OPTIMISED

collect_ignore_glob = ["peer_*.py"]


@pytest.fixture(scope="module", autouse=True)
def fits_that_compile_quickly():
    """Where retrieval is optimised because it computes for long, the fits after it are not."""
    fit = polinfer.fit

    def quickly(*arguments, **keywords):
        before = jax.config.values["jax_disable_most_optimizations"]
        jax.config.update("jax_disable_most_optimizations", not OPTIMISED)
        try:
            return fit(*arguments, **keywords)
        finally:
            jax.config.update("jax_disable_most_optimizations", before)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(polinfer, "fit", quickly)
        patch.setattr(streaming, "fit", quickly)
        yield
