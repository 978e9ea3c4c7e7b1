"""The truth of the hard cases in high precision; writes jaxtrachea/selfcheck/truth.json.

Run from the root of the repository: python tests/reference/hard_cases_truth.py [NAME ...]

Models are written apart from the package: finite elements (`beam_fem`, `spatial_fem`), closed forms
of the cubic, integrals of the arch in closed form, a minimum on the sphere by Newton's method.
Derivatives are central differences with a step of 1e-35 in 260 digits; the two one-sided ones must
agree, so that a kink is noticed (`one_sided` rows take three points on their side).
"""

import functools
import itertools
import json
import sys

import beam_fem
import mpmath as mp
import numpy as np
import spatial_fem
from hard_cases_condition import ONE, STEP, flat, moved, spread

from jaxtrachea.selfcheck.table import TRUTH, Case, read_cases

mp.mp.dps = beam_fem.DIGITS = spatial_fem.DIGITS = 260
KEPT = 25


def cubic_root(a, b, D):
    """Root of a d + b d^3 = D on the branch through 0; trigonometric closed forms."""
    delta = D / a
    u = mp.mpf(27) / 4 * b / a * delta**2
    if u == 0:
        return delta
    r = mp.sqrt(abs(u))
    if u > 0:
        return delta * 3 / r * mp.sinh(mp.asinh(r) / 3)
    return delta * 3 / r * mp.sin(mp.asin(r) / 3)


def cubic(D, c, k_1, k_3):
    """Root of d + c (k_1 d + k_3 d^3) = D."""
    return cubic_root(1 + c * k_1, c * k_3, D)


def series(v):
    d = cubic(v["D"], v["c"], v["k_1"], v["k_3"])
    return {"force": v["k_1"] * d + v["k_3"] * d**3, "depth": d}


def quintic(v):
    """Smallest root of d + c F(d) = |D| among all five, by their polynomial; sign of D."""
    first, size = 1 + v["c"] * v["k_1"], abs(v["D"])
    delta = size / first
    p = [v["c"] * k / first * delta**n for k, n in ((v["k_5"], 4), (v["k_3"], 2))]
    falling = [p[0], 0, p[1], 0, 1, -1]  # of d / delta
    while falling[0] == 0:
        falling.pop(0)
    roots = mp.polyroots(falling, maxsteps=2000, extraprec=2000, asc=False)
    near = mp.mpf(10) ** -80
    real = [mp.re(r) for r in roots if abs(mp.im(r)) < near * abs(r) and mp.re(r) > 0]
    d = mp.sign(v["D"]) * delta * min(real)
    return {"force": v["k_1"] * d + v["k_3"] * d**3 + v["k_5"] * d**5, "depth": d}


def total(v):
    force = v["k_1"] * v["D"] + v["k_3"] * v["D"] ** 3
    return {"force": force, "depth": v["D"] - v["c"] * force}


def first_touch(v):
    x, w = v["D"] - v["onset"], mp.mpf("1e-3")
    t = x / w
    touched = 0 if x <= 0 else x if x >= w else w * t**3 * (6 - 8 * t + 3 * t**2)
    return series(v | {"D": mp.mpf(touched)})


def vector(v):
    """|d| = t from the eigenvalues of C, then d by one linear system."""
    xx, yy, zz, yz, xz, xy = v["C"]
    C, D = mp.matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), mp.matrix(v["D"])
    size = mp.norm(D)
    if size == 0:
        return {"force": [mp.mpf(0)] * 3, "depth": [mp.mpf(0)] * 3}
    values, vectors = mp.eigsy(C)
    parts = [p / size for p in vectors.T * D]
    k_1, k_3 = v["k_1"], v["k_3"] * size**2

    def excess(t):
        kappa = k_1 + k_3 * t * t
        return mp.sqrt(sum((p / (1 + kappa * e)) ** 2 for p, e in zip(parts, values))) - t  # noqa: B905

    if k_3 >= 0:
        low, high = mp.mpf(0), mp.mpf(2)
        for _ in range(120):
            middle = (low + high) / 2
            low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        t = low
    else:
        t = mp.mpf(0)
        for _ in range(200):
            t += excess(t)
    slope_step = t * mp.mpf(10) ** -60
    for _ in range(8):
        t -= excess(t) * slope_step / (excess(t + slope_step) - excess(t))
    kappa = k_1 + k_3 * t * t
    d = list(mp.lu_solve(mp.eye(3) + kappa * C, D))
    return {"force": [kappa * p for p in d], "depth": d}


