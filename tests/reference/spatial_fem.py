"""Exact beam in two planes on rings with full 2x2 springs: the two-plane companion of `beam_fem`.

Shares nothing with `jaxtrachea.mechanics.spatial_beam`: Hermite (Timoshenko) elements in both
planes, ring springs as the inverse of their compliance, one dense solve in `DIGITS` decimal digits.
"""

from bisect import bisect_right
from decimal import Decimal
from typing import NamedTuple

import mpmath as mp
from beam_fem import _element, exactly

DIGITS = 60
_BAND = 7


class Solution(NamedTuple):
    """Nodal results in high precision, components (y, z) last."""

    w_C: list
    theta_C: list
    w: list
    theta: list
    reaction: list
    end_shear: tuple  # force of each clamp against the load, per plane
    energy: Decimal | mp.mpf


def _solve_banded(K, f):
    """L D L^T; K[i][j] is entry (i, i + j)."""
    n = len(f)
    for i in range(n):
        for j in range(1, min(_BAND, n - 1 - i) + 1):
            factor = K[i][j] / K[i][0]
            if factor != 0:
                for m in range(j, _BAND + 1):
                    K[i + j][m - j] -= factor * K[i][m]
                f[i + j] -= factor * f[i]
    for i in reversed(range(n)):
        for j in range(1, min(_BAND, n - 1 - i) + 1):
            f[i] -= K[i][j] * f[i + j]
        f[i] /= K[i][0]
    return f


def _assemble(nodes, x, EI, GA, zero):
    """Banded stiffness; the dofs of a node are (w_y, w_z, theta_y, theta_z)."""
    K = [[zero] * (_BAND + 1) for _ in range(4 * len(nodes))]
    elements, rings = [], sorted(x)
    for e, (low, high) in enumerate(zip(nodes, nodes[1:], strict=False)):
        span = bisect_right(rings, low)
        for p in range(2):
            element = _element(high - low, EI[span][p], None if GA is None else GA[span][p])
            elements.append(element)
            at = [4 * e + p, 4 * e + 2 + p, 4 * e + 4 + p, 4 * e + 6 + p]
            for i in range(4):
                for j in range(i, 4):
                    K[at[i]][at[j] - at[i]] += element[i][j]
    return K, elements


def solve(x, length, EI, C, s_c, force, GA=None, ring_load=None, integrity=None) -> Solution:
    """Beam clamped at both ends, rings of compliance C_i / integrity_i at x, force (2) at s_c.

    The numbers are taken as they are: floats exactly, `mpmath` numbers unchanged.
    """
    given = x, length, EI, C, s_c, force, GA, ring_load, integrity
    with exactly(DIGITS, *given) as number:

        def exact(v):
            return [exact(u) for u in v] if hasattr(v, "__len__") else number(v)

        zero = number(0)
        x, EI, C, force = exact(x), exact(EI), exact(C), exact(force)
        GA = None if GA is None else exact(GA)
        load = exact([[0, 0]] * len(x) if ring_load is None else ring_load)
        hold = exact([1] * len(x) if integrity is None else integrity)
        length, s_c = exact(length), exact(s_c)
        nodes = sorted({zero, length, s_c, *x})
        K, elements = _assemble(nodes, x, EI, GA, zero)
        f = [zero] * len(K)
        at, at_C = [4 * nodes.index(v) for v in x], 4 * nodes.index(s_c)
        springs = []
        for i, c, g, e in zip(at, C, load, hold, strict=True):
            d = (c[0][0] * c[1][1] - c[0][1] * c[1][0]) / e
            springs.append([[c[1][1] / d, -c[0][1] / d], [-c[1][0] / d, c[0][0] / d]])
            K[i][0] += springs[-1][0][0]
            K[i + 1][0] += springs[-1][1][1]
            K[i][1] += springs[-1][0][1]
            f[i], f[i + 1] = f[i] + g[0], f[i + 1] + g[1]
        f[at_C], f[at_C + 1] = f[at_C] + force[0], f[at_C + 1] + force[1]
        applied = f[4:-4]
        u = _solve_banded(K[4:-4], applied[:])
        energy = sum(p * q for p, q in zip(applied, u, strict=True)) / 2
        u = [zero] * 4 + u + [zero] * 4
        ends = []
        for e, row in ((0, 0), (len(nodes) - 2, 2)):
            ends.append(
                [
                    -sum(elements[2 * e + p][row][j] * u[4 * e + 2 * j + p] for j in range(4))
                    for p in range(2)
                ]
            )
        w = [u[i : i + 2] for i in at]
        reaction = [
            [sum(k[p][q] * v[q] for q in range(2)) - g[p] for p in range(2)]
            for k, v, g in zip(springs, w, load, strict=True)
        ]
        theta = [u[i + 2 : i + 4] for i in at]
        motion_C = u[at_C : at_C + 2], u[at_C + 2 : at_C + 4]
        return Solution(*motion_C, w, theta, reaction, tuple(ends), energy)
