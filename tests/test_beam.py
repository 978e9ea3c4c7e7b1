"""Ligament beam: against an independent 80-digit FEM, then its laws one by one."""

import functools
import math

import beam_accuracy
import beam_fem
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jitted import jitted

from jaxtrachea.mechanics import beam as room
from jaxtrachea.mechanics import reactions
from jaxtrachea.mechanics.beam import Beam, contact_compliance, deflect

#: A step of the recursion rounds about 30 times by half of eps; measured at most 7 eps, with and
#: without fused multiplication and addition.
ROUNDINGS = 16
EI = 1.862


def beam_of(x, length, EI, k, GA=None, dtype="float64"):
    def cast(v):
        return None if v is None else jnp.asarray(np.asarray(v), dtype)

    return Beam(cast(x), cast(length), cast(EI), cast(k), cast(GA))


def table_1(k=0.1, dtype="float64"):
    n = 15
    return beam_of(
        10.0 * np.arange(1, n + 1), 160.0, np.full(n + 1, EI), np.full(n, k), dtype=dtype
    )


@functools.cache
def solver(split="continuous", form="recursion"):
    return jitted(lambda b, s, f: deflect(b, s, f, split=split, form=form))


@functools.cache
def many_of(form="recursion", split="continuous"):
    one = functools.partial(deflect, form=form, split=split)
    return jitted(jax.vmap(one, (None, 0, None)))


many = many_of()
compliances = jitted(contact_compliance, static_argnames="split")


@functools.cache
def tables(tube, dtype, form="recursion"):
    return beam_accuracy.measure(tube, dtype, form)


def assert_exact(errors, beam, s, solution, dtype):
    """Up to the roundings of each step and what the beam makes of them (at most 1e4)."""
    amplified = beam_accuracy.amplification(*beam, float(s), solution)
    for quantity, error in errors.items():
        condition = min(max(amplified.get(quantity, 1), 1), 1e4)
        limit = ROUNDINGS * np.finfo(dtype).eps * condition
        assert error <= limit, (quantity, error, limit, s)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("tube", "dtype"), [("1 ring", "float32"), ("15 rings", "float64")])
def test_recursion_against_fem(tube, dtype):
    """Every quantity, relative to its largest value, for all k and all positions of C."""
    x, length, _ = beam_accuracy.tube(tube)
    bending = np.full(len(x) + 1, beam_accuracy.EI, np.float32)
    for k, s, errors, solution in beam_accuracy.cases(tube, dtype):
        beam = x, length, bending, np.full(len(x), k), None
        assert_exact(errors, beam, s, solution, dtype)


@pytest.mark.slow
@pytest.mark.compiling
def test_recursion_beats_reactions():
    """As docs/evidence/beam_accuracy.md says: the dense form is nowhere better but by rounding."""
    tube = "15 rings"
    recursion, dense = tables(tube, "float64"), tables(tube, "float64", "reactions")
    floor = 50 * np.finfo("float64").eps
    for quantity, per_k in recursion.items():
        for k, error in per_k.items():
            assert error <= max(dense[quantity][k], floor), (quantity, k)
    # ... and it breaks down for stiff rings, where C lies on one.
    assert dense["w_C"][1e12] > 0.1


def _random_beam(rng, n, with_shear, with_load):
    """Numbers rounded to float32, over 4 decades per span and per ring."""
    x = np.sort(rng.uniform(2, 158, n))

    def draw(m):
        return np.float32(10 ** rng.uniform(-2, 2, m))

    GA = draw(n + 1) if with_shear else None
    load = np.float32(0.3 * rng.normal(size=n)) if with_load else None
    return np.float32(x), np.float32(160), draw(n + 1), 0.1 * draw(n), GA, load, rng.uniform(1, 159)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("with_shear", "with_load", "dtype"),
    [(True, True, "float64"), (True, False, "float32")],
)
def test_random_beams_against_fem(with_shear, with_load, dtype):
    """Own stiffness for each span and ring, Timoshenko shear, loads on the rings.

    Ring loads: the free motions of the two sides cancel, so they are for float64 (measured 2e-9
    in the worst of these beams; float32 is not claimed). Without them a soft span beside a stiff
    one leaves small differences of larger numbers: `amplification` says how large.
    """
    rng = np.random.default_rng(0)
    force = np.float32(0.7)
    for _ in range(20):
        x, length, EI, k, GA, load, s = _random_beam(rng, 15, with_shear, with_load)
        s, k = np.float32(s), np.float32(k)
        exact = beam_fem.solve(x, length, EI, k, s, force, GA, load)
        beam = beam_of(x, length, EI, k, GA, dtype)
        args = beam, jnp.asarray(s, dtype), jnp.asarray(force, dtype)
        got = deflect_loaded(*args, jnp.asarray(load, dtype)) if with_load else solver()(*args)
        errors = beam_accuracy.compare(got, exact)
        if with_load:
            differences = [errors.pop(q) for q in ("w", "theta", "theta_C")]
            assert max(errors.values()) < 1e-8, errors
            assert max(differences) < 5e-8
        else:
            assert_exact(errors, (x, length, EI, k, GA), s, exact, dtype)


