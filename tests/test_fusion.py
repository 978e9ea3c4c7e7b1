"""A part compiled by itself: values and derivatives are those of the part, whatever is done to it.

The outside truth is the function without the mark, and for one case the derivative by hand. What
the mark does is read in the compiled program: one pose calls the part, several lanes do not.
"""

import functools
import os
import subprocess
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import count_kernels

import jaxtrachea
from jaxtrachea import (
    Material,
    Options,
    Poses,
    fusion,
    press,
    press_oblique,
    press_path,
    table_1,
)
from jaxtrachea._numerics import epsilon, largest
from jaxtrachea.contact.shapes import capsule
from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.scene.deform import sag

NOT_INLINED = 'inlineable="false"'
#: With the first word: XLA makes calls of its own small loops.
ONE = f'{NOT_INLINED},xla_cpu_small_call="true"'
pytestmark = [pytest.mark.usefixtures("on_the_cpu"), pytest.mark.compiling]


class Out(NamedTuple):
    nothing: None
    sine: jax.Array
    both: tuple


def part(x, y):
    """A tree of results with None in it; the first does not depend on y."""
    return Out(None, jnp.sin(x) * x, (jnp.sum(jnp.exp(x) * y**2, axis=-1), x * y[..., ::-1]))


def numbers(dtype, lanes=()):
    rng = np.random.default_rng(5)
    return [jnp.asarray(rng.normal(size=(*lanes, 3)), dtype) for _ in range(2)]


