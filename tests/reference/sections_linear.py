"""Small presses on deforming cross-sections, from the differential equations (NumPy and SciPy).

Independent of `jaxtrachea.mechanics.sections`: the modes are linearised by hand, spans solved by
the exponential of the coupled Timoshenko equations w' = E psi + A^-1 V, psi' = C^-1 M, V' = 0,
M' = -E^T V (no shape functions, no effective shear stiffness), angles by 40 Gauss points a piece.
Modes in the order a1, a2, a3, e, b0, b1, b2, b3; rotations of a1, a2, a3, b1, b2, b3.
"""

import numpy as np
import scipy.linalg

WARPS = [0, 1, 2, 5, 6, 7]
ORDER = np.array([1, 2, 3, 1, 2, 3])
E = np.zeros((8, 6))
E[WARPS, np.arange(6)] = 1


def quadrature(alpha):
    x, w = np.polynomial.legendre.leggauss(40)
    breaks = [-np.pi, -alpha, 0, alpha, np.pi]
    half = np.diff(breaks)[:, None] / 2
    middle = (np.array(breaks[1:]) + breaks[:-1])[:, None] / 2
    return (middle + half * x).ravel(), (half * w).ravel()


def shapes(phi, R, alpha):
    """Radial and tangential motion, rotation and its derivative by phi of every mode."""
    r, t, turn, curve = [], [], [], []
    for m in (1, 2, 3):
        r.append(np.cos(m * phi))
        t.append(-np.sin(m * phi) / m)
        turn.append((m - 1 / m) * np.sin(m * phi) / R)
        curve.append((m * m - 1) * np.cos(m * phi) / R)
    # e: u_y' = -eps R sin(phi) - R turn cos(phi), u_z' = eps R cos(phi) - R turn sin(phi).
    lam = -2 * np.sin(alpha) / np.pi
    behind = np.abs(phi) > alpha
    y = lam / 4 * np.cos(2 * phi) + behind * (np.cos(phi) - np.cos(alpha))
    y = y + (np.sin(alpha) + (np.pi - alpha) * np.cos(alpha)) / np.pi
    z = -lam * (phi / 2 - np.sin(2 * phi) / 4)
    z = z + behind * (np.sin(phi) - np.sign(phi) * np.sin(alpha))
    r.append(y * np.cos(phi) + z * np.sin(phi))
    t.append(z * np.cos(phi) - y * np.sin(phi))
    turn.append(lam * np.sin(phi) / R)
    curve.append(lam * np.cos(phi) / R)
    r.append(0 * phi)
    t.append(0 * phi + 1)
    turn.append(0 * phi + 1 / R)
    curve.append(0 * phi)
    for m in (1, 2, 3):
        r.append(np.sin(m * phi))
        t.append(np.cos(m * phi) / m)
        turn.append(-(m - 1 / m) * np.cos(m * phi) / R)
        curve.append((m * m - 1) * np.sin(m * phi) / R)
    return tuple(np.array(v) for v in (r, t, turn, curve))


def ring_stiffness(p, pitch):
    """8 x 8, N/mm; p: values of a SectionMaterial with R and alpha."""
    phi, w = quadrature(p["alpha"])
    r, t, turn, curve = shapes(phi, p["R"], p["alpha"])
    behind = np.abs(phi) > p["alpha"]
    EI = np.where(behind, p["EI_M"], p["EI_C"])
    K = np.einsum("im,jm,m->ij", curve, curve, w * EI) / p["R"]
    out_t, area = t + p["offset"] * turn, w * behind * (p["R"] + p["offset"]) * pitch
    K += np.einsum("im,jm,m->ij", r, r, p["k_n"] * area)
    K += np.einsum("im,jm,m->ij", out_t, out_t, p["k_t"] * area)
    K[3, 3] += p["Et_M"] * 2 * (np.pi - p["alpha"]) * pitch / p["R"]
    return K


def wall_matrices(p):
    """A (8 x 8) and C (6 x 6) of the wall between rings."""
    phi, w = quadrature(p["alpha"])
    r, t, _, _ = shapes(phi, p["R"], p["alpha"])
    front = np.abs(phi) <= p["alpha"]
    f = w * np.where(front, 1, p["rho"])
    X = r[WARPS] / (ORDER**2)[:, None]
    A = p["Gt_L"] * p["R"] * np.einsum("im,jm,m->ij", t, t, f)
    C = p["Et_L"] * p["R"] ** 3 * np.einsum("im,jm,m->ij", X, X, f)
    bend = np.einsum("im,jm,m->ij", r[WARPS], r[WARPS], w * front)
    return A, C + p["D_L"] * p["R"] * bend


