"""Plain NumPy from the matrix products, looped and slow on purpose: nothing here is shared with the package."""

from __future__ import annotations

import numpy as np
from scipy.special import erf, i0, i0e


def rotation(t):
    return np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])


def polariser(d, t):
    return rotation(t) @ np.diag([np.sqrt(1 + d), np.sqrt(1 - d)]) @ rotation(-t)


def retarder(eta, t, xi):
    phase = np.diag([np.exp(0.5j * eta), np.exp(-0.5j * eta)])
    return np.diag([1, np.exp(1j * xi)]) @ rotation(t) @ phase @ rotation(-t) @ np.diag([1, np.exp(-1j * xi)])


def jones(x, ordering="retarder_first"):
    """Matrix of five numbers (D, theta_D, eta, theta_eta, xi)."""
    d, td, eta, te, xi = x
    if ordering == "retarder_first":
        return polariser(d, td) @ retarder(eta, te, xi)
    return retarder(eta, te, xi) @ polariser(d, td)


def log_likelihood(x, illumination, response, sigma, ordering="retarder_first", gain=1.0, weight=None):
    """Log density of the data of one pixel for a known gain, summed over states and components one by one."""
    matrix = jones(x, ordering)
    total = 0.0
    for k in range(illumination.shape[1]):
        w = 1.0 if weight is None else weight[k]
        if w == 0:
            continue
        variance = sigma**2 / w
        for r in response[:, k] - gain * (matrix @ illumination[:, k]):
            total += -(abs(r) ** 2) / variance - np.log(np.pi * variance)
    return total


def log_prior(x, kappa=1.0, scale=0.5):
    """The default priors, written out."""
    d, _, eta, _, xi = x
    if abs(d) > 1 or abs(eta) > np.pi:
        return -np.inf
    flat = -2 * np.log(np.pi) - np.log(2 * np.pi)
    normal = -0.5 * (d / scale) ** 2 - np.log(scale * np.sqrt(2 * np.pi) * erf(1 / (scale * np.sqrt(2))))
    return flat + normal + kappa * np.cos(xi) - np.log(2 * np.pi * i0(kappa))


def log_marginal(x, illumination, response, sigma, gain, scale=None, ordering="retarder_first"):
    """Log likelihood with the gain integrated out, by the textbook formulas (float64, moderate SNR)."""
    m = jones(x, ordering) @ illumination
    n = illumination.shape[1]
    if gain == "none":
        return -np.sum(abs(response - m) ** 2) / sigma**2 - 2 * n * np.log(np.pi * sigma**2)
    a, mm, vv = np.vdot(m, response), np.sum(abs(m) ** 2), np.sum(abs(response) ** 2)
    constant = -2 * n * np.log(np.pi * sigma**2)
    if gain == "phase":
        z = 2 * abs(a) / sigma**2
        return -(mm + vv) / sigma**2 + np.log(i0e(z)) + z + constant
    ratio = sigma**2 / scale**2
    return -vv / sigma**2 + abs(a) ** 2 / (sigma**2 * (mm + ratio)) - np.log1p(mm / ratio) + constant