def close(got, expected):
    """To rounding: what is fused with what differs."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        atol = 8 * epsilon(b.dtype) * np.abs(b).max(initial=1) if b.dtype.kind == "f" else 0
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def total(f, x, y):
    return sum(jnp.sum(v) for v in jax.tree.leaves(f(x, y)))


def second(f, x, y):
    """A row of the second derivatives, forward over reverse and reverse over reverse."""
    slope = jax.grad(total, argnums=(1, 2))
    along = jax.jvp(lambda *v: slope(f, *v), (x, y), (y, x))[1]
    back = jax.grad(lambda *v: sum(jnp.sum(g**2) for g in slope(f, *v)), argnums=(0, 1))(x, y)
    return along, back


def rounds(f, x, y):
    """As the body of a loop, and mapped one after the other."""
    step = jax.lax.scan(lambda c, v: (f(c, v)[1], f(c, v)), x, jnp.stack([y, 2 * y]))
    loop = jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, f(c[1], y)[1]), (0, x))
    return step, loop, jax.lax.map(lambda v: f(v, y), jnp.stack([x, y]))


WAYS = {
    "value": lambda f, x, y: f(x, y),
    "grad": lambda f, *v: jax.value_and_grad(total, argnums=(1, 2))(f, *v),
    "jvp": lambda f, x, y: jax.jvp(f, (x, y), (y, x)),
    "jacrev": lambda f, *v: jax.jacrev(f, argnums=(0, 1))(*v),
    "jacfwd": lambda f, *v: jax.jacfwd(f)(*v),
    "second": second,
    "loops": rounds,
    "gradient of loops": lambda f, x, y: jax.grad(
        lambda v: sum(jnp.sum(w) for w in jax.tree.leaves(jax.lax.map(lambda u: f(u, y), v)))
    )(jnp.stack([x, y])),
    "gradient of scan": lambda f, x, y: jax.grad(
        lambda x: jnp.sum(jax.lax.scan(lambda c, v: (f(c, v)[1], None), x, jnp.stack([y, x]))[0])
    )(x),
    "checkpoint": lambda f, *v: jax.grad(
        lambda *v: total(jax.checkpoint(f), *v), argnums=(0, 1)
    )(*v),
    "linearize": lambda f, *v: jax.linearize(f, *v)[1](*v),
    "closure": lambda f, x, y: jax.jacrev(lambda t: fuse_or(f)(lambda w: part(t, w))(y))(x),
}  # fmt: skip


def fuse_or(f):
    """`fuse` again if f is marked, else the identity."""
    return (lambda g: g) if f is part else fuse


LANES = {
    "none": lambda way: way,
    "one": lambda way: jax.vmap(way),
    "many": lambda way: jax.vmap(way),
    "of lanes": lambda way: jax.vmap(jax.vmap(way)),
    "one of many": lambda way: jax.vmap(jax.vmap(way)),
    "many of one": lambda way: jax.vmap(jax.vmap(way)),
    "first argument": lambda way: jax.vmap(way, (0, None)),
    "second argument": lambda way: jax.vmap(way, (None, 0)),
    "last axis": lambda way: jax.vmap(way, (-1, None), -1),
}
SIZES = {
    "one": (1,),
    "many": (4,),
    "of lanes": (2, 3),
    "one of many": (4, 1),
    "many of one": (1, 4),
    "first argument": (4,),
    "second argument": (4,),
    "last axis": (4,),
}


def arguments(lanes, dtype):
    x, y = numbers(dtype, SIZES.get(lanes, ()))
    alone = numbers(dtype)
    if lanes == "first argument":
        return x, alone[1]
    if lanes == "second argument":
        return alone[0], y
    return (x.T, alone[1]) if lanes == "last axis" else (x, y)


@pytest.mark.slow
@pytest.mark.parametrize("way", list(WAYS))
def test_it_is_the_part(way):
    """Alone, and one or many lanes, in the same program and one operation after the other."""
    do = WAYS[way]
    marked = fuse(part)
    close(do(marked, *numbers("float64")), do(part, *numbers("float64")))
    chosen = list(LANES) if way in ("value", "jacrev") else ["none", "many", "second argument"]
    for lanes in chosen:
        at = arguments(lanes, "float64")
        got, expected = (
            jax.jit(LANES[lanes](lambda x, y, f=f: do(f, x, y)))(*at) for f in (marked, part)
        )
        close(got, expected)


#: Lanes of the second argument alone, of which the first result of `part` knows nothing.
SHARED = {
    "in front": (lambda f: jax.vmap(f, (None, 0)), (), (4,)),
    "of one": (lambda f: jax.vmap(f, (None, 0)), (), (1,)),
    "inside": (lambda f: jax.vmap(jax.vmap(f, (None, 0)), (0, None)), (2,), (4,)),
    "outside": (lambda f: jax.vmap(jax.vmap(f, (0, None)), (None, 0)), (2,), (4,)),
}


@pytest.mark.slow
@pytest.mark.parametrize("lanes", list(SHARED))
def test_derivatives_of_a_program_of_lanes(lanes):
    """Taken from outside of `jit`, where a result is the same in all lanes."""
    way, first, second = SHARED[lanes]
    at = numbers("float64", first)[0], numbers("float64", second)[1]

    def ways(f):
        mapped = jax.jit(way(f))
        slope = jax.grad(functools.partial(total, mapped), argnums=(0, 1))
        return jax.jvp(mapped, at, at), slope(*at)

    close(ways(fuse(part)), ways(part))


@pytest.mark.slow
def test_second_derivatives_of_a_loop():
    """By a result that is not the first, twice backwards: JAX takes the loop apart."""
    x, y = numbers("float64")

    def slopes(f):
        def of(x):
            return jnp.sum(jax.lax.map(lambda v: f(x, v).both[0], jnp.stack([y, 2 * y])) ** 2)

        return jax.jit(jax.jacrev(jax.grad(of)))(x)

    close(slopes(fuse(part)), slopes(part))


@pytest.mark.slow
def test_a_loop_takes_no_part_apart():
    """What a part computes of constants alone stays in it.

    Out of it, it would be an operand, of those that a kernel need not read: the compiler ended the
    process over the gradient of a loop over scenes.
    """
    marked = fuse(lambda x, y: (jnp.sum(jnp.cos(jnp.arange(5.0)) * x) * y, y * x))

    def loss(y):
        found = jax.lax.map(lambda x: marked(x, y), jnp.linspace(1.0, 2, 3))
        return sum(jnp.sum(jnp.sin(v)) for v in found)

    lines = compiled(jax.grad(loss), 1.3).split("\n")
    calls = [v for v in lines if " call(" in v and NOT_INLINED in v]
    there, back = (v.split(" call(")[1].split(")")[0].split(",") for v in calls)
    assert (len(there), len(back)) == (2, 4)


def test_the_derivative_by_hand():
    """d/dx of x sin(x) at 0.7, once and twice."""
    marked, x = fuse(lambda x: (x * jnp.sin(x),)), jnp.asarray(0.7)
    slope = jax.jit(jax.grad(lambda x: marked(x)[0]))
    np.testing.assert_allclose(slope(x), np.sin(0.7) + 0.7 * np.cos(0.7), rtol=1e-14)
    np.testing.assert_allclose(jax.grad(slope)(x), 2 * np.cos(0.7) - 0.7 * np.sin(0.7), rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("first", ["index", "truth"])
def test_a_first_result_without_a_derivative(first):
    """The mark is put on an integer or a truth value; what comes after it is differentiated."""

    def lead(x, n):
        found = jnp.argmax(x) + n if first == "index" else (x > 0) & (n > 0)
        return found, x[n] ** 3

    x, n = numbers("float64")[0], jnp.asarray(1)
    for f in (lead, fuse(lead)):
        got = jax.jit(f)(x, n)
        close(got, lead(x, n))
        slope = jax.jit(jax.grad(lambda x, f=f: f(x, n)[1]))(x)
        close(slope, jnp.zeros_like(x).at[1].set(3 * x[1] ** 2))
        tangents = jax.jit(lambda x, f=f: jax.jvp(lambda x: f(x, n), (x,), (x,)))(x)[1]
        assert tangents[0].dtype == jax.dtypes.float0
        close(tangents[1], 3 * x[1] ** 3)
        close(jax.jit(jax.vmap(f, (None, 0)))(x, jnp.arange(3))[1], x**3)


@pytest.mark.slow
def test_no_results_and_no_arguments():
    assert jax.jit(fuse(lambda x: (None, ())))(jnp.ones(3)) == (None, ())
    assert fuse(lambda: 3)() == 3  # nothing traced: the part itself, not through JAX
    assert jax.jit(lambda x: fuse(lambda: x + 1)())(jnp.ones(())) == 2


@pytest.mark.slow
def test_linear_parts_are_transposed():
    x, y = numbers("float64")
    f = fuse(lambda v: (2 * v, x * v[::-1]))
    got = jax.vjp(f, y)[1]((x, y))
    np.testing.assert_allclose(got[0], 2 * x + (x * y)[::-1], rtol=1e-15)
    # The marked result does not depend on what it is linear in.
    got = jax.vjp(lambda v: fuse(part_of_it)(x, v)[1], y)[1](x)
    np.testing.assert_allclose(got[0], (x * x)[::-1], rtol=1e-15)


def part_of_it(x, v):
    return jnp.sin(x), x * v[::-1]


def compiled(f, *at) -> str:
    return str(jax.jit(f).lower(*at).compile().as_text())


def test_one_kernel_is_one():
    """Sixty rounds of Newton's method for cube roots, each of several kernels by itself."""

    def root(x, a):
        def step(_, x):
            ahead = x - (x**3 - a) / (3 * x**2)
            return jnp.where(jnp.max(jnp.abs(ahead - x)) > 0, ahead, x)

        return jax.lax.fori_loop(0, 60, step, x + a)

    a = jnp.linspace(1, 27, 300, dtype="float64")
    marked, one = fuse(root), jnp.ones_like(a)
    np.testing.assert_allclose(jax.jit(marked)(one, a), np.cbrt(a), rtol=8 * epsilon(a.dtype))
    if fusion._one_kernel_p is not None:
        assert count_kernels(compiled(root, one, a))[0] > 60
        assert count_kernels(compiled(marked, one, a), inside=False) == (1, 0)
    many = compiled(jax.vmap(marked), jnp.stack([one] * 4), jnp.stack([a] * 4))
    assert ONE not in many