def _press(v, rings, length):
    x = (np.arange(1, rings + 1) * (length / (rings + 1))).astype(np.float32)
    unit = beam_fem.solve(x, length, [v["EI_L"]] * (rings + 1), [v["k_M"]] * rings, v["s"], ONE)
    solved = first_touch({**v, "onset": mp.mpf(0), "c": unit.w_C})
    reactions = [solved["force"] * r for r in unit.reaction]
    return {**solved, "compliance": unit.w_C, "reactions": reactions}


def press_9(v):
    return _press(v, 9, 100.0)


def press_1(v):
    return _press(v, 1, 100.0)


def compliance_200(v):
    x = (np.arange(1, 201) * (100.5 / 201)).astype(np.float32)
    return {
        "compliance": beam_fem.solve(x, 100.5, [v["EI_L"]] * 201, [v["k_M"]] * 200, v["s"], ONE).w_C
    }


def beam(v):
    got = beam_fem.solve(v["x"], v["length"], v["EI"], v["k"], v["s"], v["F"], v.get("GA"))
    return {"w_C": got.w_C, "theta_C": got.theta_C, "w": got.w, "reaction": got.reaction}


def beam_alone(v):
    w, R = beam_fem.solve_independent(v["x"], v["length"], v["EI"], v["k"], v["s"], v["F"])
    return {"w_C": w, "reaction": R}


def axial(v):
    """Two springs in parallel, each an end spring and bars in a row; stiffnesses, so k = 0 is 0."""
    ends = [mp.mpf(0), *v["x"], v["length"]]
    s = v["s"]

    def bar(a, b):
        spans = zip(ends, ends[1:], v["EA"], strict=False)
        return sum(max(min(q, b) - max(p, a), mp.mpf(0)) / e for p, q, e in spans)

    def flexible(k, c):
        return 1 / c if k == mp.inf else k / (1 + k * c)

    c_A, c_B = bar(mp.mpf(0), s), bar(s, ends[-1])
    held_A, held_B = (k == mp.inf and c == 0 for k, c in ((v["k_A"], c_A), (v["k_B"], c_B)))
    K_A = mp.mpf(0) if held_A else flexible(v["k_A"], c_A)
    K_B = mp.mpf(0) if held_B else flexible(v["k_B"], c_B)
    share = mp.mpf(1) if held_A else mp.mpf(0) if held_B else K_A / (K_A + K_B)
    u_C = mp.mpf(0) if held_A or held_B else v["F"] / (K_A + K_B)
    F_A, F_B = share * v["F"], (1 - share) * v["F"]
    u = [u_C - (F_A * bar(p, s) if p <= s else F_B * bar(s, p)) for p in v["x"]]
    return {"u_C": u_C, "u": u, "force_A": F_A, "force_B": F_B}


def _integral(p, q, a, b):
    """Of (p_0 + p_1 cos + p_2 sin)(q_0 + q_1 cos + q_2 sin) from a to b."""

    def primitive(t):
        return (
            p[0] * q[0] * t
            + (p[0] * q[1] + p[1] * q[0]) * mp.sin(t)
            - (p[0] * q[2] + p[2] * q[0]) * mp.cos(t)
            + p[1] * q[1] * (t / 2 + mp.sin(2 * t) / 4)
            + p[2] * q[2] * (t / 2 - mp.sin(2 * t) / 4)
            + (p[1] * q[2] + p[2] * q[1]) * mp.sin(t) ** 2 / 2
        )

    return primitive(b) - primitive(a)


