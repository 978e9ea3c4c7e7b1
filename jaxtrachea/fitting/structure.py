r"""Structure: which unknowns the curves can tell at all, from contact points, markers and options.

A curve sees the unknowns through its inputs alone: the compliance of the skeleton at the contact,
the coefficients of the local law, onset and offset, and the motion of the marked rings under a unit
force. With J the derivative of the inputs by the unknowns, in relative coordinates, and V the
combinations of inputs that one curve (however exact and deep) can tell apart, an unknown is
structurally non-identifiable (Raue et al. 2009, doi:10.1093/bioinformatics/btp358) if it has a part
in the null space of V J at generic points. Neither measured forces nor noise nor an estimate enter.
The rank is the largest over points drawn in a box around the initial guess: at single points
distant positions may see the same compliance to rounding.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import full_precision
from jaxtrachea._threads import made_once
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.parameters import SKELETON
from jaxtrachea.fitting.residual import Inputs, inputs, of_trials, residual
from jaxtrachea.fitting.starts import box
from jaxtrachea.fitting.study import Study
from jaxtrachea.mechanics.force_law import Law, coefficient
from jaxtrachea.mechanics.levels.level import Closed
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.optimisation.batching import PATHS, max_slots
from jaxtrachea.relaxation.laws import names

#: Points of the parameter box, and half its width in decades.
POINTS, DECADES = 8, 2.0
#: Likewise of a level without a closed form, so that its presses have an equilibrium.
DECADES_OF_PATHS = 0.3
#: Ratio of singular values, and part of an unknown in a direction, that are taken as zero.
ZERO, NO_PART = 1e-7, 1e-3
#: Tool displacements of a generic curve, mm; with c and the law's k_n near 1 it is as bent as can
#: be.
_GENERIC_DEPTHS = np.linspace(0.2, 3.0, 24)


class Structure(NamedTuple):
    """What the curves of every lane leave open whatever they measure.

    Attributes:
        undetermined: unknowns with a part in the null space; (lanes, P).
        nullity: dimension of the null space; (lanes,).
        pinned: as many unknowns of each lane as its nullity; with these held the others are
            determined; (lanes, P).
    """

    undetermined: Bool[np.ndarray, "lanes P"]
    nullity: Int[np.ndarray, " lanes"]
    pinned: Bool[np.ndarray, "lanes P"]

    def take(self, lanes: Int[np.ndarray, " n"]) -> "Structure":
        """Rows of some lanes."""
        return Structure(*(v[lanes] for v in self))


def nothing_open(study: Study) -> Structure:
    """As if every lane could tell all of its unknowns."""
    none = np.zeros(study.lanes.lower.shape, bool)
    return Structure(none, np.zeros(len(none), int), none.copy())


def structure_of(study: Study, lanes: Bool[np.ndarray, " lanes"]) -> Structure:
    """`structure` of some lanes (of all, if joint and any), the others taken as determined."""
    if study.joint and lanes.any():
        return structure(study)
    known, rows = nothing_open(study), np.flatnonzero(lanes)
    if len(rows):
        for old, new in zip(known, structure(study.take(rows)), strict=True):
            old[rows] = new
    return known


def suspicious(study: Study) -> Bool[np.ndarray, " lanes"]:
    """Lanes that may leave something open: a count of positions, which needs no program.

    Of a level without a closed form none: nothing is counted there. Whatever this misses shows in a
    singular Jacobian at the estimate: one that is regular proves the full rank.
    """
    lanes = study.lanes
    if study.model.level.closed is None:
        return np.zeros(len(lanes.s_c), bool)
    beam = sum(p.name in SKELETON for p in study.free)
    places = positions(study)
    if "joints" in lanes.others:
        marked = (lanes.others["joints"].precision > 0).any(axis=2).sum(axis=2)
        places = places + marked.max(axis=1)
    names = {p.name for p in study.free}
    needed = beam
    if not _hardens(study):  # a slope of each curve, in place of its shape
        needed += sum(coefficient(name) == "k_1" for name in names)
        if {"onset", "force_offset"} <= names or "force_slope" in names:
            return np.ones(len(places), bool)
    return places < needed


def positions(study: Study) -> Int[np.ndarray, " lanes"]:
    """Different contact positions of each lane; mirror images about the middle are one."""
    lanes, middle = study.lanes, float(study.model.geometry.length) / 2
    observed = (lanes.precision > 0).any(axis=2)
    folded = np.where(observed, np.round(np.abs(lanes.s_c - middle), 6), -1.0)
    folded = np.sort(folded, axis=1)
    new = np.diff(folded, axis=1, prepend=-1.0) > 0  # what is not observed comes first
    return np.sum(new, axis=1)


def structure(study: Study) -> Structure:
    """Rank and null space of every lane at generic points; equal lanes are computed once."""
    kinds, kind_of = _kinds(study)
    points = _points(study)
    bases = [null_spaces(study, kinds, points[kinds, k]) for k in range(POINTS)]
    if study.joint:
        kind_of = np.arange(len(kind_of))
    nullity = np.min([[len(rows) for rows in of_point] for of_point in bases], axis=0)
    P = study.size
    parts = np.zeros((len(nullity), P))
    pinned = np.zeros((len(nullity), P), bool)
    names = [[p.name for p, _, _ in study.unknowns[k]] for k in kinds]
    for i, least in enumerate(nullity):
        generic = [of_point[i] for of_point in bases if len(of_point[i]) == least]
        if not least:
            continue
        parts[i] = np.mean([np.any(np.abs(rows) > NO_PART, axis=0) for rows in generic], axis=0)
        pinned[i] = pins(names[i], generic[0])
    return Structure(parts[kind_of] > 0.5, nullity[kind_of], pinned[kind_of])


def reduced(study: Study, pinned: Bool[np.ndarray, "lanes P"]) -> Study:
    """The same study with these unknowns held wherever they start."""
    active = np.where(pinned, 0.0, study.lanes.active)
    return dataclasses.replace(study, lanes=study.lanes._replace(active=active))


def pins(names: list[str], null_space: Float[np.ndarray, "r P"]) -> Bool[np.ndarray, " P"]:
    """Unknowns to hold so that no direction of the null space is left.

    Those of the skeleton come first, from the last in the table: with k_M held, EI_L can still
    give any compliance; with EI_L held, k_M cannot.
    """
    size = null_space.shape[1]
    held = np.zeros(size, bool)
    order = [i for i in reversed(range(len(names))) if names[i] in SKELETON]
    order += [i for i in reversed(range(len(names))) if names[i] not in SKELETON]
    rest = null_space
    for i in order:
        if not len(rest):
            break
        if np.max(np.abs(rest[:, i])) > 0.1:
            held[i] = True
            rest = leaving_alone(rest, i)
    return held


def leaving_alone(null_space: Float[np.ndarray, "r P"], i: int) -> Float[np.ndarray, "q P"]:
    """Directions of a null space, orthonormal rows, that leave unknown i alone."""
    column = null_space[:, i : i + 1]
    if not len(null_space) or np.max(np.abs(column)) <= NO_PART:
        return null_space
    _, _, rotation = np.linalg.svd(column.T)
    return rotation[1:] @ null_space


def null_spaces(
    study: Study,
    lanes: Int[np.ndarray, " n"],
    theta: Float[np.ndarray, "n P"],
    nullity: Int[np.ndarray, " n"] | None = None,
) -> list[Float[np.ndarray, "r P"]]:
    """Orthonormal rows that change no curve of each lane, relative coordinates.

    Args:
        study: the study; of a joint one `lanes` are all.
        lanes: whose.
        theta: where, scaled coordinates.
        nullity: of each lane; None: by the singular values.
    """
    J = _seen(study, lanes, theta)
    active = study.lanes.active[lanes] > 0
    if not study.joint:
        ranks = [None] * len(lanes) if nullity is None else nullity
        return [_null(j, a, r) for j, a, r in zip(J, active, ranks, strict=True)]
    return _joint_null_spaces(study, J, active, nullity)


def _null(J, active, nullity=None) -> Float[np.ndarray, "r P"]:
    """Null space of one matrix within the unknowns that exist."""
    columns = np.flatnonzero(active)
    out = np.zeros((0, len(active)))
    if not len(columns):
        return out
    J = J[:, columns]
    J = np.concatenate([J, np.zeros((max(len(columns) - len(J), 0), len(columns)))])
    _, values, vectors = np.linalg.svd(J, full_matrices=False)
    r = int(np.sum(values <= ZERO * max(values[0], 1e-300))) if nullity is None else int(nullity)
    out = np.zeros((r, len(active)))
    out[:, columns] = vectors[len(columns) - r :]
    return out


def _joint_null_spaces(study: Study, J, active, nullity) -> list[np.ndarray]:
    """Null space of the whole study, as each lane sees it: shared unknowns move in all at once."""
    shared, P = study.shared, study.size
    rest = []
    for j, k in zip(J, shared, strict=True):
        own = np.setdiff1d(np.arange(P), k)
        u, values, _ = np.linalg.svd(j[:, own], full_matrices=False)
        basis = u[:, values > ZERO * max(values[0] if len(values) else 0.0, 1e-300)]
        rest.append(np.linalg.qr(j[:, k] - basis @ (basis.T @ j[:, k]), mode="r"))
    common = _null(np.concatenate(rest), np.ones(shared.shape[1], bool))
    out = []
    for i, (j, k) in enumerate(zip(J, shared, strict=True)):
        own = np.setdiff1d(np.arange(P), k)
        both = np.concatenate([j[:, own], j[:, k] @ common.T], axis=1)
        exists = np.concatenate([active[i, own], np.ones(len(common), bool)])
        found = _null(both, exists, None if nullity is None else nullity[i])
        rows = np.zeros((len(found), P))
        rows[:, own] = found[:, : len(own)]
        rows[:, k] = found[:, len(own) :] @ common
        out.append(np.linalg.qr(rows.T)[0].T if len(rows) else rows)
    return out


def _seen(study: Study, lanes, theta) -> Float[np.ndarray, "n m P"]:
    """V J of each lane: all combinations of inputs that its curves tell, by the unknowns."""
    if study.model.level.closed is None:
        return _seen_of_curves(study, lanes, theta)
    bare = without_curves(study)
    batch = bare.batch_size(len(study.curves), max_slots())  # of any lanes: one program
    J = map_lanes(_inputs_by_unknowns, bare, theta, rows=lanes, batch=batch)
    log = _log(study)[lanes]
    J = J * np.where(log, 1.0, np.maximum(np.abs(theta), 1e-3))[:, None, None]
    V = _curve_sees(study)
    n = V.shape[1]
    of_curve = np.einsum("vn,ltnp->ltvp", V, J[:, :, :n])
    motion = J[:, :, n:]
    if "joints" in study.lanes.others:
        visible = (study.lanes.others["joints"].precision[lanes] > 0).any(axis=2)
        motion = motion * visible[..., None]
    observed = (study.lanes.precision[lanes] > 0).any(axis=2)
    J = np.concatenate([of_curve, motion], axis=2) * observed[:, :, None, None]
    return np.nan_to_num(J).reshape(len(lanes), -1, J.shape[-1])


def _seen_of_curves(study: Study, lanes, theta) -> Float[np.ndarray, "n m P"]:
    """Derivative of the curves themselves, every trial in its own natural measure.

    No few numbers stand for a press without a closed form: what its samples tell is decided
    by number, at the displacements of the study, whatever they measured.
    """
    J = map_lanes(
        _curves_by_unknowns, study, theta, rows=lanes, batch=study.batch_size(len(lanes), PATHS)
    )
    log = _log(study)[lanes]
    J = J * np.where(log, 1.0, np.maximum(np.abs(theta), 1e-3))[:, None, None]
    J = np.nan_to_num(J)
    size = np.max(np.linalg.norm(J, axis=3), axis=2)[:, :, None, None]
    return (J / np.where(size > 0, size, 1)).reshape(len(lanes), -1, J.shape[-1])


@full_precision
def _curves_by_unknowns(model: FitModel, theta: Float[Array, " P"], lane: Lane):
    """Derivative of the residual by the unknowns of the lane; (T, m, P)."""
    J = residual(model, theta, lane).jacobian
    unit = jnp.eye(theta.shape[0], dtype=theta.dtype)
    reads = jax.vmap(lambda v: of_trials(model, v, lane))(unit)  # (P, T, Jf)
    return jnp.einsum("tim,pti->tmp", J, reads)


def _inputs_by_unknowns(model: FitModel, theta: Float[Array, " P"], lane: Lane):
    """Derivative of all inputs, each in its natural measure, by the unknowns; (T, n, P)."""

    def relative_inputs(theta):
        x = inputs(model, theta, lane)
        c = jnp.maximum(x.compliance, jnp.finfo(theta.dtype).tiny)
        felt = model.options.coupling == "series"
        k_1, *more = _nonlinear(x)
        rows = [jnp.log(c) if felt else jnp.zeros_like(c), jnp.log(k_1), *more]
        rows += [] if x.force_slope is None else [x.force_slope]
        rows = jnp.stack([*rows, x.contact.onset, x.force_offset], axis=1)
        if x.relaxation is not None:
            rows = jnp.concatenate([rows, jnp.log(x.relaxation)], axis=1)
        if x.joints is None:
            return rows
        size = jnp.max(jnp.abs(jax.lax.stop_gradient(x.joints)), axis=1, keepdims=True)
        return jnp.concatenate([rows, x.joints / size], axis=1)

    _, *higher = _nonlinear(inputs(model, theta, lane))
    J = jax.jacfwd(relative_inputs)(theta)
    for i, k in enumerate(higher):
        J = J.at[:, 2 + i].divide(jnp.where(k != 0, k, 1)[:, None])
    return J


def _nonlinear(x: Inputs) -> list[Array]:
    """Coefficients of the local law, and of a skeleton that softens; (T,) each."""
    law = x.contact.law.coefficients().values()
    return [*law, *(x.contact.softening or ())]


@made_once(maxsize=64)
def _generic(
    closed: Closed, higher: tuple[tuple[str, bool], ...], line: bool
) -> Float[np.ndarray, "r n"]:
    """See `_curve_sees`; of a model with these coefficients above k_1, or zero in their place.

    `line`: whether it has a slope of the force without contact; its curves then begin in the air.
    """

    def curve(v):
        parts = {name: 1.0 * there + v[2 + i] for i, (name, there) in enumerate(higher)}
        bent = [0.1 * parts.pop(name) for name in Softening._fields if name in parts]
        law = Law(**{"k_1": jnp.exp(v[1]), **parts})
        air = [-0.6, -0.4, -0.2] if line else []
        depths, c = jnp.asarray([*air, *_GENERIC_DEPTHS]), jnp.exp(v[0])
        contact = Contact(law, v[-2], softening=Softening(*bent) if bent else None)
        force = closed.respond(depths, c, contact).force + v[-1]
        return force + v[-3] * depths if line else force

    J = np.asarray(jax.jit(jax.jacfwd(curve))(jnp.zeros(4 + len(higher) + line)))
    there = np.array([True, True, *(part for _, part in higher), *[True] * (2 + line)])
    _, values, vectors = np.linalg.svd(J[:, there], full_matrices=False)
    rows = values > 1e-6 * values[0]
    seen = np.zeros((rows.sum(), len(there)))
    seen[:, there] = vectors[rows]
    return seen


def _curve_sees(study: Study) -> Float[np.ndarray, "r n"]:
    """Combinations of (log c, log k_1, k_3, ..., e_1, e_2, onset, offset) one curve tells; rows.

    Before the onset the slope of the force without contact, where the model has one. A record at
    generic times, with a hold or two speeds, tells every number of its relaxation.
    """
    line = any(p.name == "force_slope" for p in study.parameters)
    closed = study.model.level.closed
    assert closed is not None
    V = _generic(closed, tuple(_higher(study).items()), line)
    if not study.model.relaxes:
        return V
    options, n = study.model.options, V.shape[1]
    count = len(names(options.branches, parts=options.relaxation == "parts"))
    return np.concatenate([np.pad(V, ((0, 0), (0, count))), np.eye(count, n + count, n)])


def _higher(study: Study) -> dict[str, bool]:
    """Coefficients above k_1, of the softening too, and whether they are more than a fixed zero."""
    out: dict[str, bool] = {}
    for p in study.parameters:
        name = coefficient(p.name)
        if name is not None and name != "k_1":
            out[name] = out.get(name, False) or not p.fixed or p.value != 0
    law = {name: out[name] for name in Law._fields if name in out}
    deep = [p for p in study.parameters if p.name in Softening._fields]
    return law | {p.name: not p.fixed or p.value != 0 for p in deep}


def _hardens(study: Study) -> bool:
    """Whether the local law is more than a line: a ratio that softens tells no more of it."""
    return any(there for name, there in _higher(study).items() if name in Law._fields)


def _kinds(study: Study) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " lanes"]]:
    """One lane of every kind (all of a joint study), and the kind of each lane."""
    lanes = study.lanes
    count = len(lanes.s_c)
    if study.joint or study.model.level.closed is None:
        return np.arange(count), np.arange(count)  # without a closed form every displacement counts
    marked = lanes.others.get("joints")
    parts = [lanes.s_c, lanes.index, lanes.value, lanes.active, lanes.lower, lanes.upper]
    parts.append((lanes.precision > 0).any(axis=2))
    if marked is not None:
        parts.append((marked.precision > 0).any(axis=2))
    table = np.concatenate([np.asarray(v, float).reshape(count, -1) for v in parts], axis=1)
    _, first, kind = np.unique(table, axis=0, return_index=True, return_inverse=True)
    return first, kind.reshape(-1)


def _points(study: Study) -> Float[np.ndarray, "lanes points P"]:
    """Generic points of every lane's box; shared unknowns are the same in all lanes."""
    _, low, high = box(study, DECADES_OF_PATHS if study.model.level.closed is None else DECADES)
    unit = np.random.default_rng(20091).uniform(0.02, 0.98, (POINTS, study.size))
    return low[:, None] + unit * (high - low)[:, None]


def _log(study: Study) -> Bool[np.ndarray, "lanes P"]:
    """Which unknowns have a logarithmic scale."""
    return study.of_unknowns(lambda p: p.scale == "log", True)


def without_curves(study: Study) -> Study:
    """The study with curves of one sample: what the inputs need and no more."""
    lanes = study.lanes
    names = ("displacement", "force", "precision", "others")
    one = jax.tree.map(lambda v: v[:, :, :1], {name: getattr(lanes, name) for name in names})
    if lanes.time is not None and lanes.rising is not None:
        one |= {"time": lanes.time[:, :, :1], "rising": lanes.rising[:, :, :1]}
    return dataclasses.replace(study, lanes=lanes._replace(**one))
