"""The beam on rings by other programs: hand-written banded matrices, OpenSees, PyNite, scikit-fem.

Each takes the same frame, the stiffness EI (N mm^2) of every element, k (N/mm) of every spring and
the force F (N), and gives the deflection under F (mm) and the force of every spring against it (N).
"""

import ctypes
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpbsv
from scipy.sparse import diags_array


class Frame(NamedTuple):
    """A beam clamped at 0, on springs.

    Attributes:
        nodes: places behind the clamp, mm; one element ends at each.
        rings: numbers of the nodes on a spring.
        loaded: number of the node under the force.
        clamped_end: whether the last node is clamped too, or free.
    """

    nodes: np.ndarray
    rings: list[int]
    loaded: int
    clamped_end: bool


class Banded:
    """Hermite beam elements on rings and the loaded point; upper banded storage, 3 off-diagonals.

    Springs, loads and clamps are written into kept arrays; assembly is five slices per solve.
    """

    def __init__(self, frame: Frame):
        """What does not change: lengths of the elements and where springs and load go."""
        self.h = np.diff(frame.nodes, prepend=0.0)
        self.count = len(frame.nodes) - frame.clamped_end
        self.rings, self.load = 2 * np.asarray(frame.rings), 2 * frame.loaded

    def solve(self, EI, k, F, solver):
        """Displacement at the load and reactions of the springs."""
        h, m = self.h, self.count
        EI_h = EI / h
        r = 6 * EI_h / h
        t = 2 * r / h
        band = np.zeros((4, 2 * m))
        band[3, 0::2] = t[:m]
        band[3, 0 : 2 * (len(h) - 1) : 2] += t[1:]
        band[3, 1::2] = 4 * EI_h[:m]
        band[3, 1 : 2 * (len(h) - 1) : 2] += 4 * EI_h[1:]
        band[3, self.rings] += k
        band[2, 1::2] = -r[:m]
        band[2, 1 : 2 * (len(h) - 1) : 2] += r[1:]
        band[1, 2::2] = -t[1:m]
        band[1, 3::2] = 2 * EI_h[1:m]
        band[2, 2::2] = -r[1:m]
        band[0, 3::2] = r[1:m]
        f = np.zeros(2 * m)
        f[self.load] = F
        u = solver(band, f)
        return u[self.load], k * u[self.rings]


def with_dpbsv(band, f):
    """LAPACK's banded Cholesky without scipy's checks."""
    return dpbsv(band, f, overwrite_ab=1, overwrite_b=1)[1]


def _load_opensees():
    """The module; on Linux after the libraries that come with it and that it does not find."""
    found = importlib.util.find_spec("openseespylinux")
    try:
        if found is not None and found.origin is not None:
            folder = Path(found.origin).parent / "lib"
            for name in ("libquadmath.so.0", "libgfortran.so.4", "libblas.so.3", "liblapack.so.3"):
                ctypes.CDLL(str(folder / name), mode=ctypes.RTLD_GLOBAL)
        import openseespy.opensees as ops
    except (OSError, RuntimeError) as error:
        raise ImportError(f"OpenSees could not be loaded: {error}") from error
    return ops


