"""Contact of a tool with a relaxing body by an ODE solver (scipy, Radau): independent of the steps.

The elastic force of the tool's displacement is piecewise linear in time. Phases of contact and of
none are integrated one after the other, each up to the event that ends it.
"""

import numpy as np
from scipy.integrate import solve_ivp

ACCURACY = {"method": "Radau", "rtol": 1e-11, "atol": 1e-13, "dense_output": True}


def force_in_time(times, knots, gamma, tau):
    """Force, and elastic force of the surface, at times; `knots`: times and elastic forces, N.

    The body is at rest before the first knot, where the elastic force is 0.
    """
    gamma, tau = np.asarray(gamma, float), np.asarray(tau, float)
    corners, heights = (np.asarray(v, float) for v in knots)
    force, elastic = np.zeros(len(times)), np.zeros(len(times))
    y, touching, now = np.zeros(len(gamma) + 1), True, corners[0]
    while now < corners[-1]:
        k = np.searchsorted(corners, now, side="right") - 1
        rate = (heights[k + 1] - heights[k]) / (corners[k + 1] - corners[k])

        def tool(t, k=k, rate=rate):
            return heights[k] + rate * (t - corners[k])

        def change(t, y, touching=touching, rate=rate):
            decay = y[:-1] / tau
            de = rate if touching else decay.sum() / (1 + gamma.sum())
            return np.append(gamma * de - decay, de)

        def gap(t, y, touching=touching, tool=tool):
            return y.sum() if touching else y[-1] - tool(t)

        gap.terminal, gap.direction = True, -1
        found = solve_ivp(change, (now, corners[k + 1]), y, events=gap, **ACCURACY)
        end, y = found.t[-1], found.y[:, -1].copy()
        inside = (times >= now) & (times <= end)
        if inside.any():
            at = found.sol(times[inside])
            force[inside], elastic[inside] = (at.sum(0) if touching else 0), at[-1]
        if found.status == 1:
            touching = not touching
        now = end if found.status == 1 else corners[k + 1]
    return force, elastic