@pytest.mark.slow
def test_derivatives_of_one_kernel_are_one_each():
    """Sum of y exp(-x^2): there, back, and back of what goes there, against calculus."""
    x, y = numbers("float64", (100,))
    each = fuse(lambda x, y: (y * jnp.exp(-(x**2)), jnp.argmax(x)))

    def of(x, y):
        return jnp.sum(each(x, y)[0])

    bell = jnp.exp(-(x**2))
    back = jax.grad(of, argnums=(0, 1))
    close(jax.jit(back)(x, y), (-2 * x * y * bell, bell))
    there = jax.jit(lambda x, y: jax.jvp(lambda x: each(x, y)[0], (x,), (y,))[1])
    close(there(x, y), -2 * x * y**2 * bell)
    curved = jax.jit(jax.grad(lambda x: jnp.sum(jax.grad(of)(x, y) * y)))
    close(curved(x), (4 * x**2 - 2) * y**2 * bell)
    lanes = jax.jit(jax.vmap(back))(x[:, None], y[:, None])
    close(jax.tree.map(lambda v: v[:, 0], lanes), (-2 * x * y * bell, bell))
    if fusion._one_kernel_p is not None:
        for f in (lambda x: jax.grad(of)(x, y), lambda x: there(x, y)):
            calls = [v for v in compiled(f, x).split("\n") if " call(" in v]
            assert [ONE in v for v in calls] == [True]
            assert ONE not in compiled(jax.vmap(f), x[None].repeat(4, 0))