def arch(R, alpha, EI, k_M, k_t, phi):
    """C, shares (U, V) by load, thrust by load, k_e: docs/model.md, integrals in closed form."""
    y_h, b = R * mp.cos(alpha), R * mp.sin(alpha)
    y_c, z_c = R * mp.cos(phi), R * mp.sin(phi)
    rise = (-R * mp.cos(alpha), R, mp.mpf(0))
    shares, pieces = [], []
    for P_y, P_z in ((1, 0), (0, 1)):
        S_V = mp.mpf(P_y) / 2 + (z_c * P_y - (y_c - y_h) * P_z) / (2 * b)
        shares.append((P_y - S_V, S_V))
        beyond = (b * S_V - y_h * P_z / mp.mpf(2), R * P_z / mp.mpf(2), -R * S_V)
        before = (beyond[0] - z_c * P_y + y_c * P_z, beyond[1] - R * P_z, beyond[2] + R * P_y)
        pieces.append((before, beyond))

    def over(p, q):
        return _integral(p[0], q[0], -alpha, phi) + _integral(p[1], q[1], phi, alpha)

    H_H, k_e = over((rise, rise), (rise, rise)), k_t + k_M / 4
    give = H_H + EI / (R * k_e)
    with_H = [over(m, (rise, rise)) for m in pieces]
    thrust = [-w / give for w in with_H]
    C = [[R / EI * (over(m, n) - a * c / give) for n, c in zip(pieces, with_H, strict=True)]
         for m, a in zip(pieces, with_H, strict=True)]  # fmt: skip
    for i in range(2):
        for j in range(2):
            C[i][j] += 2 / k_M * sum(p * q for p, q in zip(shares[i], shares[j], strict=True))
    C[1][1] += 1 / k_M
    return C, shares, thrust, k_e


def ring(v):
    names = ("R", "alpha", "EI", "k_M", "k_t", "phi")
    C, shares, thrust, k_e = arch(*(v[n] for n in names))
    P, k_M = v["P"], v["k_M"]

    def load(w):
        return sum(p * q for p, q in zip(P, w, strict=True))

    opening, shift = load(thrust) / k_e, P[1] / k_M
    U, V = (2 * load([s[e] for s in shares]) / k_M for e in (0, 1))
    ends = {"end_U": [U, shift - opening / 2], "end_V": [V, shift + opening / 2]}
    return {"C": C, **ends, "opening": opening, "tie": v["k_t"] * opening}


def oblique(v):
    n, length = 5, 60.0
    x = [mp.mpf(float(p)) for p in (np.arange(1, n + 1) * (length / (n + 1))).astype(np.float32)]
    alpha = mp.mpf(float(np.float32(2)))
    C = arch(mp.mpf(11.25), alpha, v["EI_C"], v["k_M"], v["k_t"], v["phi"])[0]
    EI = [[v["EI_L"]] * 2] * (n + 1)
    columns = [spatial_fem.solve(x, length, EI, [C] * n, v["s"], f).w_C for f in ((1, 0), (0, 1))]
    bars = {"x": x, "length": mp.mpf(60), "EA": [v["EA_L"]] * (n + 1), "F": ONE}
    along = axial({**v, **bars})["u_C"]
    zero = mp.mpf(0)
    whole = [along, columns[0][0], columns[1][1], columns[0][1], zero, zero]
    got = vector({**v, "C": whole})
    moved = [D - d for D, d in zip(v["D"], got["depth"], strict=True)]
    return {"force": got["force"], "skeleton": moved}


def spheres(v):
    return {"distance": mp.norm(mp.matrix(v["t"])) - v["r_A"] - v["r_B"]}


def _rotation(w):
    angle = mp.norm(mp.matrix(w))
    x, y, z = w
    K = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < mp.mpf(10) ** -30:
        return mp.eye(3) + K + K * K / 2
    return mp.eye(3) + mp.sin(angle) / angle * K + (1 - mp.cos(angle)) / angle**2 * K * K


def _cross(a, b):
    i, j, k = (a[p] * b[q] - a[q] * b[p] for p, q in ((1, 2), (2, 0), (0, 1)))
    return mp.matrix([i, j, k])


