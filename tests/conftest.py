"""Settings of every test process, and the bench that all of a run share."""

from __future__ import annotations

import gc
import os
from importlib.metadata import version
from pathlib import Path

import jax
import pytest
from filelock import FileLock
from hypothesis import settings
from threadpoolctl import threadpool_limits

# Compiling dominates the time of a run: the compiler optimises little (a quarter of the time of a run) unless told
# otherwise, but for tests that compute longer than they compile; the processes of a run share what they compile.
OPTIMISED = os.environ.get("POLINFER_TEST_OPTIMISED", "0") != "0"
# XLA's older emitter of fused loops compiles in a third of the time; and the processes of a run have a core each. An
# unknown flag would end the process: named for the versions of JAX that are known to have them, and set before the
# first use of JAX, when XLA reads its flags.
if not OPTIMISED and version("jaxlib").startswith("0.10."):
    FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_multi_thread_eigen=false"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}".strip()
# Traced code is made of a million small objects, and the garbage collector, which looks through all of them again and
# again, took a twelfth of the time.
gc.set_threshold(100_000, 20, 20)
# The library never decides about precision; its tests run in double unless told otherwise.
jax.config.update("jax_enable_x64", os.environ.get("POLINFER_TEST_X64", "1") != "0")
# The tests run in as many processes as there are cores: threads of BLAS beside them only get into each other's way. A
# library that is here already is told so, one that is loaded later, such as SciPy's, and processes of tests read it.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
BLAS = threadpool_limits(1, user_api="blas")
COMPUTES = ("fibre", "test_streaming.py", "test_demo.py", "test_gibbs_steps.py")  # folders and files
jax.config.update("jax_disable_most_optimizations", not OPTIMISED)
CACHE = {
    "jax_compilation_cache_dir": str(Path(__file__).resolve().parents[1] / ".jax_cache"),
    "jax_persistent_cache_min_compile_time_secs": 0.5,  # to store one takes 0.03
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
for setting, value in CACHE.items():
    jax.config.update(setting, value)
# what is compiled here, workers that a test starts need not compile
os.environ |= {setting.upper(): str(value) for setting, value in CACHE.items()}
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not OPTIMISED))

# Random input: some 2,000 examples of the parsers in every run, more than 100,000 with POLINFER_FUZZ=fuzz. A machine
# with other work on it is slow now and then, which is no failure.
settings.register_profile("quick", deadline=None, max_examples=150)
settings.register_profile("fuzz", deadline=None, max_examples=9000)
settings.load_profile(os.environ.get("POLINFER_FUZZ", "quick"))


def pytest_collection_finish():
    gc.collect()
    gc.freeze()


def pytest_sessionfinish():
    # pytest collects five times more, to find errors in what is freed: of millions of objects once is enough
    gc.collect()
    gc.freeze()


def pytest_runtest_setup(item):
    plain = not OPTIMISED and not {item.path.name, item.path.parent.name} & set(COMPUTES)
    jax.config.update("jax_disable_most_optimizations", plain)


def pytest_runtest_teardown():
    # examples in docstrings and documentation are outside of this folder, and come after whatever test
    jax.config.update("jax_disable_most_optimizations", not OPTIMISED)


@pytest.fixture(scope="session")
def bench(tmp_path_factory, request):
    """The small simulated bench, captured and retrieved once for all processes of a run."""
    from tests.fibre.benches import small  # XLA has its flags by now

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if hasattr(request.config, "workerinput") else base
    with FileLock(shared / "bench.lock"):
        return small(shared / "bench")