deflect_loaded = jitted(lambda b, s, f, load: deflect(b, s, f, ring_load=load))


@pytest.mark.parametrize("form", ["recursion", "reactions"])
@pytest.mark.parametrize("s", [3.0, 44.0, 70.0, 155.0])
def test_independent_against_fem(s, form):
    """Paper eq. 3: each cantilever alone under its share."""
    b = table_1()
    w_C, reactions = beam_fem.solve_independent(b.x, b.length, b.EI, b.k, s, 0.3)
    got = solver("independent", form)(b, jnp.asarray(s), jnp.asarray(0.3))
    tolerance = 1e-12 if form == "recursion" else 1e-9
    np.testing.assert_allclose(got.w_C, float(w_C), rtol=tolerance)
    expected = np.array(reactions, dtype=float)
    np.testing.assert_allclose(got.reaction, expected, atol=tolerance * abs(expected).max())


CANTILEVER_TIP = 9.124853627402
CANTILEVER_R = [
    *(-1.811922175e-12, 1.307879530e-12, 6.729892307e-11, -3.795777594e-10, -9.376938634e-10),
    *(2.019875435e-8, -5.914651839e-8, -5.467304884e-7, 5.087663055e-6, -2.088066728e-6),
    *(-1.997502411e-4, 1.053554254e-3, 3.137045354e-3, -5.865170690e-2, 0.1546584449),
]


def test_cantilever_reference():
    """One side alone (docs/model.md, 60-digit numbers): the tip and every reaction, digit by digit.

    Relative per entry, R_1 = -1.8e-12 N included: each reaction keeps its own digits.
    """
    k, bending = (jax.device_put(np.full(n, v)) for n, v in ((15, 0.1), (16, 1.86)))
    h = jax.device_put(np.array([10.0] * 15 + [5.0]))

    @jax.jit
    def solved(force):
        side = room.Side(h, bending, None, k, None)
        last, nodes, passed = room.sweep(side)
        _, _, R = room._back_substitute(side, nodes, passed, force, jnp.zeros(()))
        return room._tip(side, last).g.a * force, R

    tip, R = solved(jnp.asarray(0.1))
    np.testing.assert_allclose(tip, CANTILEVER_TIP, rtol=5e-13)
    np.testing.assert_allclose(R, CANTILEVER_R, rtol=6e-10)


def test_cantilever_reference_agrees_with_fem():
    x = 10.0 * np.arange(1, 16)
    exact = beam_fem.solve(x, 155, [1.86] * 16, [0.1] * 15, 155, 0.1, free_end=True)
    # 0.1 and 1.86 are not binary numbers: 1e-16 in the input, amplified in R_1.
    np.testing.assert_allclose(np.array(exact.reaction, dtype=float), CANTILEVER_R, rtol=3e-10)
    np.testing.assert_allclose(float(exact.w_C), CANTILEVER_TIP, rtol=1e-12)