def boxes(v):
    """Minimum over the sphere of the smoothed support of the difference: logarithms of cosh."""
    A, B, t, beta, R = v["A"], v["B"], mp.matrix(v["t"]), v["beta"], _rotation(v["turn"])

    def value(n):
        m = R.T * n

        def log(y):
            return abs(y) + mp.log1p(mp.exp(-2 * abs(y)))

        both = sum(log(beta * a * n[i]) + log(beta * B[i] * m[i]) for i, a in enumerate(A))
        return both / beta - (n.T * t)[0]

    def slope(n):
        m = R.T * n
        far = mp.matrix([a * mp.tanh(beta * a * n[i]) for i, a in enumerate(A)])
        return far + R * mp.matrix([b * mp.tanh(beta * b * m[i]) for i, b in enumerate(B)]) - t

    key = tuple(float(c) for c in [*A, *B, *v["t"], *v["turn"], beta])
    start = _STARTS.setdefault(key, None) or _descend(value, t, R)
    _STARTS[key] = start
    helper = mp.matrix([1, 0, 0] if abs(start[0]) < 0.8 else [0, 1, 0])
    e1 = _cross(start, helper)
    e1 /= mp.norm(e1)
    e2 = _cross(start, e1)

    def along(p, q):
        n = start + p * e1 + q * e2
        length = mp.norm(n)
        n /= length
        g = slope(n)
        tangential = g - (n.T * g)[0] * n
        return (tangential.T * e1)[0], (tangential.T * e2)[0]

    p, q = _newton(along)
    n = start + p * e1 + q * e2
    return {"distance": -value(n / mp.norm(n))}


#: Estimates of the normal by the inputs as floats, the same for a point and its neighbours.
_STARTS = {}


def _newton(function):
    """Root of two functions of two numbers from (0, 0); forward differences for the slopes."""
    h, x = mp.mpf(10) ** -60, mp.matrix([0, 0])
    for _ in range(60):
        f = mp.matrix(function(*x))
        J = mp.matrix(2, 2)
        for j in range(2):
            moved = x.copy()
            moved[j] += h
            J[:, j] = (mp.matrix(function(*moved)) - f) / h
        step = mp.lu_solve(J, f)
        x -= step
        if mp.norm(step) < mp.mpf(10) ** -110:
            return x
    raise RuntimeError("no minimum found")


def _descend(value, t, R):
    """A float estimate of the lowest minimum: many starts, then a pattern search."""

    def cast(n):
        return mp.matrix([mp.mpf(float(c)) for c in n])

    with mp.workdps(30):
        turned = [np.array([float(R[i, j]) for i in range(3)]) for j in range(3)]
        axes = [*np.eye(3), *turned, np.array([float(c) for c in t])]
        axes += [np.cross(p, q) for p in np.eye(3) for q in turned]
        rng = np.random.default_rng(0)
        axes = [a for a in axes if np.linalg.norm(a) > 1e-9] + list(rng.normal(size=(100, 3)))
        starts = [sign * a / np.linalg.norm(a) for a in axes for sign in (1, -1)]
        best = min(starts, key=lambda n: value(cast(n)))
        size, low = 0.1, value(cast(best))
        while size > 1e-13:
            trials = best + size * np.vstack([np.eye(3), -np.eye(3), rng.normal(size=(4, 3))])
            trials /= np.linalg.norm(trials, axis=1)[:, None]
            values = [value(cast(n)) for n in trials]
            i = int(np.argmin(values))
            if values[i] < low:
                low, best = values[i], trials[i]
            else:
                size /= 2
    return cast(best / np.linalg.norm(best))


def _wendland(dx, dy, reach):
    square = (dx * dx + dy * dy) / reach**2
    q = mp.sqrt(square)
    return (1 - q) ** 4 * (4 * q + 1) if q < 1 else mp.mpf(0)


def dent(v):
    """Without the ridge; repeated centres are one, with the mean of their targets."""
    at = {}
    for x, y, target in zip(v["cx"], v["cy"], v["target"], strict=True):
        near = next((k for k in at if abs(k[0] - x) + abs(k[1] - y) < mp.mpf(10) ** -30), (x, y))
        at.setdefault(near, []).append(target)
    centres = list(at)
    rhs = mp.matrix([sum(t) / len(t) for t in at.values()])
    n = len(centres)

    def psi(p, c):
        return _wendland(p[0] - c[0], p[1] - c[1], v["reach"])

    K = mp.matrix(n, n)
    for i in range(n):
        for j in range(n):
            K[i, j] = psi(centres[i], centres[j])
    w = mp.lu_solve(K, rhs)
    points = zip(v["px"], v["py"], strict=True)
    return {"u": [sum(w[j] * psi(p, c) for j, c in enumerate(centres)) for p in points]}


