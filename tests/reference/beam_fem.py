"""Exact beam on ring supports by finite elements in high precision: the outside truth of the tests.

Shares nothing with `jaxtrachea.mechanics.beam`: a stiffness method (Hermite elements, with the
Timoshenko coefficient 12 EI / (GA h^2) where shear counts) assembled over all nodes at once and
solved by a banded L D L^T factorisation in `DIGITS` decimal digits. Both elements are exact for
loads at nodes, so the only error is rounding, some 1e-50 of the largest value.
"""

import contextlib
import decimal
from bisect import bisect_right
from decimal import Decimal
from typing import NamedTuple

import mpmath as mp
import numpy as np

DIGITS = 80
_BAND = 3


class Solution(NamedTuple):
    """Nodal results in high precision; signs as in `jaxtrachea.mechanics.beam.Deflection`."""

    w_C: Decimal | mp.mpf
    theta_C: Decimal | mp.mpf
    w: list
    theta: list
    reaction: list
    end_shear: tuple  # force of each clamp against the load
    end_moment: tuple  # moment of each clamp on the beam, positive with theta
    energy: Decimal | mp.mpf  # half of w^T K w, springs included


@contextlib.contextmanager
def exactly(count, *given):
    """Arithmetic in `count` decimal digits; yields what turns a float into such a number, exactly.

    `decimal` is ten times as fast as `mpmath`. Where one of `given` is an `mpmath` number, all are.
    """
    every = [v for some in given for v in np.asarray(some, dtype=object).ravel()]
    if any(isinstance(v, mp.mpf) for v in every):
        with mp.workdps(count):
            yield lambda v: v if isinstance(v, mp.mpf) else mp.mpf(float(v))
    else:
        with decimal.localcontext(prec=count):
            yield lambda v: v if isinstance(v, Decimal) else Decimal(float(v))


def _element(h, EI, GA):
    shear = 0 if GA is None else 12 * EI / (GA * h * h)
    c = EI / (h**3 * (1 + shear))
    near, far = (4 + shear) * h * h, (2 - shear) * h * h
    return [
        [c * 12, c * 6 * h, -c * 12, c * 6 * h],
        [c * 6 * h, c * near, -c * 6 * h, c * far],
        [-c * 12, -c * 6 * h, c * 12, -c * 6 * h],
        [c * 6 * h, c * far, -c * 6 * h, c * near],
    ]


def _solve_banded(K, f):
    """L D L^T with half bandwidth 3; K[i][j] is entry (i, i + j)."""
    n = len(f)
    K, f = [row[:] for row in K], f[:]
    for i in range(n):
        for j in range(1, min(_BAND, n - 1 - i) + 1):
            factor = K[i][j] / K[i][0]
            if factor == 0:
                continue
            for m in range(j, _BAND + 1):
                K[i + j][m - j] -= factor * K[i][m]
            f[i + j] -= factor * f[i]
    for i in reversed(range(n)):
        for j in range(1, min(_BAND, n - 1 - i) + 1):
            f[i] -= K[i][j] * f[i + j]
        f[i] /= K[i][0]
    return f


