"""Plain loops and sums over fine grids, which share nothing with the package."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import i0e, i1e


def grid_entropy(log_density, low, high, nodes=100_000):
    """Entropy of an unnormalised log density, from a sum over midpoints."""
    x = low + (np.arange(nodes) + 0.5) * ((high - low) / nodes)
    power = log_density(x)
    power = power - power.max()
    weight = np.exp(power)
    total = weight.sum()
    return np.log(total * (high - low) / nodes) - np.sum(weight * power) / total


def von_mises(concentration):
    reach = min(np.pi, 12 / concentration**0.5)
    return grid_entropy(lambda x: -2 * concentration * np.sin(0.5 * x) ** 2, -reach, reach)


def members(image, row, column, size, used=None):
    """The values in the window around a pixel that count."""
    half = size // 2
    window = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    values = np.asarray(image, float)[window]
    counts = np.isfinite(values) if used is None else np.isfinite(values) & used[window]
    return values[counts]


def angles(image, size, period, used=None, fewest=5):
    """Mean and entropy of the von Mises distribution of every window, with 1 / (n - 1) added."""
    mean, entropy = np.full((2, *image.shape), np.nan)
    turn = 2 * np.pi / period
    for place in np.ndindex(image.shape):
        x = members(image, *place, size, used)
        if len(x) >= fewest:
            z = np.exp(1j * turn * x).mean()
            mean[place] = np.angle(z) / turn
            k = brentq(lambda k, r=z: i1e(k) / i0e(k) - abs(r), 0, 1e8)
            entropy[place] = np.log(2 * np.pi * i0e(k)) + k * (1 - abs(z)) - np.log(turn) + 1 / (len(x) - 1)
    return mean, entropy


def joint_log_density(statistics, parameters, grid):
    """Sum of parameters times trigonometric polynomials on a grid of angles."""
    power = np.zeros(grid[0].shape)
    for statistic, factor in zip(statistics, parameters, strict=True):
        for frequency, c in statistic.items():
            power += factor * (c * np.exp(1j * sum(k * g for k, g in zip(frequency, grid, strict=True)))).real
    return power


def torus(angles, nodes):
    x = (np.arange(nodes) + 0.5) * (2 * np.pi / nodes) - np.pi
    return np.meshgrid(*[x] * angles, indexing="ij")


def joint_entropy(statistics, parameters, angles, nodes):
    power = joint_log_density(statistics, parameters, torus(angles, nodes))
    power -= power.max()
    weight = np.exp(power)
    total = weight.sum()
    return np.log(total * (2 * np.pi / nodes) ** angles) - np.sum(weight * power) / total