def _line(nodes, values, s):
    i = max(j for j in range(len(nodes) - 1) if nodes[j] <= s or j == 0)
    t = (s - nodes[i]) / (nodes[i + 1] - nodes[i])
    return values[i] + t * (values[i + 1] - values[i])


def global_shape(v):
    nodes, zero = [mp.mpf(0), *v["x"], v["length"]], mp.mpf(0)
    U, J, V = ([zero, *v[n], zero] for n in ("U", "J", "V"))
    below = sum(1 for p in v["x"] if p <= v["s_c"])
    with_C = nodes[: below + 1] + [v["s_c"]] + nodes[below + 1 :]
    J = J[: below + 1] + [v["w_C"]] + J[below + 1 :]
    keep = [i for i in range(len(with_C)) if i == 0 or with_C[i] > with_C[i - 1]]
    with_C, J = [with_C[i] for i in keep], [J[i] for i in keep]
    alpha, phi_c, out = v["alpha"], v["phi_c"], []
    narrow = mp.mpf("0.05")
    to_U, to_V = max(alpha, narrow - phi_c), max(alpha, narrow + phi_c)
    for s, phi in zip(v["s"], v["phi"], strict=True):
        u, j, w = _line(nodes, U, s), _line(with_C, J, s), _line(nodes, V, s)
        if -to_U <= phi <= phi_c:
            t = (phi + to_U) / (phi_c + to_U)
            out.append((1 - t) * u + t * j)
        elif phi_c <= phi <= to_V:
            t = (to_V - phi) / (to_V - phi_c)
            out.append((1 - t) * w + t * j)
        else:
            gap = 2 * mp.pi - to_U - to_V
            t = (phi - to_V if phi > 0 else -phi - to_U) / gap
            near, far = (w, u) if phi > 0 else (u, w)
            out.append((1 - t) * near + t * far)
    return {"u": out}


def on_ring_weight(v):
    rest = ONE
    for x in v["x"]:
        t = min(abs(v["s"] - x) / v["transition"], ONE)
        rest *= 1 - (1 - t * t) ** 3
    return {"weight": 1 - rest}


def friction(v):
    """On the cone with equal tangential compliances: one press in series, by sqrt(1 + mu^2)."""
    a, b = v["C"]
    zero = mp.mpf(0)
    if v["D"][0] <= 0:
        return {"force": [zero] * 3, "slip": v["D"][1:]}
    D = [v["D"][0], v["D"][1] - v["slip"][0], v["D"][2] - v["slip"][1]]
    stuck = vector({**v, "D": D, "C": [a, b, b, zero, zero, zero]})["force"]
    if mp.hypot(*stuck[1:]) <= v["mu"] * stuck[0]:
        return {"force": stuck, "slip": v["slip"]}
    lean, far = mp.sqrt(1 + v["mu"] ** 2), mp.hypot(*D[1:])
    depth = cubic(lean * D[0], a, v["k_1"], v["k_3"])
    N, d_n = (v["k_1"] * depth + v["k_3"] * depth**3) / lean, depth / lean
    u = [p / far for p in D[1:]]
    slid = far - v["mu"] * (d_n + b * N)
    slip = [s + slid * p for s, p in zip(v["slip"], u, strict=True)]
    return {"force": [N, *(v["mu"] * N * p for p in u)], "slip": slip}


def overload(v, elastic):
    """The branches at the last time: the superposition integral of ramps and jumps."""
    time = v["time"][: len(elastic)]
    end, total = time[-1], v["gamma"][0] * 0
    before = list(zip([time[0], *time], [mp.mpf(0), *elastic], strict=False))
    for (t_0, e_0), t_1, e_1 in zip(before, time, elastic, strict=False):
        for gamma, tau in zip(v["gamma"], v["tau"], strict=True):
            total += gamma * (e_1 - e_0) * kept(t_0, t_1, end, tau)
    return total


@functools.cache
def kept(t_0, t_1, end, tau):
    """Share at the time `end` of what a branch gets evenly from t_0 to t_1 (equal: at once)."""
    x = (t_1 - t_0) / tau
    return mp.exp(-(end - t_1) / tau) * (-mp.expm1(-x) / x if x != 0 else 1)


