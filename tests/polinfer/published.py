"""The published formulas of other packages, written out, and the electric field in time that all of them describe."""

import numpy as np

RNG = np.random.default_rng(8)
SHAPES = [(), (1,), (2,), (2, 2), (3, 4), (2, 3, 2)]
EDGES = [(eta, t, xi) for eta in (0.0, -0.0, np.pi, -np.pi, np.pi / 2, -0.7) for t in (0.0, -0.0, np.pi / 2, -np.pi / 2,
         np.pi / 4, -0.4) for xi in (0.0, -0.0, np.pi, -np.pi, np.pi / 2, 0.3)]  # fmt: skip
LINEAR = [case for case in EDGES if case[2] != 0.3 and abs(case[2]) != np.pi / 2]


def pypolar_retarder(theta, delta):
    p, q, c, s = np.exp(0.5j * delta), np.exp(-0.5j * delta), np.cos(theta), np.sin(theta)
    off = c * s * 2j * np.sin(delta / 2)
    return np.array([[c * c * p + s * s * q, off], [off, c * c * q + s * s * p]])


def py_pol_rotation(t):
    return np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])


def py_pol_retarder_linear(ret, azimuth):
    return py_pol_rotation(-azimuth) @ np.diag([1, np.exp(-1j * ret)]) @ py_pol_rotation(azimuth)


def py_pol_retarder(ret, azimuth, ellipticity):
    """Retarder from the characteristic angles of the fast state (1, i tan e) rotated by the azimuth."""
    e = py_pol_rotation(-azimuth) @ np.array([np.cos(ellipticity), 1j * np.sin(ellipticity)])
    alpha, delay = np.arctan2(abs(e[1]), abs(e[0])), np.angle(e[1]) - np.angle(e[0])
    up, down, s = np.exp(0.5j * ret), np.exp(-0.5j * ret), 1j * np.sin(2 * alpha) * np.sin(ret / 2)
    c2, s2 = np.cos(alpha) ** 2, np.sin(alpha) ** 2
    return np.array([[c2 * up + s2 * down, s * np.exp(-1j * delay)], [s * np.exp(1j * delay), c2 * down + s2 * up]])


def py_pol_diattenuator(Tmax, Tmin, azimuth):
    return py_pol_rotation(-azimuth) @ np.diag(np.sqrt([Tmax, Tmin])) @ py_pol_rotation(azimuth)


def chromatix_elements(theta, eta, phi):
    s, c = np.sin(theta), np.cos(theta)
    scale = np.exp(-1j * eta / 2)
    off = scale * (1 - np.exp(1j * eta)) * s * c
    return (
        scale * (c**2 + np.exp(1j * eta) * s**2),
        off * np.exp(-1j * phi),
        off * np.exp(1j * phi),
        scale * (s**2 + np.exp(1j * eta) * c**2),
    )


def chromatix_matrix(j00, j01, j10, j11):
    return np.array([[0, 0, 0], [0, j11, j10], [0, j01, j00]])


def katsu_retarder(a, r):
    m = np.zeros((4, 4))
    m[0, 0] = 1
    m[1, 1] = np.cos(2 * a) ** 2 + np.cos(r) * np.sin(2 * a) ** 2
    m[1, 2] = m[2, 1] = (1 - np.cos(r)) * np.cos(2 * a) * np.sin(2 * a)
    m[1, 3] = -np.sin(r) * np.sin(2 * a)
    m[2, 2] = np.cos(r) * np.cos(2 * a) ** 2 + np.sin(2 * a) ** 2
    m[2, 3] = np.cos(2 * a) * np.sin(r)
    m[3, 1], m[3, 2], m[3, 3] = -m[1, 3], -m[2, 3], np.cos(r)
    return m


def katsu_diattenuator(a, Tmin, Tmax=1.0):
    m, total, difference, root = np.zeros((4, 4)), Tmax + Tmin, Tmax - Tmin, 2 * np.sqrt(Tmax * Tmin)
    c, s = np.cos(2 * a), np.sin(2 * a)
    m[0, 0] = total
    m[0, 1] = m[1, 0] = difference * c
    m[0, 2] = m[2, 0] = difference * s
    m[1, 1], m[2, 2], m[3, 3] = total * c**2 + root * s**2, root * c**2 + total * s**2, root
    m[1, 2] = m[2, 1] = (total - root) * c * s
    return m / 2


def katsu_from_jones(jones):
    u = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, 1j, -1j, 0]]) * np.sqrt(1 / 2)
    return np.real(u @ np.kron(np.conj(jones), jones) @ np.linalg.inv(u))


# ---- what is measured in the laboratory: the electric field in time

TIME = np.linspace(0, 2 * np.pi, 64, endpoint=False)


def moving(field, sign):
    """Real field vectors (time, component) of a complex amplitude with the time factor e^{sign i omega t}."""
    return (np.asarray(field)[None, :] * np.exp(sign * 1j * TIME)[:, None]).real


def random_matrices(shape=(), dtype=np.complex128):
    return (RNG.normal(size=(*shape, 2, 2)) + 1j * RNG.normal(size=(*shape, 2, 2))).astype(dtype)


def same_up_to_phase(a, b, atol=1e-12):
    a, b = np.asarray(a), np.asarray(b)
    phase = np.vdot(a, b)
    phase = phase / abs(phase)
    np.testing.assert_allclose(a * phase, b, atol=atol)