@pytest.mark.slow
def test_what_is_not_used_has_no_part_in_a_derivative():
    """The root has a slope without bound at 0, of which 0 times is no number."""
    marked = fuse(lambda x: (2 * x, jnp.sqrt(x)))
    slope = jax.jit(jax.grad(lambda x: marked(x)[0]))
    assert slope(0.0) == 2
    assert jax.jit(jax.vmap(slope))(jnp.zeros(3)).tolist() == [2, 2, 2]


@pytest.mark.slow  # all that lives is searched, often
def test_nothing_traced_is_kept():
    """A part that closes over what is traced, and its derivatives, once and twice."""

    def of(x):
        return jnp.sum(fuse(lambda v: jnp.sin(v) * x)(x * 2))

    x = jnp.arange(3.0)
    with jax.checking_leaks():
        got = jax.jit(jax.grad(of))(x), jax.jit(jax.hessian(of))(x)
    first = 2 * x * np.cos(2 * x) + np.sin(2 * x)
    np.testing.assert_allclose(got[0], first, rtol=1e-14)
    np.testing.assert_allclose(
        got[1], np.diag(4 * np.cos(2 * x) - 4 * x * np.sin(2 * x)), atol=1e-14
    )


def test_a_loop_that_reads_slices_is_one_kernel_whatever_it_reads():
    """More entries than are small, a row a round: only where it is said."""

    def summed(rows):
        return jax.lax.scan(lambda s, row: (s + row, s * row), jnp.zeros_like(rows[0]), rows)[1]

    rows = jnp.linspace(0, 1, 400 * 200).reshape(400, 200)
    assert rows.size > fusion.SMALL
    marked = fuse(summed, streams=True)
    np.testing.assert_allclose(jax.jit(marked)(rows), summed(rows), rtol=1e-14)
    if fusion._one_kernel_p is not None:
        assert ONE in compiled(marked, rows)
        assert ONE not in compiled(fuse(summed), rows)


UNFIT = {
    "product": lambda x, y: jnp.outer(x, x) @ y,
    "places": lambda x, y: x.at[jnp.array([0, 2])].set(y[:2]),
    "sorted": lambda x, y: jnp.sort(x) + jax.lax.top_k(y, 1)[0],
    "solve": lambda x, y: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), y),
    "in a branch": lambda x, y: jax.lax.cond(x[0] > 0, lambda: jnp.sort(x), lambda: y),
    "large": lambda x, y: (x, jnp.zeros(70_000) + y[0]),
    "empty": lambda x, y: x[:0] + y[:0],
}


@pytest.mark.slow
@pytest.mark.parametrize("what", list(UNFIT))
def test_what_one_kernel_cannot_hold_is_compiled_as_before(what):
    """Sorting, libraries, large arrays and those without entries."""
    x, y = numbers("float64")
    part = UNFIT[what]
    close(jax.jit(fuse(part))(x, y), jax.jit(part)(x, y))
    assert ONE not in compiled(fuse(part), x, y)