def test_cantilever_dense_keeps_few_digits():
    """`reactions` errs by 2e-10 of the largest reaction; R_1, 11 decades down, keeps 3 digits."""
    b = beam_of(10.0 * np.arange(1, 16), 155.0, np.full(16, 1.86), np.full(15, 0.1))
    _, _, R, _ = jax.jit(reactions._dense_side)(b, b.length, np.ones(15, bool))
    error = np.abs(0.1 * np.asarray(R)[:, 0] - np.array(CANTILEVER_R))
    assert error.max() < 1e-9 * max(CANTILEVER_R)
    assert 1e-6 < error[0] / abs(CANTILEVER_R[0]) < 0.1


@pytest.mark.parametrize("split", ["continuous", "independent"])
@pytest.mark.parametrize("shear", [False, True])
def test_reactions_same_answer(split, shear):
    """The two forms are one method: same numbers where the dense one keeps its digits."""
    b = table_1()
    if shear:
        b = Beam(b.x, b.length, b.EI, b.k, jnp.full(16, 2.0))
    for s in (5.0, 60.0, 61.0, 155.0):
        args = b, jnp.asarray(s), jnp.asarray(-0.2)
        one, two = solver(split)(*args), solver(split, "reactions")(*args)
        for name in one._fields:
            p, q = getattr(one, name), getattr(two, name)
            peak = np.max(np.abs(two.theta if name == "theta_C" else q))
            np.testing.assert_allclose(p, q, atol=2e-9 * float(peak), rtol=0, err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize(("split", "shear"), [("continuous", True), ("independent", False)])
def test_derivatives_of_both_forms(split, shear):
    """Between rings, on a ring (from the right, where they jump), and where a ring gives way."""
    b = table_1()
    k = np.where(np.arange(15) == 4, 0.0, b.k)
    b = Beam(b.x, b.length, b.EI, k, np.full(16, 2.0) if shear else None)

    def moved(b, s, form):
        found = deflect(b, s, -0.2, split=split, form=form)
        return found.w_C + found.w[6] + 10 * found.theta[8]

    derivatives = jitted(jax.grad(moved, argnums=(0, 1)), static_argnums=2)
    for s in (44.0, 50.0, 70.0):
        one, two = (jax.tree.leaves(derivatives(b, s, form)) for form in ("recursion", "reactions"))
        for p, q in zip(one, two, strict=True):
            atol = 1e-12 + 1e-7 * float(np.max(np.abs(p)))
            np.testing.assert_allclose(q, p, atol=atol, rtol=0)


def test_derivative_of_reactions_on_a_ring_against_elements():
    """Without shear w_C is smooth as C crosses a ring: central differences of the elements."""
    x, h = np.array([11.0, 26.0, 33.0, 58.0, 70.0, 97.0]), 1e-4
    b = beam_of(x, 130.0, np.full(7, 1.86), np.full(6, 0.1))
    grad = jax.jit(jax.grad(lambda s: deflect(b, s, 1.0, form="reactions").w_C))
    for s in (11.0, 33.0, 70.0):
        low, high = (
            float(beam_fem.solve(b.x, b.length, b.EI, b.k, s + d, 1.0).w_C) for d in (-h, h)
        )
        np.testing.assert_allclose(grad(s), (high - low) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize("form", ["recursion", "reactions"])
def test_off_the_beam_nothing_is_known(form):
    """-5 and 165 mm on a beam of 160 mm gave finite numbers; both ends are on it."""
    b, s = table_1(), np.array([-5.0, -1e-9, 0.0, 80.0, 160.0, 165.0, np.nan])
    lost = [True, True, False, False, False, True, True]
    if form == "recursion":
        found = [compliances(b, s), [compliances(b, v) for v in s]]
    else:
        found = [many_of(form)(b, s, 1.0).reaction[:, 0]]
    found.append(many_of(form)(b, s, 1.0).w_C)
    for values in found:
        assert np.isnan(values).tolist() == lost


def test_a_beam_takes_plain_numbers_and_says_what_does_not_fit():
    x, EI, k = [10, 20, 40], [2.0] * 4, [1, 1, 1]
    plain = Beam(x, 70, EI, k)
    want = Beam(*(jnp.asarray(v, float) for v in (x, 70, EI, k)))
    np.testing.assert_array_equal(contact_compliance(plain, 30), contact_compliance(want, 30.0))
    for change, says in {
        "EI": (2.0, "Beam.EI has no axis .*; expected 4 values .3 supports make 4 spans"),
        "k": ([1.0, 1.0], "Beam.k has 2 values; expected 3 values .one for each support"),
        "GA": ([1.0], "Beam.GA has 1 value; expected 4 values"),
        "length": ([70.0, 80.0], "Beam.length has 2 values; expected no axis"),
    }.items():
        wrong = dict(zip(("x", "length", "EI", "k"), (x, 70, EI, k), strict=True)) | {
            change: says[0]
        }
        made = object.__new__(Beam)
        for name, value in (wrong | {"GA": wrong.get("GA")}).items():
            object.__setattr__(made, name, None if value is None else jnp.asarray(value, float))
        with pytest.raises(ValueError, match=says[1]):
            contact_compliance(made, 30.0)
        with pytest.raises(ValueError, match=says[1]):
            deflect(made, 30.0, 1.0)


def test_reactions_refuses_ring_load():
    b = table_1()
    with pytest.raises(ValueError, match="ring_load"):
        deflect(b, jnp.asarray(5.0), jnp.asarray(1.0), form="reactions", ring_load=jnp.ones(15))


slope = jitted(jax.vmap(jax.grad(contact_compliance, argnums=1), (None, 0)))


@pytest.mark.parametrize("k", [1e-9, 1e-3, 0.1, 10.0, 1e6])
def test_compliance_is_smooth_across_rings(k):
    """C and dc/ds_c: left limit, value on the ring and right limit are one number."""
    b = table_1(k)
    step = 1e-7
    x = np.asarray(b.x)
    c = [compliances(b, x + e) for e in (-step, 0.0, step)]
    dc = [slope(b, x + e) for e in (-step, 0.0, step)]
    scale = np.max(np.abs(slope(b, x + 2.0)))  # a rigid ring itself has c = 1/k, dc = 0
    np.testing.assert_allclose(c[0], c[1], atol=5 * step * scale, rtol=1e-9)
    np.testing.assert_allclose(c[2], c[1], atol=5 * step * scale, rtol=1e-9)
    assert np.max(np.abs(dc[2] - dc[0])) < 1e-6 * scale
    assert np.max(np.abs(dc[1] - (dc[0] + dc[2]) / 2)) < 1e-7 * scale
    # AD against a difference quotient that straddles the ring.
    h = 1e-3
    quotient = (compliances(b, x + h) - compliances(b, x - h)) / (2 * h)
    np.testing.assert_allclose(dc[1], quotient, atol=2e-3 * scale)


def test_independent_jumps_across_rings():
    b = table_1()
    x = np.delete(b.x, 7)  # by symmetry there is no jump on the middle ring
    left, right = (compliances(b, x + e, split="independent") for e in (-1e-7, 1e-7))
    assert np.min(np.abs(right / left - 1)) > 1e-3


@pytest.mark.parametrize("split", ["continuous", "independent"])
def test_compliance_of_many_points(split):
    """M positions in one call are the m single answers of `deflect`."""
    b = table_1(dtype="float64")
    s = np.asarray([0.5, 10.0, 77.3, 80.0, 159.0], "float64")
    at_once = compliances(b, s, split=split)
    one = jnp.asarray(1.0, "float64")
    alone = np.stack([solver(split)(b, v, one).w_C for v in s])
    np.testing.assert_allclose(at_once, alone, rtol=20 * np.finfo("float64").eps)
    assert at_once.dtype == "float64"
    assert compliances(b, s[2], split=split).shape == ()


def _element_energy_and_shears(b, s, got):
    """From nodal motions alone: strain energy, and the shears at both clamps (Hermite elements)."""
    motions = dict(zip(np.asarray(b.x).tolist(), zip(got.w, got.theta, strict=True), strict=True))
    motions |= {0.0: (0.0, 0.0), float(b.length): (0.0, 0.0), float(s): (got.w_C, got.theta_C)}
    nodes, energy, shears = sorted(motions), 0.0, []
    for low, high in zip(nodes, nodes[1:], strict=False):
        span = int(np.searchsorted(np.asarray(b.x), low, side="right"))
        element = np.array(beam_fem._element(high - low, float(b.EI[span]), None), dtype=float)
        u = np.array([*motions[low], *motions[high]], dtype=float)
        energy += u @ element @ u / 2
        shears.append((element @ u)[[0, 2]])
    return energy, -shears[0][0] - shears[-1][1]


@settings(deadline=None, max_examples=30, derandomize=True)
@given(
    st.lists(st.floats(-1.5, 1.5), min_size=13, max_size=13),
    st.floats(1.0, 119.0),
    st.sampled_from([-0.4, 0.05, 2.0]),
)
def test_equilibrium_and_energy(exponents, s, force):
    """Rings and clamps together carry the force; the work of the force is the stored energy."""
    x = jnp.asarray([11.0, 30.0, 47.0, 60.0, 82.0, 110.0])
    EI, k = 10.0 ** np.array(exponents[:7]), 0.1 * 10.0 ** np.array(exponents[7:])
    b = beam_of(x, 120.0, EI, k)
    got = solver()(b, jnp.asarray(s), jnp.asarray(force))
    strain, clamps = _element_energy_and_shears(b, s, got)
    # 1e-7: the element forces are differences of nodal motions, magnified by (span / s)^3.
    closeness = 1e-7 * max(1.0, (1.0 / min(abs(s - v) + 1e-3 for v in x.tolist())))
    np.testing.assert_allclose(np.sum(got.reaction) + clamps, force, rtol=closeness)
    stored = strain + float(np.sum(got.reaction * got.w)) / 2
    np.testing.assert_allclose(stored, force * float(got.w_C) / 2, rtol=closeness)
    np.testing.assert_array_equal(got.reaction, b.k * got.w)
    assert float(got.w_C) * force > 0


@pytest.mark.parametrize("k", [1e-9, 0.1, 1e12])
def test_signs(k):
    """The ring under the load pushes back; the moment at C keeps both beams together."""
    b = table_1(k)
    got = many(b, b.x, jnp.asarray(1.0))
    under = np.diagonal(got.reaction)
    assert np.all(under > 0)
    # No ring takes more than the load, except that rings can hold each other down.
    assert np.all(under <= 1 + 1e-6)
    assert np.all(got.w_C > 0)
    assert np.all(got.moment_A < 0)


@pytest.mark.parametrize("k", [1e-3, 0.1, 1e5])
def test_reciprocity(k):
    """Maxwell-Betti: w_i of a load at ring j is w_j of the same load at ring i."""
    b = table_1(k)
    w = many(b, b.x, jnp.asarray(1.0)).w
    np.testing.assert_allclose(w, w.T, atol=1e-12 * float(np.max(w)))
    np.testing.assert_allclose(np.diagonal(w), compliances(b, b.x), rtol=1e-11)


def test_mirror():
    """Seen from the other end the same beam gives the same answer, rotations reversed."""
    rng = np.random.default_rng(3)
    x, length, EI, k, GA, load, s = _random_beam(rng, 15, True, True)
    b = beam_of(x, length, EI, k, GA)
    m = beam_of((length - x)[::-1], length, EI[::-1], k[::-1], GA[::-1])
    one = deflect_loaded(b, jnp.asarray(s), jnp.asarray(1.0), jnp.asarray(load, "float64"))
    two = deflect_loaded(
        m, jnp.asarray(float(length) - s), jnp.asarray(1.0), jnp.asarray(load[::-1], "float64")
    )
    for name, sign in (("w", 1), ("theta", -1), ("reaction", 1)):
        p, q = getattr(one, name), sign * getattr(two, name)[::-1]
        # (length - x) is rounded to float32 here, hence not closer.
        np.testing.assert_allclose(p, q, atol=3e-5 * float(np.max(np.abs(p))), err_msg=name)
    np.testing.assert_allclose(one.force_A + two.force_A, 1.0, rtol=1e-4)


@pytest.mark.parametrize("split", ["continuous", "independent"])
def test_linear_in_force(split):
    b, s = table_1(), jnp.asarray(63.0)
    one, two = (solver(split)(b, s, jnp.asarray(f)) for f in (1.0, -3.5))
    for p, q in zip(one, two, strict=True):
        np.testing.assert_allclose(-3.5 * p, q, rtol=1e-13)
    zero = solver(split)(b, s, jnp.asarray(0.0))
    assert all(np.all(np.asarray(v) == 0) for v in zero)


def test_ring_load_is_a_force_at_a_ring():
    """A load on ring 6 alone is a contact force at x_6 (but for who is called the ring's load)."""
    b = table_1()
    load = 0.3 * (np.arange(15) == 5)
    by_load = deflect_loaded(b, jnp.asarray(97.0), jnp.asarray(0.0), load)
    by_force = solver()(b, b.x[5], jnp.asarray(0.3))
    np.testing.assert_allclose(by_load.w, by_force.w, atol=1e-10 * float(by_force.w_C))
    np.testing.assert_allclose(by_load.reaction + load, by_force.reaction, atol=1e-10)


@pytest.mark.parametrize("k", [1e-12, 1e15])
def test_limits_in_closed_form(k):
    """No rings: c = a^3 b^3 / (3 EI L^3). Rigid rings: mid-span of an endless continuous beam."""
    b, s, h = table_1(k), 75.0, 10.0
    c = float(compliances(b, jnp.asarray(s)))
    if k < 1:
        a = s * (160 - s)
        np.testing.assert_allclose(c, a**3 / (3 * EI * 160**3), rtol=1e-6)
    else:
        # Rotations decay by 2 - sqrt 3 per span: the neighbours hold with 2 sqrt 3 EI / h.
        moment = 2 * math.sqrt(3) * h / 16 / (1 + math.sqrt(3))
        expected = h**3 / (48 * EI) - moment * h**2 / (8 * EI)
        np.testing.assert_allclose(c, expected, rtol=1e-7)


@pytest.mark.parametrize("end", [0.0, 160.0])
def test_contact_at_a_clamp(end):
    got = solver()(table_1(), jnp.asarray(end), jnp.asarray(1.0))
    assert float(got.w_C) == 0
    np.testing.assert_allclose(got.reaction, 0, atol=1e-15)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units(scale):
    """The same beam with lengths in another unit: stiffness per length rescales, answers too."""
    b = table_1()
    x, length, EI, k = (np.asarray(v) for v in (b.x, b.length, b.EI, b.k))
    u = beam_of(x * scale, length * scale, EI * scale**2, k / scale)
    one = solver()(b, jnp.asarray(77.0), jnp.asarray(1.0))
    two = solver()(u, jnp.asarray(77.0 * scale), jnp.asarray(1.0))
    np.testing.assert_allclose(one.w * scale, two.w, rtol=1e-10, atol=1e-12 * scale)
    np.testing.assert_allclose(one.reaction, two.reaction, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(one.w_C * scale, two.w_C, rtol=1e-12)


@pytest.mark.parametrize(
    ("split", "form"), [("continuous", "recursion"), ("independent", "reactions")]
)
def test_dtype_jit_vmap(split, form):
    """Plain, jitted and mapped calls agree and keep the dtype."""
    b, one = table_1(dtype="float64"), jnp.asarray(1.0, "float64")
    s = np.asarray([12.0, 20.0, 151.0], "float64")
    mapped = many_of(form, split)(b, s, one)
    alone = solver(split, form)(b, s[1], one)
    for m, a in zip(mapped, alone, strict=True):
        assert m.dtype == a.dtype == "float64"
        if form == "recursion":  # the moment at C is a small one here: three digits less
            tolerance = 1000 * np.finfo("float64").eps
            np.testing.assert_allclose(m[1], a, atol=tolerance * float(np.max(np.abs(a))))


def test_incision():
    """A cut span (EI -> 0) or ring (k -> 0) is a smooth limit, not a special case."""
    b = table_1()
    cut = [
        beam_of(b.x, b.length, np.where(np.arange(16) == 7, 1.862 * f, b.EI), b.k)
        for f in (1e-4, 1e-6, 1e-9, 1e-12)
    ]
    got = [solver()(v, jnp.asarray(61.0), jnp.asarray(1.0)) for v in cut]
    c = [float(v.w_C) for v in got]
    assert c[0] < c[1] < c[2] < c[3] * (1 + 1e-9)
    assert abs(c[3] / c[2] - 1) < 1e-5
    # Beyond the cut next to nothing arrives.
    assert float(np.max(np.abs(got[3].reaction[7:]))) < 1e-9
