"""An arch that flattens under a tool, each of its parts visco-elastic: numpy alone.

Half circle of nine nodes with hinged ends. Bars between nodes and springs that turn at them are the
skeleton, at finite deflections; a spring k_1 d + k_3 d^3 between the top and the tool is the local
contact. Every part has an elastic force N of its own strain and branches of its own,

    F = N + sum_b h_b,   dh_b/dt = gamma_b dN/dt - h_b / tau_b,

and the sum of all parts is in equilibrium at every instant (Newton; steps within a sample are
exact for an N that is linear in time). The contact is bonded.
"""

from typing import NamedTuple

import numpy as np

RADIUS, NODES = 11.7, 9
#: Of bars, N/mm, and of the springs that turn, N mm.
BAR, HINGE = 20.0, 30.0
_ANGLES = np.linspace(np.pi, 0, NODES)
_REST = RADIUS * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_TOP = 2 * (NODES // 2) + 1
_BARS, _HINGES = NODES - 1, NODES - 2


class Part(NamedTuple):
    """Branches of a part."""

    gamma: tuple[float, ...] = ()
    tau: tuple[float, ...] = ()


ELASTIC = Part()


def _strains(places, depth):
    """Of bars and hinges from rest, then the depth; and their derivatives by the free places."""
    edges = np.diff(places.reshape(-1, 2), axis=0)
    length = np.hypot(*edges.T)
    along = edges / length[:, None]
    turned = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    angle = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
    slope = np.zeros((2 * _BARS, NODES, 2))
    for i in range(_BARS):
        for row, v in ((i, along[i]), (_BARS + i, turned[i])):
            slope[row, i], slope[row, i + 1] = -v, v
    slope = slope.reshape(2 * _BARS, -1)
    by = np.concatenate([slope[:_BARS], np.diff(slope[_BARS:], axis=0), np.zeros((1, 2 * NODES))])
    by[-1, _TOP] = 1.0  # the tool goes down: what the top rises adds to the depth
    found = np.concatenate([length, np.diff(angle), [depth]])
    return found, by[:, 2:-2]


_AT_REST = _strains(_REST.ravel(), 0.0)[0]


def _elastic(strain, law):
    """Elastic force of every part."""
    change, depth = strain - _AT_REST, strain[-1]
    stiffness = np.concatenate([np.full(_BARS, BAR), np.full(_HINGES, HINGE)])
    return np.append(stiffness * change[:-1], law[0] * depth + law[1] * depth**3)


def press(time, displacement, law, local=ELASTIC, skeleton=ELASTIC, steps=4):
    """Force on the tool at every time, N.

    Args:
        time: s, rising, from rest at the first.
        displacement: of the tool, mm, linear between the times.
        law: k_1 and k_3.
        local: branches of the local contact; without any it is elastic.
        skeleton: branches of every bar and hinge.
        steps: within each sample.

    Raises:
        RuntimeError: no equilibrium was found.
    """
    fine = np.interp(
        np.arange((len(time) - 1) * steps + 1) / steps, np.arange(len(time)), np.asarray(time)
    )
    way = np.interp(fine, time, displacement)
    gamma, tau = _of_parts(local, skeleton)
    free, carried, before = _REST.ravel()[2:-2].copy(), np.zeros_like(gamma), np.zeros(len(gamma))
    force = []
    for dt, D in zip(np.diff(fine, prepend=fine[0]), way, strict=True):
        x = dt / tau
        kept, share = np.exp(-x), gamma * (-np.expm1(-x) / x if dt > 0 else 1.0)
        A, B = 1 + share.sum(1), (kept * carried - share * before[:, None]).sum(1)
        free, now = _solve(free, D, law, A, B)
        carried = kept * carried + share * (now - before)[:, None]
        before = now
        force.append(now[-1] + carried[-1].sum())
    return np.asarray(force)[::steps]


def _of_parts(local, skeleton):
    """Branches of every part, (parts, branches); one of no strength where there is none."""
    gamma, tau = np.zeros((2 * _BARS, 4)), np.ones((2 * _BARS, 4))
    for rows, part in ((slice(0, -1), skeleton), (slice(-1, None), local)):
        gamma[rows, : len(part.gamma)] = part.gamma
        tau[rows, : len(part.tau)] = part.tau
    return gamma, tau


def _solve(free, D, law, A, B):
    """Places in equilibrium, and the elastic force of every part."""

    def out_of_balance(free):
        places = _REST.ravel().copy()
        places[2:-2] = free
        strain, by = _strains(places, D - (_REST.ravel()[_TOP] - places[_TOP]))
        now = _elastic(strain, law)
        return by.T @ (A * now + B), now

    inverse = np.zeros((len(free), len(free)))
    for i in range(40):
        left, now = out_of_balance(free)
        if np.abs(left).max() < 1e-8:
            return free, now
        if i % 3 == 0:
            shifts = 1e-5 * np.eye(len(free))
            columns = [out_of_balance(free + shift)[0] - left for shift in shifts]
            inverse = 1e-5 * np.linalg.inv(np.stack(columns, axis=1))
        free = free - inverse @ left
    raise RuntimeError(f"no equilibrium at D = {D:g} mm")