@pytest.mark.slow
def test_inputs_that_one_kernel_does_not_read():
    """The compiler would end the process.

    A constant, an argument of which only the shape is used, one that comes out as it is, a truth
    value, and the same argument twice.
    """
    x, y = numbers("float64")
    turn = jnp.eye(3)

    def part(x, y, turn, n, on, again):
        return jnp.where(on, jnp.sin(x), 0), jnp.zeros_like(y), n, again, x + turn[0]

    def run(x, y):
        return fuse(part)(x, y, turn, jnp.asarray(7), x[0] > -9, x)

    for f in (run, jax.vmap(run)):
        at = (x, y) if f is run else (x[None], y[None])
        sine, nothing, seven, same, moved = (jnp.squeeze(v) for v in jax.jit(f)(*at))
        np.testing.assert_allclose(sine, np.sin(x), rtol=1e-14)
        assert not nothing.any()
        assert seven == 7
        np.testing.assert_array_equal(same, x)
        np.testing.assert_array_equal(moved, x + np.array([1.0, 0, 0]))


@pytest.mark.slow
def test_another_compiler_has_the_part_itself(monkeypatch):
    """With a jaxlib that nobody has tried."""
    monkeypatch.setattr(fusion, "_one_kernel_p", None)
    x, y = numbers("float64")
    marked = fuse(part)
    close(jax.jit(marked)(x, y), part(x, y))
    assert ONE not in compiled(marked, x, y)


@pytest.mark.slow
def test_without_single_kernels():
    """The switch in the environment, read when the package is imported."""
    program = "from jaxtrachea import fusion as m; assert m._one_kernel_p is None"
    environment = os.environ | {"JAXTRACHEA_ONE_KERNEL": "0"}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


REDUCTIONS = {
    "sum": jnp.sum,
    "largest of columns": lambda x: jnp.max(x.reshape(8, -1), axis=0),
    "largest": largest,
    "sum of rows": lambda x: jnp.sum(x.reshape(-1, 8), axis=1),
    "place": jnp.argmax,
    "in a loop": lambda x: jax.lax.fori_loop(0, 3, lambda _, v: v + jnp.min(x), jnp.sin(x[0])),
}


@pytest.mark.slow
@pytest.mark.parametrize("entries", [4000, 4096])
@pytest.mark.parametrize("what", list(REDUCTIONS))
def test_reductions_of_many_entries(what, entries):
    """The compiler refuses those of 4,096 entries and more in a kernel."""
    part = REDUCTIONS[what]
    x = jnp.asarray(np.random.default_rng(3).uniform(0, 1, entries), "float64")
    marked = fuse(part)
    np.testing.assert_allclose(jax.jit(marked)(x), part(x), rtol=1e2 * epsilon(x.dtype))
    if fusion._one_kernel_p is not None:
        assert (ONE in compiled(marked, x)) == (entries == 4000)


@pytest.mark.slow
def test_what_is_not_numbers_is_not_in_one_kernel():
    """Keys of random numbers, and complex ones."""
    x, key = numbers("float64")[0], jax.random.key(3)
    for extra in (key, jnp.asarray(1 + 2j)):
        marked = fuse(lambda x, extra: (jnp.sin(x), extra))
        np.testing.assert_allclose(jax.jit(marked)(x, extra)[0], np.sin(x), rtol=1e-14)
        assert ONE not in compiled(marked, x, extra)


@pytest.mark.slow
def test_programs_for_several_devices_have_no_marks():
    """One text for all of them; for another device alone too."""
    x, y = numbers("float64")
    for devices in (("cpu", "cuda"), ("cuda",)):
        text = jax.export.export(jax.jit(fuse(part)), platforms=devices)(x, y).mlir_module()
        assert "inlineable" not in text
        assert "small_call" not in text


#: Presses as scenes make them: each with what it takes beside the others.
PRESSES = {
    "arch2, shear, bonded": ObliqueOptions(Options(contact="bonded", shear=True)),
    "total coupling": ObliqueOptions(Options(coupling="total")),
}
SCRAPES = {"friction": ObliqueOptions(rings="arch2")}
PUNCHES = {
    "punch, shear, two materials": Options(half_width=2.0, shear=True, local="two-material"),
}