def opensees(frame: Frame, EI, k, F) -> Callable:
    """The frame in OpenSees, built once; returns a function reset + analyze + reactions.

    OpenSees holds one model per process: a function returned before this call is of no more use.

    Raises:
        ImportError: OpenSees or one of its libraries cannot be loaded.
    """
    ops = _load_opensees()
    nodes = frame.nodes
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    ops.geomTransf("Linear", 1)
    ops.node(1, 0.0, 0.0)
    ops.fix(1, 1, 1, 1)
    for i, x in enumerate(nodes):
        ops.node(i + 2, float(x), 0.0)
        ops.element("elasticBeamColumn", i + 1, i + 1, i + 2, 1e3, 1e3, EI[i] / 1e3, 1)
    ops.fix(len(nodes) + 1, 1, int(frame.clamped_end), int(frame.clamped_end))
    for i, node in enumerate(frame.rings):
        ops.uniaxialMaterial("Elastic", i + 1, k[i])
        ops.node(1000 + i, float(nodes[node]), 0.0)
        ops.fix(1000 + i, 1, 1, 1)
        pair = (1000 + i, int(node) + 2)
        ops.element("zeroLength", 1000 + i, *pair, "-mat", i + 1, "-dir", 2)
    ops.timeSeries("Constant", 1)
    ops.pattern("Plain", 1, 1)
    ops.load(frame.loaded + 2, 0.0, F, 0.0)
    ops.system("BandSPD")
    ops.numberer("RCM")
    ops.constraints("Plain")
    ops.integrator("LoadControl", 1.0)
    ops.algorithm("Linear")
    ops.analysis("Static")
    springs = range(1000, 1000 + len(frame.rings))

    def call():
        ops.reset()
        assert ops.analyze(1) == 0
        ops.reactions()
        return ops.nodeDisp(frame.loaded + 2, 2), [-ops.nodeReaction(i, 2) for i in springs]

    return call


def pynite_model(frame: Frame, EI, k, F):
    """The frame in PyNite; what would leave the plane is held at every node."""
    from Pynite import FEModel3D

    model = FEModel3D()
    model.add_material("ligament", 1e3, 1e3, 0.3, 0.0)
    for i, x in enumerate(np.append(0.0, frame.nodes)):
        model.add_node(f"N{i}", float(x), 0.0, 0.0)
        held = i == 0 or (i == len(frame.nodes) and frame.clamped_end)
        model.def_support(f"N{i}", i == 0, held, True, True, True, held)
        if i:
            model.add_section(f"S{i}", 1e3, EI[i - 1] / 1e3, EI[i - 1] / 1e3, 1.0)
            model.add_member(f"M{i}", f"N{i - 1}", f"N{i}", "ligament", f"S{i}")
    for node, stiffness in zip(frame.rings, k, strict=True):
        model.def_support_spring(f"N{node + 1}", "DY", float(stiffness))
    model.add_node_load(f"N{frame.loaded + 1}", "FY", F)
    return model


def pynite(frame: Frame, EI, k, F) -> Callable:
    """The frame in PyNite, built once; returns a function that analyses it.

    The matrix is full and its stability not looked for, which is fastest. The forces are those
    that PyNite gives, not k w: it has had their sign wrong.
    """
    model = pynite_model(frame, EI, k, F)
    tip, springs = f"N{frame.loaded + 1}", [f"N{node + 1}" for node in frame.rings]

    def call():
        model.analyze_linear(sparse=False, check_stability=False)
        at = model.nodes
        return at[tip].DY["Combo 1"], [-at[name].RxnFY["Combo 1"] for name in springs]

    return call


def scikit_fem(frame: Frame) -> Callable:
    """Hermite elements of scikit-fem on a mesh made once; returns a function of EI, k and F.

    It assembles the stiffness of the beam, adds the springs to its diagonal and solves without the
    clamped entries.
    """
    import skfem
    from skfem.helpers import dd, ddot

    mesh = skfem.MeshLine(np.append(0.0, frame.nodes))
    basis = skfem.Basis(mesh, skfem.ElementLineHermite())
    # The mesh numbers its points from left to right; its first two degrees of freedom are w and w'.
    deflection = basis.nodal_dofs[0]
    rings = deflection[np.asarray(frame.rings) + 1]
    loaded = deflection[frame.loaded + 1]
    ends = [0, len(frame.nodes)] if frame.clamped_end else [0]
    clamped = basis.nodal_dofs[:, ends].ravel()
    bending = skfem.BilinearForm(lambda u, v, w: w.EI * ddot(dd(u), dd(v)))

    def call(EI, k, F):
        K = bending.assemble(basis, EI=EI[:, None])
        springs = np.zeros(basis.N)
        springs[rings] = k
        f = np.zeros(basis.N)
        f[loaded] = F
        u = skfem.solve(*skfem.condense(K + diags_array(springs), f, D=clamped))
        return u[loaded], k * u[rings]

    return call
