"""Data of unknown noise and gain, integrated by brute force in plain NumPy."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from . import jones as oracle


def log_sum(values):
    top = np.max(values)
    return top + np.log(np.sum(np.exp(values - top)))


def log_inverse_gamma(s, shape, scale):
    return shape * np.log(scale) - gammaln(shape) - (shape + 1) * np.log(s) - scale / s


def gains(kind, scale, m, v, reach):
    """Points in the space of gains and the logarithms of their prior probabilities."""
    if kind == "none":
        return np.ones(1, complex), np.zeros(1)
    if kind == "phase":
        phase = 2 * np.pi * np.arange(3000) / 3000
        return np.exp(1j * phase), np.full(3000, -np.log(3000))
    # a grid around the best gain: trapezoidal sums of a Gaussian converge as soon as the grid resolves it
    best = np.vdot(m, v) / np.vdot(m, m)
    axis = np.linspace(-reach, reach, 241)
    g = (best.real + axis)[:, None] + 1j * (best.imag + axis)[None]
    step = axis[1] - axis[0]
    return g.ravel(), (-(abs(g) ** 2) / scale**2 - np.log(np.pi * scale**2) + 2 * np.log(step)).ravel()


def log_unknown_noise(x, u, v, shape, scale, kind="none", gain_scale=1.0, weight=None, span=(1e-3, 1e4), reach=1.0):
    """Log density of the data of one pixel, summed over sigma^2 (in ``span`` times ``scale``) and over the gain."""
    m = oracle.jones(x) @ u
    w = np.ones(u.shape[1]) if weight is None else np.asarray(weight, float)
    kept = w > 0
    m, v, w = m[:, kept] * np.sqrt(w[kept]), v[:, kept] * np.sqrt(w[kept]), w[kept]
    g, log_prior = gains(kind, gain_scale, m, v, reach)
    square = np.zeros(g.shape)
    for a, b in zip(m.ravel(), v.ravel(), strict=True):
        square += abs(g * a - b) ** 2
    log_s = np.linspace(np.log(scale * span[0]), np.log(scale * span[1]), 500)
    s = np.exp(log_s)
    inner = np.array([log_sum(log_prior - square / one) for one in s])
    data = inner - m.size * np.log(np.pi * s) + 2 * np.sum(np.log(w))
    return log_sum(data + log_inverse_gamma(s, shape, scale) + log_s + np.log(log_s[1] - log_s[0]))


def log_phase_mean(power, ratio):
    """Nodes, normalised log weights, and the log of the mean of (1 + ratio sin^2 psi)^-power over psi in (0, pi/2)."""
    edges = np.concatenate([[0], np.logspace(-16, np.log10(np.pi / 2), 300)])
    t, w = np.polynomial.legendre.leggauss(16)
    low, high = edges[:-1, None], edges[1:, None]
    psi, weight = ((low + high) / 2 + (high - low) / 2 * t).ravel(), ((high - low) / 2 * w).ravel()
    s = np.sin(psi) ** 2
    values = np.log(weight * 2 / np.pi) - power * np.log1p(ratio * s)
    total = log_sum(values)
    return s, np.exp(values - total), total


def log_gain_mean(power, rest, signal, width):
    """Nodes in s, normalised weights, and the log of the integral that ``log_gain_mean`` is."""
    low = np.log((1 + rest) / power) - 6 / np.sqrt(power) - 3
    high = np.log((1 + rest + signal) / power) + 6 / np.sqrt(power) + 45 / power + 3
    u = np.linspace(low, high, 100_001)
    s = np.exp(u)
    values = -power * u - (1 + rest) / s - signal / (width + s) - np.log1p(width / s) + np.log(u[1] - u[0])
    total = log_sum(values)
    return s, np.exp(values - total), total - gammaln(power)
