"""Several contacts on one compliance by enumeration: every set of contacts that may touch is tried.

For each set the balance of its contacts is solved as if they were bonded, by a damped Newton method
in NumPy; the set is right where all of it presses and nothing else would. At most one set is.
"""

import itertools

import numpy as np


def balanced(D, C, laws, bonded=None):
    """Forces of many scenes, shape of D; NaN where no set is right.

    Args:
        D: tool displacements, mm; (scenes, m).
        C: compliances, mm/N; (scenes, m, m).
        laws: k_1, k_3, k_5, each (scenes, m), none negative.
        bonded: contacts that may pull; (scenes, m).
    """
    bonded = np.zeros(D.shape, bool) if bonded is None else bonded
    found = np.full(D.shape, np.nan)
    for touching in itertools.product([False, True], repeat=D.shape[1]):
        i = np.flatnonzero(np.all(bonded <= np.array(touching), axis=1))
        F, d, balance = _bonded(D[i], C[i], [k[i] for k in laws], np.array(touching))
        small = 1e-11 * (1 + np.abs(D[i]).max(1))
        presses = np.where(touching, d >= -small[:, None], d <= small[:, None]) | bonded[i]
        right = (balance <= small) & np.all(presses, axis=1)
        found[i[right]] = F[right]
    return found


def _bonded(D, C, laws, on):
    k_1, k_3, k_5 = (np.where(on, k, 0) for k in laws)
    m = D.shape[1]

    def force(d):
        return d * (k_1 + d * d * (k_3 + d * d * k_5))

    def off(d):
        return d + np.einsum("nij,nj->ni", C, force(d)) - D

    d = D / (1 + np.einsum("nii->ni", C) * k_1)
    for _ in range(60):  # each alone
        c = np.einsum("nii->ni", C)
        slope = 1 + c * (k_1 + d * d * (3 * k_3 + d * d * 5 * k_5))
        d = d - (d + c * force(d) - D) / slope
    for _ in range(80):
        slope = k_1 + d * d * (3 * k_3 + d * d * 5 * k_5)
        r = off(d)
        step = np.linalg.solve(np.eye(m) + C * slope[:, None], -r[..., None])[..., 0]
        t, size = np.ones((len(d), 1)), np.abs(r).sum(1)
        for _ in range(12):
            worse = np.abs(off(d + t * step)).sum(1) > size * (1 - 1e-4 * t[:, 0])
            t = np.where(worse[:, None], t / 2, t)
        d = d + t * step
    return force(d), d, np.abs(off(d)).max(1)