@functools.cache
def touched(D, c, k_1, k_3):
    """Elastic force and depth."""
    got = first_touch({"D": D, "c": c, "k_1": k_1, "k_3": k_3, "onset": mp.mpf(0)})
    return got["force"], got["depth"]


@functools.cache
def one_ring(EI_L, k_M):
    """Compliance in the middle of 100 mm, where the ring is."""
    return beam_fem.solve([50.0], 100.0, [EI_L] * 2, [k_M], 50.0, ONE).w_C


def in_time(v):
    """Elastic presses, then the integral; where it would pull, the surface at which F = 0."""
    c = one_ring(v["EI_L"], v["k_M"])
    elastic, force, depth = [], [], []
    for D in v["D"]:
        e, d = touched(D, c, v["k_1"], v["k_3"])
        F = e + overload(v, [*elastic, e])
        if F < 0:
            rest = overload(v, [*elastic, mp.mpf(0)])
            e = -rest / (1 + overload(v, [*elastic, ONE]) - rest)
            F, d = mp.mpf(0), cubic_root(v["k_1"], v["k_3"], e)
        elastic.append(e)
        force.append(F)
        depth.append(d)
    return {"force": force, "depth": depth}


def contacts(v):
    """Three tools: of all sets that may touch the one in which all press and no other would."""
    D, C, there = v["D"], v["C"], [t > 0 for t in v["there"]]
    free = [D[i] if t else mp.mpf(0) for i, t in enumerate(there)]
    for on in itertools.product([True, False], repeat=3):
        if any(o and not t for o, t in zip(on, there, strict=True)):
            continue
        which = [i for i in range(3) if on[i]]
        F = _pressing(which, D, C, v) if which else []
        force = [mp.mpf(0)] * 3
        for i, f in zip(which, F, strict=True):
            force[i] = f
        depth = [
            free[i] - (mp.fsum(C[i][j] * force[j] for j in which) if there[i] else 0)
            for i in range(3)
        ]
        if all(depth[i] > 0 if on[i] else depth[i] <= 0 for i in range(3) if there[i]):
            return {"force": force, "depth": depth}
    raise ValueError("no set of contacts is in balance")


def _pressing(which, D, C, v):
    """Forces of tools that all press, by Newton's method on the depths."""
    k_1, k_3 = ([v[n][i] for i in which] for n in ("k_1", "k_3"))
    d = mp.matrix([D[i] / (1 + C[i][i] * k) for i, k in zip(which, k_1, strict=True)])

    def law(d):
        return [a * x + b * x**3 for a, b, x in zip(k_1, k_3, d, strict=True)]

    for _ in range(400):
        F, E = law(d), [a + 3 * b * x * x for a, b, x in zip(k_1, k_3, d, strict=True)]
        c = [[C[i][j] for j in which] for i in which]
        off = [
            D[i] - x - mp.fsum(p * f for p, f in zip(row, F, strict=True))
            for i, x, row in zip(which, d, c, strict=True)
        ]
        slope = mp.matrix([[p * e for p, e in zip(row, E, strict=True)] for row in c])
        step = mp.lu_solve(mp.eye(len(which)) + slope, mp.matrix(off))
        d += step
        if mp.norm(step) <= mp.mpf(10) ** -250 * mp.norm(d):
            return law(d)
    raise ValueError("Newton's method does not converge")


MODELS = {
    f.__name__: f
    for f in (
        series, quintic, total, first_touch, vector, press_9, press_1, compliance_200, beam,
        beam_alone, axial, ring, oblique, spheres, boxes, dent, global_shape, on_ring_weight,
        friction, in_time, contacts,
    )
} | {"beam_shear": beam}  # fmt: skip


def lifted(value):
    """Floats of nested lists as exact numbers."""
    return [lifted(v) for v in value] if isinstance(value, list) else mp.mpf(value)


