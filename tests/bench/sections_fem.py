"""Presses anywhere on C-ringed tubes by three-dimensional finite elements: truth for `sections`.

Shares nothing with `jaxtrachea`. Bricks of 20 nodes (serendipity, 2 x 2 x 2 Gauss points) on a grid
in (s, phi, r); compressible neo-Hookean, energy mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2; the
full circumference, and half of a tube that is symmetric about the contact: there u_s = 0, at the
far end u = 0. Wall in front `h` thick, cartilage in its outer `share`, from phi = -alpha to alpha
and `height` along s; muscle `h_M` thick behind, from the same inner radius (its outside tapers over
10 degrees); two-sided bed on the outside of the muscle, of the reference area and normal. Nodes of
the outer surface within `punch` mm of the contact all move by D along the inward normal.

    python tests/bench/sections_fem.py [CASE ...]      writes tests/reference/sections_fem.json

A minute a case (two cores, `pypardiso`, with SciPy's solver ten). N, mm, MPa.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse

try:
    from pypardiso import spsolve
except ImportError:
    from scipy.sparse.linalg import spsolve

OUT = Path(__file__).parents[1] / "reference" / "sections_fem.json"
#: Of a press, over the inner radius; before them the linear solution.
DEPTHS = (0.1, 0.25, 0.4, 0.6)


@dataclass(frozen=True)
class Tube:
    """Geometry, mm and degrees, and moduli, MPa; bed in N/mm^3."""

    inner: float = 10.0
    h: float = 2.6
    share: float = 0.6
    h_M: float = 2.0
    pitch: float = 10.0
    height: float = 4.0
    alpha: float = 120.0
    E_C: float = 5.8
    E_L: float = 0.65
    E_M: float = 0.30
    nu: float = 0.45
    bed_n: float = 0.02
    bed_t: float = 0.002
    punch: float = 3.0
    rings: int = 7  # on either side of the contact, with it


TUBES = {
    "specimen": Tube(),
    "narrow": Tube(inner=6.8, h=2.2, h_M=1.7, pitch=6.0, height=2.8, punch=2.0, E_C=9.0),
    "wide": Tube(inner=11.5, h=2.4, h_M=1.6, pitch=8.0, height=4.4, E_C=4.0, E_L=0.9, E_M=0.2),
    # Within 4 % of the specimen in every proportion, then within a tenth.
    "near": Tube(
        h=2.54, h_M=1.9, pitch=9.65, height=3.98, punch=2.9, E_C=6.0, E_M=0.29, bed_n=0.0195
    ),
    "closer": Tube(
        h=2.45, h_M=1.75, pitch=9.1, height=3.95, punch=2.8, E_C=6.3, E_M=0.275, bed_n=0.0185
    ),
    "farther": Tube(
        h=2.75, h_M=2.28, pitch=10.9, height=4.0, punch=3.15, E_C=5.35, E_M=0.325, bed_n=0.0215
    ),
}

_CORNERS = np.array([[i, j, k] for k in (-1, 1) for j in (-1, 1) for i in (-1, 1)], float)
_EDGES = np.array(
    [[0, j, k] for k in (-1, 1) for j in (-1, 1)]
    + [[i, 0, k] for k in (-1, 1) for i in (-1, 1)]
    + [[i, j, 0] for j in (-1, 1) for i in (-1, 1)],
    float,
)
NODES = np.vstack([_CORNERS, _EDGES])


def slopes(x):
    """Derivatives of the 20 shape functions at points x; (points, 20, 3)."""
    a, y = NODES[None], x[:, None]
    f, d = 1 + a * y, a + 0 * y
    out = np.zeros((len(x), 20, 3))
    total = (a * y).sum(2) - 2
    for n in range(3):
        i, j = (n + 1) % 3, (n + 2) % 3
        corner = d[..., n] * f[..., i] * f[..., j] * (total + f[..., n]) / 8
        # Of an edge along axis e the factor is 1 - x_e^2 in the place of 1 + a x.
        g = np.where(a == 0, 1 - y**2, f)
        dg = np.where(a == 0, -2 * y, d)
        edge = dg[..., n] * g[..., i] * g[..., j] / 4
        out[:, :, n] = np.where(np.arange(20) < 8, corner, edge)
    return out


def fill(lines, longest):
    """Grid lines with more between them: none further apart than `longest` allows there."""
    out = [lines[0]]
    for a, b in zip(lines[:-1], lines[1:], strict=True):
        n = int(np.ceil((b - a) / longest(a, b) - 1e-9))
        out += list(a + (b - a) * np.arange(1, n + 1) / n)
    return np.array(out)


def grid(tube, phi_c, on_ring):
    """Lines along s (0: the contact), phi (degrees) and in 0..1 across the wall."""
    R = tube.inner + tube.h
    first = 0.0 if on_ring else tube.pitch / 2
    middle = first + tube.pitch * np.arange(tube.rings)
    ends = np.concatenate([middle - tube.height / 2, middle + tube.height / 2])
    length = middle[-1] + tube.pitch
    lines = np.unique(np.round([0, tube.punch, *ends[ends > 0], length], 9))
    near = 2.2 * tube.punch
    s = fill(
        lines,
        lambda a, b: (
            1.01 if b <= tube.punch else 1.5 if a < near else 3 if a < 2.4 * tube.pitch else 6.1
        ),
    )
    half = np.degrees(tube.punch / R)
    al = tube.alpha
    fixed = [-180, -al - 10, -al, al, al + 10, 180.0]
    patch = phi_c + half * np.linspace(-1, 1, 7)
    # Round the patch the grid is finer. The border of the ring is a line: one near gives way to it.
    patch = [phi_c - half - 14, *patch, phi_c + half + 14]
    patch = [p for p in patch if min(abs(p - f) for f in fixed) > 1.2 and abs(p) < 180]
    lines = np.sort([*fixed, *patch])

    def longest(a, b):
        near = max(a - phi_c - half, phi_c - half - b)
        return 7.1 if near < 8 else 13.0 if max(abs(a), abs(b)) <= al else 12.0

    return s, fill(lines, longest), np.array([0, 1 - tube.share, 1]), middle


def mesh(tube, phi_c, on_ring):
    """Rest coordinates (nodes, 3) with parameters, cells (n, 20) and the material of each."""
    s, phi, r, middle = grid(tube, phi_c, on_ring)
    counts = [len(s), len(phi) - 1, len(r)]
    double = [2 * counts[0] - 1, 2 * counts[1], 2 * counts[2] - 1]

    def halves(v):
        return np.interp(np.arange(2 * len(v) - 1) / 2, np.arange(len(v)), v)

    S, P, T = np.meshgrid(halves(s), halves(phi)[:-1], halves(r), indexing="ij")
    i, j, k = np.meshgrid(*[np.arange(n) for n in (counts[0] - 1, counts[1], counts[2] - 1)],
                          indexing="ij")  # fmt: skip
    at = (NODES + 1).astype(int)
    cells = (((2 * i.ravel()[:, None] + at[:, 0]) * double[1]
              + (2 * j.ravel()[:, None] + at[:, 1]) % double[1]) * double[2]
             + 2 * k.ravel()[:, None] + at[:, 2])  # fmt: skip
    mid_s, mid_p = (s[1:] + s[:-1])[i.ravel()] / 2, np.abs((phi[1:] + phi[:-1])[j.ravel()] / 2)
    behind = mid_p > tube.alpha
    in_ring = np.abs(mid_s[:, None] - middle).min(1) < tube.height / 2
    kind = np.where(behind, 2, np.where(in_ring & (k.ravel() > 0), 0, 1))
    used, cells = np.unique(cells, return_inverse=True)
    cells = cells.reshape(-1, 20)
    par = np.stack([v.ravel()[used] for v in (S, P, T)], 1)
    taper = np.clip((np.abs(par[:, 1]) - tube.alpha) / 10, 0, 1)
    radius = tube.inner + par[:, 2] * (tube.h + taper * (tube.h_M - tube.h))
    angle = np.radians(par[:, 1])
    rest = np.stack([par[:, 0], radius * np.cos(angle), radius * np.sin(angle)], 1)
    return rest, par, cells, kind


def bed_matrix(tube, rest, par, cells):
    """Stiffness of the bed, on the outer faces behind."""
    face = np.flatnonzero(NODES[:, 2] == 1)
    outer = np.abs(par[cells[:, face], 2] - 1).max(1) < 1e-9
    behind = np.abs(par[cells[:, face], 1]).min(1) > tube.alpha - 1e-6
    # The cell across phi = 180 has nodes at -180.
    behind |= np.abs(par[cells[:, face], 1]).max(1) > 179.9
    some = cells[outer & behind][:, face]
    p, w = np.polynomial.legendre.leggauss(3)
    rows, columns, values = [], [], []
    for x, wx in zip(p, w, strict=True):
        for y, wy in zip(p, w, strict=True):
            point = np.array([[x, y, 1.0]])
            d = slopes(point)[0][face]
            a, b = NODES[face, 0], NODES[face, 1]
            corner = (1 + a * x) * (1 + b * y) * (a * x + b * y - 1) / 4
            edge = np.where(a == 0, (1 - x * x) * (1 + b * y), (1 + a * x) * (1 - y * y)) / 2
            N = np.where((a != 0) & (b != 0), corner, edge)
            t1, t2 = np.einsum("fni,nk->kfi", rest[some], d[:, :2])
            normal = np.cross(t1, t2)
            area = np.linalg.norm(normal, axis=1)
            normal /= area[:, None]
            nn = normal[:, :, None] * normal[:, None]
            K = tube.bed_n * nn + tube.bed_t * (np.eye(3) - nn)
            block = np.einsum("n,m,fij,f->fnimj", N, N, K, area * wx * wy)
            dof = (3 * some[:, :, None] + np.arange(3)).reshape(len(some), -1)
            rows.append(np.repeat(dof, 24, 1).ravel())
            columns.append(np.tile(dof, (1, 24)).ravel())
            values.append(block.reshape(len(some), -1).ravel())
    size = 3 * len(rest)
    triple = [np.concatenate(v) for v in (values, rows, columns)]
    return scipy.sparse.csr_matrix((triple[0], (triple[1], triple[2])), shape=(size, size))


class Solid:
    """Internal forces and stiffness of the bricks."""

    def __init__(self, tube, rest, cells, kind):
        """Slopes of the shape functions at every Gauss point."""
        g = 1 / np.sqrt(3)
        d = slopes(g * _CORNERS)
        X = rest[cells]
        jac = np.einsum("cni,qnj->cqij", X, d)
        self.weight = -np.linalg.det(jac)  # (s, phi, r) is left-handed
        assert self.weight.min() > 0
        self.grad = np.einsum("qnj,cqji->cqni", d, np.linalg.inv(jac))
        E = np.array([tube.E_C, tube.E_L, tube.E_M])[kind][:, None]
        self.mu = E / 2 / (1 + tube.nu)
        self.lam = E * tube.nu / (1 + tube.nu) / (1 - 2 * tube.nu)
        self.dof = (3 * cells[:, :, None] + np.arange(3)).reshape(len(cells), 60)
        self.rows, self.columns = (
            np.repeat(self.dof, 60, 1).ravel(),
            np.tile(self.dof, (1, 60)).ravel(),
        )
        self.size = 3 * len(rest)

    def __call__(self, u, part=500, stiffness=True):
        """Forces (dofs,) and stiffness of displacements (dofs,)."""
        force, values = np.zeros(self.size), []
        eye = np.eye(3)
        for c in range(0, len(self.dof), part):
            at = slice(c, c + part)
            G, w = self.grad[at], self.weight[at]
            mu, lam = self.mu[at][..., None, None], self.lam[at][..., None, None]
            F = eye + np.einsum("cni,cqnj->cqij", u[self.dof[at]].reshape(-1, 20, 3), G)
            T = np.linalg.inv(F).swapaxes(2, 3)
            J = np.linalg.det(F)
            if not J.min() > 0:
                return None, None  # turned inside out
            log = np.log(J)[..., None, None]
            P = mu * (F - T) + lam * log * T
            np.add.at(force, self.dof[at], np.einsum("cq,cqij,cqnj->cni", w, P, G).reshape(-1, 60))
            if not stiffness:
                continue
            g = np.einsum("cqij,cqnj->cqni", T, G)  # F^-T grad N
            m = (
                (G * (w * self.mu[at])[..., None, None])
                .transpose(0, 1, 3, 2)
                .reshape(len(G), -1, 20)
            )
            K = np.einsum(
                "cnm,ij->cnimj",
                m.transpose(0, 2, 1) @ G.swapaxes(2, 3).reshape(len(G), -1, 20),
                eye,
            )
            a = g.reshape(*g.shape[:2], 60)
            K = K.reshape(-1, 60, 60) + (a * (w * self.lam[at])[..., None]).swapaxes(1, 2) @ a
            b = (w * (self.mu[at] - self.lam[at] * log[..., 0, 0]))[..., None] * a
            # (mu - lam ln J) F^-T_il F^-T_kj G_nj G_ml: node and direction change places.
            mixed = (b.swapaxes(1, 2) @ a).reshape(-1, 20, 3, 20, 3).transpose(0, 1, 4, 3, 2)
            values.append((K + mixed.reshape(-1, 60, 60)).ravel())
        if not stiffness:
            return force, None
        K = scipy.sparse.coo_matrix((np.concatenate(values), (self.rows, self.columns)),
                                    shape=(self.size, self.size))  # fmt: skip
        return force, K.tocsr()


def press(tube, phi_c, on_ring):
    """Of a press at phi_c degrees: force per mm of the linear solution, depths, mm, and forces, N.

    Forces are those of the tool, along the inward normal and the circumference.
    """
    rest, par, cells, kind = mesh(tube, phi_c, on_ring)
    solid, bed = Solid(tube, rest, cells, kind), bed_matrix(tube, rest, par, cells)
    c, s = np.cos(np.radians(phi_c)), np.sin(np.radians(phi_c))
    axes = np.array([[0, -c, -s], [0, -s, c]])
    point = -axes[0] * (tube.inner + tube.h)
    outer = np.abs(par[:, 2] - 1) < 1e-9
    patch = outer & (np.linalg.norm(rest - point, axis=1) < tube.punch + 0.02)
    held = np.zeros((len(rest), 3), bool)
    held[np.abs(par[:, 0]) < 1e-9, 0] = True
    held[par[:, 0] > par[:, 0].max() - 1e-9] = True
    held[patch] = True
    free = np.flatnonzero(~held.ravel())
    pushed = np.zeros((len(rest), 3))
    pushed[patch] = axes[0]
    pushed = pushed.ravel()

    def tool(force):
        """Twice what the patch carries: of the other half of the tube as well."""
        return (2 * axes @ force.reshape(-1, 3)[patch].sum(0)).tolist()

    def equilibrium(D, u):
        """State at D from a first guess, and the force of the first step; None: not found."""
        first = None
        for _ in range(8):
            force, K = solid(u)
            if force is None:
                return None
            force, K = force + bed @ u, (K + bed).tocsr()
            gap = D * pushed - u * (pushed != 0)
            du = np.zeros(solid.size)
            du[free] = spsolve(K[free][:, free].tocsr(), -(force + K @ gap)[free])
            du += gap
            first = force + K @ du if first is None else first
            u, size = u + du, np.abs(du).max()
            if size < 2e-3 * D:  # the next step would be of the order of its square
                return u, first
            if not size < tube.inner:
                return None
        return None

    places, states, forces, linear = [0.0], [np.zeros(solid.size)], [], None
    wanted = list(tube.inner * np.array(DEPTHS))[::-1]
    while wanted:
        # Along the polynomial through the last three states.
        D, near = wanted[-1], slice(-min(3, len(places)), None)
        x = np.array(places[near])
        shares = [np.prod((D - np.delete(x, i)) / (x[i] - np.delete(x, i))) for i in range(len(x))]
        u = sum(w * v for w, v in zip(shares, states[near], strict=True))
        found = equilibrium(D, u)
        if found is None:
            wanted.append((places[-1] + D) / 2)
            if wanted[-1] - places[-1] < 0.01 * tube.inner:
                break
            continue
        u, first = found
        linear = [v / D for v in tool(first)] if linear is None else linear
        wanted.pop()
        force, _ = solid(u, stiffness=False)
        places.append(float(D))
        states = [*states[-2:], u]
        forces.append(tool(force + bed @ u))
    return {"dofs": len(free), "patch": int(patch.sum()), "linear": linear,
            "depth": places[1:], "force": forces}  # fmt: skip


def main(names):
    """Press every case that is named as tube:place:angle, or all."""
    known = json.loads(OUT.read_text()) if OUT.exists() else {}
    for name in names:
        key, place, angle = name.split(":")
        start = time.time()
        found = press(TUBES[key], float(angle), place == "ring")
        found = {"tube": asdict(TUBES[key]), **found}
        known[name] = found
        OUT.write_text(json.dumps(known, indent=1) + "\n")
        forces = np.round([found["linear"], *found["force"]], 4).tolist()
        print(name, f"{time.time() - start:.0f} s", found["dofs"], forces, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
