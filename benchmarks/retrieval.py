"""Speed against error of multi-plane Gerchberg-Saxton on simulated bundle fields.

547 fibrelets on 200 x 200 pixels, 7 planes over +-120 um, shot and read noise; fields seen with 0.3 % of focus error.
Error: relative error of the mode amplitudes modulo piston. Cost: in pairs of FFTs of all planes, measured in the same
run.
"""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg

from benchmarks.results import Results, median_seconds
from fibre import Bundle, Defocus, Fibrelets, GerchbergSaxton, retrieve
from fibre.fibrelets import mode_matrix

SHAPE, PIXEL = (200, 200), 0.72e-6
PLANES = np.linspace(-120e-6, 120e-6, 7)


def main() -> None:
    """Print the table."""
    results = Results("retrieval")
    bundle = Bundle.hexagonal(rng=0)
    rng = np.random.default_rng(3)
    amplitudes = np.zeros((4, 2, bundle.cores), complex)
    amplitudes[:, 0] = rng.standard_normal((4, bundle.cores)) + 1j * rng.standard_normal((4, bundle.cores))
    truth = amplitudes[:, 0]
    images = np.abs(bundle.image(amplitudes, SHAPE, PIXEL, PLANES * 1.003)[:, :, 0]) ** 2
    modes = mode_matrix(Fibrelets(bundle.centres, bundle.mode_radius.mean()), SHAPE, PIXEL)
    solve = scipy.sparse.linalg.splu((modes.T @ modes).astype(complex).tocsc()).solve
    stack = jnp.asarray(images.astype(np.complex64))
    pair = jax.jit(lambda a: jnp.fft.ifft2(jnp.fft.fft2(a)))
    pair_seconds = median_seconds(lambda: np.asarray(pair(stack))) / len(truth)
    for photons in (1e4, 1e6):
        scale = photons / images.max()
        counts = rng.poisson(images * scale) + 3 * rng.standard_normal(images.shape)
        variance = images * scale + 9
        diversity = Defocus(counts, PLANES, bundle.wavelength, PIXEL, variance)
        for iterations in (5, 10, 20, 40, 80, 160):
            method = GerchbergSaxton(iterations=iterations, averaging=20, restarts=0, tolerance=0.0)
            retrieve(diversity, method)
            start = time.perf_counter()
            found = retrieve(diversity, method)
            seconds = (time.perf_counter() - start) / len(truth)
            errors = []
            for field, true in zip(found.field, truth, strict=True):
                mode = solve(modes.T @ field.ravel().astype(complex))
                mode = mode * np.vdot(mode, true) / np.vdot(mode, mode)
                errors.append(np.linalg.norm(mode - true) / np.linalg.norm(true))
            results.add(
                photons_at_peak=photons,
                sweeps=iterations,
                seconds_a_field=seconds,
                relative_error=float(np.median(errors)),
                fft_pairs_of_all_planes=seconds / pair_seconds,
            )
    results.save(results.lines("seconds_a_field", "relative_error", "photons_at_peak"))


if __name__ == "__main__":
    main()
