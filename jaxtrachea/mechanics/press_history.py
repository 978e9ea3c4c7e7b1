r"""A press that relaxes, continued from what it remembers: a path, or one step of a loop.

`press_in_time` presses a whole record from rest, many of them in lanes. Here the history is a value
that goes in and comes out, so that a path may be taken in one piece or step by step. Both give the
same numbers. Presses as vectors relax here as well: of parts that relax alike the shape is the
elastic one, and each component of the force is the filter of that of the elastic force. A
unilateral contact lets go where the inward component would pull.

After a sample without a solution the history is unknown: all later ones are NaN with its status.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import product, turned
from jaxtrachea.mechanics import press as _press
from jaxtrachea.mechanics.equilibrium import Equilibrium
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.oblique import ObliquePress, Place, assemble, elastic_at
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.press_in_time import softened
from jaxtrachea.mechanics.relaxation_energy import taken
from jaxtrachea.mechanics.relaxation_parts import one_sample, way_of
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.validation import has_solution, mask, status_of
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.steps import Branches, Carried, advance, factors, over
from jaxtrachea.status import PressStatus


class History(NamedTuple):
    """What a press remembers.

    Attributes:
        local: of the local law; of the whole organ where all parts relax alike.
        skeleton: of the skeleton where it relaxes apart; else None.
        lost: status of the sample since which the history is unknown; OK: it is known.
    """

    local: Carried
    skeleton: Carried | None
    lost: Int[Array, ""]


class Samples(NamedTuple):
    """Samples to press, and what came before them.

    Attributes:
        history: before the first.
        relaxation: branches, which are not negative.
        dt: time since the sample before, s; (N,).
        status: why a sample has no solution that its press does not know of; else OK; (N,).
        skipped: samples that count as if they were not there; (N,).
    """

    history: History
    relaxation: Relaxation
    dt: Float[Array, " N"]
    status: Int[Array, " N"]
    skipped: Bool[Array, " N"]


def at_rest(relaxation: Relaxation, options: Options, vector: bool) -> History:
    """Before the first press, in the dtype of the branches.

    Args:
        options: whether parts relax apart (static).
        vector: whether presses are vectors (static).
    """
    k = (3,) if vector else ()

    def rest(branches: Branches) -> Carried:
        count, dtype = branches.gamma.shape[0], branches.gamma.dtype
        return Carried(jnp.zeros((count, *k), dtype), jnp.zeros(k, dtype))

    apart = options.relaxation == "parts" and relaxation.skeleton is not None
    skeleton = rest(relaxation.skeleton) if apart and relaxation.skeleton is not None else None
    return History(rest(relaxation.local), skeleton, jnp.asarray(PressStatus.OK, jnp.int8))


class Relaxed(NamedTuple):
    """What becomes of the samples; NaN where there is no solution.

    Attributes:
        history: after the last.
        solved: force, indentation, status, and as `load` the elastic force that the shape follows.
        dissipated: work that the dashpots take in each sample, N mm; (N,); None: not derived.
    """

    history: History
    solved: Equilibrium
    dissipated: Float[Array, " N"] | None


def respond_in_time(
    displacement: Float[Array, " N"],
    compliance: Float[Array, ""],
    contact: Contact,
    options: Options,
    samples: Samples,
) -> Relaxed:
    """`press.respond` of a force that relaxes.

    With a skeleton that softens no energy is derived: `dissipated` is None there.

    Args:
        displacement: of the tool, mm.
        compliance: of the skeleton in the long run, mm/N.
        contact: law, onset and softening.
        options: how the force relaxes, and the contact (static).
        samples: times and history.
    """
    elastic = _press.respond(displacement, compliance, contact, options)
    moved = _press.indentation(displacement, contact.onset, options, contact.blend)
    load = elastic.force if elastic.load is None else elastic.load
    law, softening = contact.law, contact.softening
    if options.relaxation == "parts":
        found = _apart(moved, compliance, law, elastic.status, options, samples)
    else:
        felt = compliance if options.coupling == "series" else jnp.zeros_like(compliance)

        def way(e):
            return _alone(law, e) + felt * e

        found = _alike(load, elastic.depth, law, way, elastic.status, options, samples)
    if softening is None:
        return found
    of_shape = moved
    if options.relaxation == "parts":
        assert found.solved.load is not None
        of_shape = way_of(found.solved.load, compliance, law)
    solved, status = softened(found.solved, found.solved.status, softening, of_shape)
    solved = solved._replace(status=status.astype(jnp.int8))
    return found._replace(solved=solved, dissipated=None)


def press_at_in_time(
    place: Place, displacement: Float[Array, "N 3"], options: Options, samples: Samples
) -> tuple[ObliquePress, History, Float[Array, " N"] | None]:
    """`oblique.press_at` of a force that relaxes, all parts alike.

    Returns:
        The press: shape and joints are those of the surface, `loads` follow the force; what is
        remembered after it; and the work that the dashpots take in each sample, N mm.
    """
    frame = local_frame(place.phi_c)
    force, depth, status = elastic_at(place, displacement, options)
    C = turned(place.unit.compliance, frame.T)

    def way(e):
        skeleton = product(e, C.T) if options.coupling == "series" else 0 * e
        return _alone(place.law, e) + skeleton

    given = product(force, frame.T), product(depth, frame.T)
    found = _alike(*given, place.law, way, status, options, samples)
    solved, refused = found.solved, place.asked.refused
    assert solved.load is not None
    unit, force, depth, load = mask(
        refused, place.unit, *(product(v, frame) for v in (solved.force, solved.depth, solved.load))
    )
    pressed = assemble(unit, force, depth, status_of(refused, solved.status), load)
    lost = jnp.where(refused != PressStatus.OK, refused, found.history.lost).astype(jnp.int8)
    return pressed, found.history._replace(lost=lost), found.dissipated


def relax_forces(
    force: Float[Array, "N 3"], status: Int[Array, " N"], samples: Samples
) -> tuple[Float[Array, "N 3"], Int[Array, " N"], History]:
    """The forces of a press that never lets go, of any level; its shape is the elastic one."""

    def step(history, sample):
        dt, e, status, skipped = sample
        safe, lost, skipped = counted(history, e, status, skipped, history.local.elastic)
        local, force = advance(history.local, dt, safe, samples.relaxation.local, False)
        after = remembered(history, History(local, None, lost), skipped)
        return after, (force, jnp.where(skipped, status, jnp.where(_is(lost), lost, status)))

    history, (relaxed, status) = run(step, samples, force, status)
    hidden = samples.skipped | ~has_solution(status)
    return jnp.where(hidden[:, None], jnp.nan, relaxed), status, history


def _alike(elastic, depth, law: Law, way, status, options: Options, samples: Samples) -> Relaxed:
    """All of the organ relaxes alike: the filter of the elastic force; (N,) or (N, 3).

    Args:
        elastic: elastic force, N; a vector has its inward component first.
        depth: elastic indentation, mm.
        way: displacement under an elastic force, mm.
        samples: times and history.
    """
    unilateral, branches = options.contact == "unilateral", samples.relaxation.local

    def step(history, sample):
        dt, e, depth, status, skipped = sample
        safe, lost, skipped = counted(history, e, status, skipped, history.local.elastic)
        before = history.local
        local, force = advance(before, dt, safe, branches, unilateral)
        if unilateral:
            left = jnp.any(local.elastic != safe)
            alone = _alone(law, jnp.where(left, local.elastic, 0))
            depth = jnp.where(left, alone, depth)
        work = taken(over(dt, branches.tau), branches.gamma, before, local.elastic, way)
        after = remembered(history, History(local, None, lost), skipped)
        return after, _row(force, depth, local.elastic, work, status, lost, skipped, unilateral)

    history, (solved, work) = run(step, samples, elastic, depth, status)
    return Relaxed(history, solved, work)


def _apart(moved, compliance, law: Law, status, options: Options, samples: Samples) -> Relaxed:
    """Local law and skeleton relax apart, see `relaxation_parts`."""
    unilateral = options.contact == "unilateral"
    local, skeleton = samples.relaxation
    assert skeleton is not None

    def step(history, sample):
        dt, D, status, skipped = sample
        h, e = history.local
        q, y = history.skeleton
        safe, lost, skipped = counted(history, D, status, skipped, way(e, y))
        x, x_s = over(dt, local.tau), over(dt, skeleton.tau)
        fading = (
            factors(x, jnp.expm1(-x), local.gamma), factors(x_s, jnp.expm1(-x_s), skeleton.gamma)
        )  # fmt: skip
        new, (force, depth, load, folded) = one_sample(
            (h, e, q, y), fading, safe, compliance, law, unilateral
        )
        newly = folded & ~_is(lost) & ~skipped
        lost = jnp.where(newly, PressStatus.PAST_FOLD, lost).astype(jnp.int8)
        # What is remembered stays finite.
        kept = jax.tree.map(
            lambda v, was: jnp.where(newly, was, v),
            (jnp.stack(new[0]), new[1], jnp.stack(new[2]), new[3]), (h, e, q, y),
        )  # fmt: skip
        work = taken(x, local.gamma, history.local, kept[1], lambda e: _alone(law, e))
        work += taken(x_s, skeleton.gamma, history.skeleton, kept[3], lambda y: compliance * y)
        after = History(Carried(*kept[:2]), Carried(*kept[2:]), lost)
        after = remembered(history, after, skipped)
        return after, _row(force, depth, load, work, status, lost, skipped, unilateral)

    def way(e, y):
        return _alone(law, e) + compliance * y

    history, (solved, work) = run(step, samples, moved, status)
    return Relaxed(history, solved, work)


def run(step, samples: Samples, *rows):
    """The samples in order; a single one without a loop. `step` is given dt, the rows, skipped."""
    *numbers, status = rows
    status = jnp.where(samples.status == PressStatus.OK, status, samples.status).astype(jnp.int8)
    given = (samples.dt, *numbers, status, samples.skipped)
    if samples.dt.shape[0] > 1:
        return jax.lax.scan(step, samples.history, given)
    history, out = step(samples.history, jax.tree.map(lambda v: v[0], given))
    return history, jax.tree.map(lambda v: v[None], out)


def counted(history: History, given, status, skipped, before):
    """The input, as before where it does not count; since when the history is lost; skipped."""
    failed = ~has_solution(status) & ~skipped
    lost = jnp.where(_is(history.lost) | ~failed, history.lost, status).astype(jnp.int8)
    return jnp.where(skipped | _is(lost), before, given), lost, skipped


def _is(lost):
    return lost != PressStatus.OK


def remembered(before: History, after: History, skipped) -> History:
    """What is remembered; where the history is lost its numbers stay as they were."""
    stays = skipped | _is(after.lost)
    kept = jax.tree.map(
        lambda was, v: jnp.where(stays, was, v), before._replace(lost=after.lost), after
    )
    return kept._replace(lost=jnp.where(skipped, before.lost, after.lost))


def _row(force, depth, load, work, status, lost, skipped, unilateral: bool):
    """The equilibrium of one sample, and its work."""
    inward = force if force.ndim == 0 else force[0]
    touches = inward > 0 if unilateral else jnp.any(force != 0)
    plain = (status == PressStatus.OK) | (status == PressStatus.NO_CONTACT)
    own = jnp.where(touches, PressStatus.OK, PressStatus.NO_CONTACT)
    told = jnp.where(plain, own, status)
    told = jnp.where(_is(lost) & ~skipped, lost, told).astype(jnp.int8)
    hidden = _is(lost) | skipped
    numbers = (jnp.where(hidden, jnp.nan, v) for v in (depth, force, load, work))
    depth, force, load, work = numbers
    return Equilibrium(depth, force, told, load), work


def _alone(law: Law, elastic):
    """Indentation of the local law under an elastic force, mm; a vector goes along it."""
    if elastic.shape[-1:] != (3,):
        return law.under(elastic)
    squared = jnp.sum(elastic * elastic, axis=-1, keepdims=True)
    some = squared > 0
    size = jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1)), 0)
    per_size = jnp.where(some, law.under(size), 0)
    return per_size / jnp.where(some, size, 1) * elastic