def derivative(case: Case, inputs, name, index, base):
    """Of all outputs, flat, by one number."""
    model, x = MODELS[case.function], np.asarray(case.inputs[name], float)[index]
    if np.isinf(x):
        return {o: [mp.mpf(0)] * len(flat(v)) for o, v in base.items()}
    h = STEP * (abs(mp.mpf(float(x))) if x != 0 else ONE)

    def at(step):
        return {o: flat(v) for o, v in model(moved(inputs, name, index, step)).items()}

    if name in case.one_sided:
        h *= case.one_sided[name]
        near, far = at(h), at(2 * h)

        def slope(p, q, r):
            return (-3 * p + 4 * q - r) / (2 * h)

        sides = {o: zip(flat(v), near[o], far[o], strict=True) for o, v in base.items()}
        out = {o: [slope(*three) for three in side] for o, side in sides.items()}
        return {o: [v if abs(v) > mp.mpf(10) ** -45 else 0 for v in row] for o, row in out.items()}
    up, down, out = at(h), at(-h), {}
    for o, v in base.items():
        here = flat(v)
        ahead = [(p - q) / h for p, q in zip(up[o], here, strict=True)]
        behind = [(q - r) / h for q, r in zip(here, down[o], strict=True)]
        size = max(map(abs, ahead + behind))
        gap = max(abs(p - q) for p, q in zip(ahead, behind, strict=True))
        if gap > mp.mpf(10) ** -18 * size + mp.mpf(10) ** -28 and (
            f"{o} by {name}" not in case.free
        ):
            raise RuntimeError(f"{case.name}: {o} has a kink in {name}{list(index)}")
        # Both sides next to 0 and yet different: what is left of a step where the truth is 0.
        gone = gap > mp.mpf(10) ** -18 * size
        out[o] = [0 if gone else (p + q) / 2 for p, q in zip(ahead, behind, strict=True)]
    return out


def truth(case: Case):
    """Values and derivatives as strings, in the shapes (*output) and (*output, *input)."""
    inputs = {n: lifted(v) for n, v in case.inputs.items()}
    base = MODELS[case.function](inputs)

    def text(v):
        return mp.nstr(v, KEPT) if v != 0 else "0.0"

    gradient = {o: {} for o in base}
    for name, value in case.inputs.items():
        if name in case.constant or name in case.free:
            continue
        shape = np.shape(value)
        columns = [derivative(case, inputs, name, index, base) for index in np.ndindex(shape)]
        for o, v in base.items():
            if f"{o} by {name}" in case.free:
                continue
            rows = np.array([[text(c) for c in column[o]] for column in columns], object).T
            gradient[o][name] = rows.reshape((*np.shape(v), *shape)).tolist()

    def as_text(v):
        return [as_text(q) for q in v] if isinstance(v, list) else text(v)

    return {"inputs": {n: repr(v) for n, v in case.inputs.items()},
            "value": {o: as_text(v) for o, v in base.items()}, "gradient": gradient,
            "spread": spread(MODELS[case.function], case, inputs, base)}  # fmt: skip


def main(names):
    """Make what is missing or made for other inputs; `names` anew."""
    known = json.loads(TRUTH.read_text())["cases"] if TRUTH.is_file() else {}
    made = dict(known)
    for case in read_cases():
        if not case.answer:
            continue
        old = known.get(case.name)
        given = {n: repr(v) for n, v in case.inputs.items()}
        same = old is not None and old["inputs"] == given and case.name not in names
        known_by = {
            f"{o} by {i}" for o, by in (old or {"gradient": {}})["gradient"].items() for i in by
        }
        unchanged = same and known_by == {
            f"{o} by {i}"
            for o in old["value"]
            for i in set(case.inputs) - set(case.constant) - set(case.free)
        } - set(case.free)
        print(case.name, "kept" if unchanged else "...", flush=True)
        try:
            made[case.name] = old if unchanged else truth(case)
        except Exception as error:
            print("FAILED", repr(error)[:300], flush=True)
        _write(made)


def _write(made):
    source = (
        f"Written by tests/reference/hard_cases_truth.py: independent models in {mp.mp.dps} "
        f"decimal digits (mpmath {mp.__version__}), {KEPT} digits kept. Inputs are exact."
    )
    made = {c.name: made[c.name] for c in read_cases() if c.name in made}
    rows = ",\n".join(f"{json.dumps(n)}: {json.dumps(r)}" for n, r in made.items())
    TRUTH.write_text(f'{{"source": {json.dumps(source)}, "cases": {{\n{rows}\n}}}}\n')


if __name__ == "__main__":
    main(sys.argv[1:])