def pressed(name):
    """The press of this name, by tube, material, place and displacements."""

    def run(geometry, material, s, D):
        if name in PUNCHES:
            return press(geometry, material, s, D[:, 1], PUNCHES[name])
        if name in SCRAPES:
            return press_path(geometry, material, s, 0.3, D, Coulomb(0.3), SCRAPES[name])
        return press_oblique(geometry, material, s, 0.3, D, PRESSES[name])

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["punch, shear, two materials", "arch2, shear, bonded", "total coupling", "friction"]
)
def test_presses_and_their_derivatives_fit_one_kernel(name):
    """What scenes put into a kernel: with a product or a scatter it would be hundreds."""
    names = "EI_L k_M k_1 k_3 EA_L EI_C k_t GA_L k_A k_1_ring".split()
    material = Material(**dict.fromkeys(names, 1.0))
    given = table_1(), jax.tree.map(jnp.asarray, material), jnp.asarray(70.0), jnp.ones((2, 3))

    def numbers(*given):
        leaves = jax.tree.leaves(pressed(name)(*given))
        return [v for v in leaves if jnp.issubdtype(v.dtype, jnp.floating)]

    def push(given, tangents):
        return jax.jvp(numbers, given, tangents)[1]

    def pull(given, cotangents):
        return jax.vjp(numbers, *given)[1](cotangents)

    ways = (numbers, *given), (push, given, given), (pull, given, jax.eval_shape(numbers, *given))
    for f, *arguments in ways:
        assert fusion.fits_one_kernel(jax.make_jaxpr(f)(*arguments).jaxpr), f.__name__


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 33, 501])
def test_running_sums_are_in_one_kernel(n):
    """Stretches of the ligament add up from either end: of any number of rings, there and back."""
    x = jnp.asarray(np.random.default_rng(8).normal(size=n), "float64")
    f = fuse(lambda x: jnp.cumsum(x) + 2 * jnp.cumsum(x[::-1])[::-1])
    run = jax.jit(f).lower(x).compile()
    assert (ONE in run.as_text()) == (fusion._one_kernel_p is not None)
    v = np.asarray(x, float)
    atol = 4 * n * epsilon(x.dtype)
    np.testing.assert_allclose(run(x), v.cumsum() + 2 * v[::-1].cumsum()[::-1], rtol=0, atol=atol)
    # By hand: entry i is in n - i sums from the front, and twice in i + 1 from the back.
    i = np.arange(n)
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(f(x)))(x), n - i + 2 * (i + 1))


def test_a_tool_of_few_corners_is_in_the_kernel_that_lays_out_a_dent():
    """Its distance from the dent's centres, in turn; a sphere's is a formula."""
    pose = Poses(jnp.eye(3), jnp.asarray([70.0, 15.0, 0.0]))
    tool = capsule(2.0, 6.0)
    program = jax.make_jaxpr(lambda points: sag(tool, pose, points))(jnp.ones((16, 3)))
    assert fusion.fits_one_kernel(program.jaxpr)


@pytest.mark.slow
def test_a_loss_of_a_press_by_its_public_name():
    """As docs/layer.md has it: value and derivatives against the closed form, alone and in lanes.

    The skeleton is all but rigid, so the force is k_1 times the depth.
    """
    tube = jax.tree.map(lambda v: jnp.asarray(v, "float64"), table_1())
    stiff = jnp.asarray(1e9, "float64")

    @jaxtrachea.fuse
    def loss(k_1, depth):
        return press(tube, Material(stiff, stiff, k_1, 0.0), tube.length / 2, depth).force ** 2

    k_1, depth = jnp.asarray([0.5, 2.0], "float64"), jnp.asarray([1.0, 3.0], "float64")
    expected, slope = (k_1 * depth) ** 2, 2 * k_1 * depth**2
    tolerance = 64 * epsilon("float64") + 1e-7  # of the skeleton, which is not rigid
    one, many = jax.jit(jax.value_and_grad(loss)), jax.jit(jax.vmap(jax.value_and_grad(loss)))
    forward = jax.jit(lambda k, d: jax.jvp(loss, (k, d), (jnp.ones_like(k), jnp.zeros_like(d))))
    for i in range(2):
        for way in (one, forward):
            np.testing.assert_allclose(
                way(k_1[i], depth[i]), (expected[i], slope[i]), rtol=tolerance
            )
    np.testing.assert_allclose(many(k_1, depth), (expected, slope), rtol=tolerance)
    if fusion._one_kernel_p is not None:
        assert compiled(one, k_1[0], depth[0]).count(ONE) > 0
    assert ONE not in compiled(many, k_1, depth)