def transfer(A, C, E, h):
    """(w, psi, V, M) at the end of a span from those at its beginning."""
    k, m = E.shape
    G = np.zeros((2 * (k + m), 2 * (k + m)))
    G[:k, k : k + m] = E
    G[:k, k + m : 2 * k + m] = np.linalg.inv(A)
    G[k : k + m, 2 * k + m :] = np.linalg.inv(C)
    G[2 * k + m :, k + m : 2 * k + m] = -E.T
    return scipy.linalg.expm(G * h)


def span_stiffness(A, C, E, h):
    """Of (w, psi) at both ends, left then right."""
    n = sum(E.shape)
    T = transfer(A, C, E, h)
    # d_R = T11 d_L + T12 f_L gives the forces (V, M) at the left end.
    left = np.linalg.solve(T[:n, n:], np.hstack([-T[:n, :n], np.eye(n)]))
    right = T[n:, :n] @ np.eye(n, 2 * n) + T[n:, n:] @ left
    return np.vstack([-left, right])


def beam_shares(a, c, h, x):
    """Deflection at x by unit motions (w, psi) of both ends, and by a unit force; one mode."""
    warps = c is not None
    E_1 = np.ones((1, 1)) if warps else np.zeros((1, 0))
    A, C = np.array([[a]]), np.array([[c]]) if warps else np.zeros((0, 0))
    n = 1 + warps
    if x in (0.0, h):
        end = np.eye(2 * n)[0 if x == 0 else n]
        return end, 0.0
    left, right = span_stiffness(A, C, E_1, x), span_stiffness(A, C, E_1, h - x)
    K = np.zeros((3 * n, 3 * n))
    K[: 2 * n, : 2 * n] += left
    K[n:, n:] += right
    mid, ends = np.arange(n, 2 * n), np.r_[0:n, 2 * n : 3 * n]
    moved = np.linalg.solve(K[np.ix_(mid, mid)], np.hstack([-K[np.ix_(mid, ends)], np.eye(n)]))
    return moved[0, : 2 * n], moved[0, 2 * n]


def linear_force(p, length, rings, s_c, phi_c):
    """Force (inward, around) per mm of inward displacement, N/mm; footprint 1."""
    nodes = np.r_[0.0, rings, length]
    A, C = wall_matrices(p)
    K = np.zeros((14 * len(nodes), 14 * len(nodes)))
    for j, h in enumerate(np.diff(nodes)):
        K[14 * j : 14 * j + 28, 14 * j : 14 * j + 28] += span_stiffness(A, C, E, h)
    for i in range(1, len(nodes) - 1):
        pitch = (nodes[i + 1] - nodes[i - 1]) / 2
        K[14 * i : 14 * i + 8, 14 * i : 14 * i + 8] += ring_stiffness(p, pitch)
    free = np.ones(len(K), bool)
    for end in (0, len(nodes) - 1):
        free[14 * end : 14 * end + (8 if np.isfinite(p["k_end"]) else 14)] = False
        if np.isfinite(p["k_end"]):
            K[14 * end + 8 : 14 * end + 14, 14 * end + 8 : 14 * end + 14] += p["k_end"] * C
    j = min(np.searchsorted(nodes, s_c, side="right") - 1, len(nodes) - 2)
    h, x = nodes[j + 1] - nodes[j], s_c - nodes[j]
    N, S = np.zeros((8, len(K))), np.zeros(8)
    for k in range(8):
        warp = WARPS.index(k) if k in WARPS else None
        share, S[k] = beam_shares(A[k, k], None if warp is None else C[warp, warp], h, x)
        if warp is None:
            N[k, [14 * j + k, 14 * j + 14 + k]] = share
        else:
            N[k, [14 * j + k, 14 * j + 8 + warp, 14 * j + 14 + k, 14 * j + 22 + warp]] = share
    G = N[:, free] @ np.linalg.solve(K[np.ix_(free, free)], N[:, free].T) + np.diag(S)
    r, t, turn, _ = (v[:, 0] for v in shapes(np.array([phi_c]), p["R"], p["alpha"]))
    B = np.array([-r, t + p["offset"] * turn])
    weight = np.sin(np.pi * x / h) ** 2
    give = np.diag([p["c_n"], p["c_t_ring"] * (1 - weight) + p["c_t"] * weight])
    return np.linalg.solve(B @ G @ B.T + give, [1.0, 0.0])
