"""Records of a tool that moves in time, by a differential equation: numpy and scipy alone.

Local law and skeleton are in series; either relaxes by branches of its own. The unknowns are the
local depth and what the branches carry, by Radau from one corner of the tool's way to the next. The
tool lets go where it would pull; the way goes on without another touch.
"""

import numpy as np
from scipy.integrate import solve_ivp


def press(times, corners, compliance, law, local, skeleton, accuracy=1e-9):
    """Force, N, and what the skeleton gives, mm, at times, from rest before the first corner.

    Args:
        times: s, rising, within the corners.
        corners: times and displacements of the tool, linear between; it touches at 0 mm.
        compliance: of the skeleton, mm/N, in the long run.
        law: k_1, k_3, k_5.
        local: gamma and tau of the branches of the local law.
        skeleton: those of the skeleton.
        accuracy: relative, of the solver.
    """
    (g, tau), (g_s, tau_s) = (
        tuple(np.asarray(v, float) for v in part) for part in (local, skeleton)
    )
    k_1, k_3, k_5 = law
    count = len(g)

    def force_of(y):
        d = y[0]
        return k_1 * d + k_3 * d**3 + k_5 * d**5 + y[1 : 1 + count].sum(0)

    force, skeletal = np.zeros(len(times)), np.zeros(len(times))
    y = np.zeros(1 + count + len(g_s))
    knots, ways = (np.asarray(v, float) for v in corners)
    for k in range(len(knots) - 1):
        if ways[k] <= 0 and ways[k + 1] <= 0 and not y.any():
            continue  # in air
        touch = (
            np.interp(0, *_rising(ways[k : k + 2], knots[k : k + 2])) if not y.any() else knots[k]
        )
        rate = (ways[k + 1] - ways[k]) / (knots[k + 1] - knots[k])

        def change(t, y, rate=rate):
            d, h, q = y[0], y[1 : 1 + count], y[1 + count :]
            tangent = k_1 + 3 * k_3 * d**2 + 5 * k_5 * d**4
            a, a_s = (1 + g.sum()) * tangent, (1 + g_s.sum()) / compliance
            dd = (a_s * rate - np.sum(q / tau_s) + np.sum(h / tau)) / (a + a_s)
            grown = (g * tangent * dd - h / tau, g_s / compliance * (rate - dd) - q / tau_s)
            return np.concatenate([[dd], *grown])

        def pull(t, y, touch=touch):
            return force_of(y) + (1.0 if t <= touch else 0.0)

        pull.terminal, pull.direction = True, -1
        found = solve_ivp(
            change, (touch, knots[k + 1]), y, method="Radau", rtol=accuracy, atol=accuracy * 1e-3,
            dense_output=True, events=pull,
        )  # fmt: skip
        inside = (times >= touch) & (times <= found.t[-1])
        if inside.any():
            at = found.sol(times[inside])
            force[inside] = force_of(at)
            skeletal[inside] = np.interp(times[inside], knots, ways) - at[0]
        if found.status == 1:
            break  # the tool has left
        y = found.y[:, -1]
    return force, skeletal


def _rising(ways, knots):
    """Arguments of `np.interp` for the time at which a way is reached."""
    return (ways, knots) if ways[1] > ways[0] else (ways[::-1], knots[::-1])