def solve(x, length, EI, k, s_c, force, GA=None, ring_load=None, *, free_end=False) -> Solution:
    """Beam clamped at 0 and `length` (`free_end`: at 0 only) on springs k at x, force at s_c.

    The numbers are taken as they are: floats exactly, `mpmath` numbers unchanged.
    """
    given = x, length, EI, k, s_c, force, GA, ring_load
    with exactly(DIGITS, *given) as number:

        def exact(values):
            return [number(v) for v in np.asarray(values)]

        zero = number(0)
        x, EI, k = exact(x), exact(EI), exact(k)
        GA = [None] * len(EI) if GA is None else exact(GA)
        load = [zero] * len(x) if ring_load is None else exact(ring_load)
        length, s_c, force = exact([length, s_c, force])
        nodes = sorted({zero, length, s_c, *x})
        n = len(nodes)
        K = [[zero] * (_BAND + 1) for _ in range(2 * n)]
        elements = []
        rings = sorted(x)
        for e, (low, high) in enumerate(zip(nodes, nodes[1:], strict=False)):
            span = bisect_right(rings, low)
            element = _element(high - low, EI[span], GA[span])
            elements.append(element)
            for i in range(4):
                for j in range(i, 4):
                    K[2 * e + i][j - i] += element[i][j]
        f = [zero] * (2 * n)
        node_at = {position: node for node, position in enumerate(nodes)}
        at = [node_at[position] for position in x]
        for node, stiffness, value in zip(at, k, load, strict=True):
            K[2 * node][0] += stiffness
            f[2 * node] += value
        at_C = node_at[s_c]
        f[2 * at_C] += force
        last = 2 * n if free_end else 2 * n - 2
        u = _solve_banded(K[2:last], f[2:last]) if last > 2 else []
        u = [zero] * 2 + u + [zero] * (2 * n - last)
        first = [sum(elements[0][i][j] * u[j] for j in range(4)) for i in (0, 1)]
        final = [sum(elements[-1][i][j] * u[2 * n - 4 + j] for j in range(4)) for i in (2, 3)]
        if s_c == 0:
            first[0] -= force
        if s_c == length and not free_end:
            final[0] -= force
        w = [u[2 * i] for i in at]
        return Solution(
            w_C=u[2 * at_C],
            theta_C=u[2 * at_C + 1],
            w=w,
            theta=[u[2 * i + 1] for i in at],
            reaction=[a * b - g for a, b, g in zip(k, w, load, strict=True)],
            end_shear=(-first[0], -final[0]),
            end_moment=(first[1], final[1]),
            energy=sum(a * b for a, b in zip(f, u, strict=True)) / 2,
        )


def solve_independent(x, length, EI, k, s_c, force, GA=None):
    """Paper eq. 3: two cantilevers, each alone with its share of the force (A takes a ring at C).

    Returns (w_C as sum(share * tip), reactions at all rings).
    """
    x, EI, k = (np.asarray(v) for v in (x, EI, k))
    with exactly(DIGITS, x, length, EI, k, s_c, force, GA) as number:
        n = sum(1 for position in x if number(position) <= number(s_c))
        a, b = number(s_c), number(length) - number(s_c)
        force = number(force)
        share_A = b**3 / (a**3 + b**3)
        sides = []
        for share, x_i, EI_i, k_i, GA_i, tip in (
            (share_A, x[:n], EI[: n + 1], k[:n], None if GA is None else GA[: n + 1], a),
            (
                1 - share_A,
                [number(length) - number(v) for v in x[n:]][::-1],
                EI[n:][::-1],
                k[n:][::-1],
                None if GA is None else GA[n:][::-1],
                b,
            ),
        ):
            unit = _cantilever(x_i, EI_i, k_i, tip, GA_i, number)
            sides.append((share * share * force * unit[0], [share * force * r for r in unit[1]]))
        return sides[0][0] + sides[1][0], sides[0][1] + sides[1][1][::-1]


def _cantilever(x, EI, k, tip, GA, number):
    """Tip deflection and reactions per unit tip force, positions already exact."""
    nodes = [number(0), *(number(v) for v in x)]
    if nodes[-1] != tip:
        nodes.append(tip)
    n = len(nodes)
    K = [[number(0)] * (_BAND + 1) for _ in range(2 * n)]
    for e in range(n - 1):
        shear = None if GA is None else number(GA[e])
        element = _element(nodes[e + 1] - nodes[e], number(EI[e]), shear)
        for i in range(4):
            for j in range(i, 4):
                K[2 * e + i][j - i] += element[i][j]
    for i, stiffness in enumerate(k):
        K[2 * (i + 1)][0] += number(stiffness)
    f = [number(0)] * (2 * n - 2)
    f[-2] = number(1)
    u = _solve_banded(K[2:], f)
    return u[-2], [number(stiffness) * u[2 * i] for i, stiffness in enumerate(k)]
