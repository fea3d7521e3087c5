"""What does an accelerator bring? ``fit``, ``sample`` and phase retrieval where JAX has one, beside the processor.

The same calls with the same arguments in a process of its own for each device, the processor's with JAX told to leave
the accelerator alone. ``call`` is the whole call as a user makes it: arrays on the host go in and come out. ``code`` is
the compiled code alone, its input on the device already. ``floor`` is the time in which the device reads and writes as
many bytes as that input and output have, measured in the same process. A machine without an accelerator shows the
processor only.
"""

from __future__ import annotations

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results, in_fresh_process, median_seconds, seconds
from fibre import Bundle, Defocus, GerchbergSaxton, retrieve
from polinfer import ComplexGain, Gibbs, Model
from polinfer.fitting.fast import kernel
from polinfer.fitting.fast.engine import FIRST
from polinfer.fitting.fast.scene import scene

SIZE, SIGMA, REPEATS = 1 << 20, 0.02, 5
FRAMES = (972, 1 << 16)
SHAPE, PIXEL, SWEEPS, FIELDS = (1200, 1200), 0.12e-6, 20, 2
PLANES = np.linspace(-120e-6, 120e-6, 7)
GAINS = {"unit": None, "complex": ComplexGain(1.0)}
COMPARED = 4000


def bandwidth() -> float:
    """Bytes a second that the default device reads and writes."""
    array = jnp.ones(1 << 27, jnp.float32)
    add = jax.jit(lambda x: x + 1)
    return 2 * array.nbytes / median_seconds(lambda: add(array).block_until_ready(), 9)


def device() -> dict[str, Any]:
    """The default device of this process, and how fast it moves bytes."""
    first = jax.devices()[0]
    name = first.device_kind if first.platform != "cpu" else f"{os.cpu_count()} processor cores"
    return {"device": name, "platform": first.platform, "gigabytes_a_second": bandwidth() / 1e9}


def fits(dtype: str, gain: str, size: int) -> dict[str, Any]:
    """A frame of many pixels; the compiled code of its first pass; some log posteriors, to be compared."""
    model, states = Model(gain=GAINS[gain]), scenes.balanced_states()
    truth = scenes.from_priors(model, size, np.random.default_rng(1))
    data = scenes.measure(Model(), truth, states, SIGMA, dtype)
    first = seconds(lambda: polinfer.fit(model, data))
    call = median_seconds(lambda: polinfer.fit(model, data), REPEATS)
    found = polinfer.fit(model, data)
    real = data.response.real.dtype
    root, rows = (jnp.asarray(x.astype(dtype)) for x in (np.sqrt(1.5) * np.eye(2), states / np.sqrt(1.5)))
    ones = jnp.ones(3, real)
    shared = kernel.Shared(root, rows, ones, jnp.zeros((), real), jnp.asarray(6, real))
    given = (
        jnp.asarray(data.response), jnp.full(1, SIGMA, real), shared, kernel.no_start(size, real), kernel.CLOSED_FORM,
        FIRST, jnp.ones((), real),
    )  # fmt: skip

    def run() -> Any:
        return jax.block_until_ready(kernel.from_responses(scene(model), True, *given))

    code, out = median_seconds(run, REPEATS), run()
    return {
        "first": first, "call": call, "code": code, "bytes": given[0].nbytes + sum(x.nbytes for x in out),
        "values": np.asarray(found.log_posterior, float)[:COMPARED].tolist(),
    }  # fmt: skip


def posteriors(gain: str, size: int) -> dict[str, Any]:
    """A frame of draws, single precision, and its least effective number."""
    model, states = Model(gain=GAINS[gain]), scenes.balanced_states()
    truth = scenes.from_priors(model, size, np.random.default_rng(1))
    data = scenes.measure(Model(), truth, states, 0.1, "complex64")

    def run() -> polinfer.Draws:
        return polinfer.sample(model, data, Gibbs(evidence=False), draws=1000 if size < 5000 else 100, rng=3)

    first, call = seconds(run), median_seconds(run, 3)
    mean = run().summary().mean
    return {"first": first, "call": call, "values": np.abs(mean.diattenuation)[:COMPARED].tolist()}


def retrieval() -> dict[str, Any]:
    """Fields of full size by a fixed number of sweeps."""
    bundle, rng = Bundle.hexagonal(rng=0), np.random.default_rng(3)
    modes = rng.standard_normal((FIELDS, 2, bundle.cores)) + 1j * rng.standard_normal((FIELDS, 2, bundle.cores))
    images = np.abs(bundle.image(modes, SHAPE, PIXEL, PLANES)[:, :, 0]) ** 2
    variance = images + 1e-4 * images.max()
    diversity = Defocus(images, PLANES, bundle.wavelength, PIXEL, variance)
    method = GerchbergSaxton(iterations=SWEEPS, averaging=0, restarts=0, tolerance=0.0, coarsening=1)
    first = seconds(lambda: retrieve(diversity, method))
    call = median_seconds(lambda: retrieve(diversity, method), 3)
    stack = jnp.asarray(images, jnp.complex64)
    pair = jax.jit(lambda a: jnp.fft.ifft2(jnp.fft.fft2(a)))
    pairs = median_seconds(lambda: pair(stack).block_until_ready(), REPEATS)
    field = retrieve(diversity, method).field
    return {
        "first": first,
        "call": call,
        "pairs": SWEEPS * pairs,
        "values": np.abs(field[0, ::40, ::40]).ravel().tolist(),
    }


def main(size: int | None = None) -> None:
    """Print the table."""
    results = Results("accelerator")
    # the accelerator first, if there is one; this process leaves it to the others
    first = in_fresh_process(device, double=False)
    devices = {first["platform"]: first}
    variables: dict[str, dict[str, str]] = {first["platform"]: {}, "cpu": {"JAX_PLATFORMS": "cpu"}}
    if first["platform"] != "cpu":
        devices["cpu"] = in_fresh_process(device, double=False, **variables["cpu"])
    for found in devices.values():
        print("  " + ", ".join(f"{key} {value}" for key, value in found.items()))
    for work, arguments in [
        *((fits, (dtype, "unit", size or SIZE)) for dtype in ("complex64", "complex128")),
        (retrieval, ()),
        *((posteriors, ("unit", pixels)) for pixels in FRAMES),
        *((posteriors, ("complex", pixels)) for pixels in FRAMES),
        (fits, ("complex64", "complex", size or SIZE)),
    ]:
        double, values = "complex128" in arguments, []
        for platform in devices:
            where = devices[platform]
            found = in_fresh_process(work, *arguments, double=double, **variables[platform])
            values.append(np.array(found.pop("values")))
            row = {"what": work.__name__, "of": " ".join(map(str, arguments)), "device": where["device"],
                   "first_call": found["first"], "call": found["call"]}  # fmt: skip
            if "code" in found:
                row |= {"code": found["code"], "floor": found["bytes"] / where["gigabytes_a_second"] / 1e9}
            if "pairs" in found:
                row |= {"fft_pairs": found["pairs"]}
            off = np.abs(values[-1] - values[0])
            results.add(**row, differs_99=float(np.quantile(off, 0.99)), differs_most=float(off.max()))
    results.save()


if __name__ == "__main__":
    main()
