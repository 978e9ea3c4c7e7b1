"""A bound press is `press`: numbers, statuses, errors, derivatives; and it compiles once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from late import late

import jaxtrachea as jt
from jaxtrachea import Material, Options, press, table_1
from jaxtrachea.status import PressStatus

DEPTHS = np.linspace(0.0, 6.0, 7)
VALUES = {"EI_L": 1400.0, "k_M": 0.2, "k_1": 20.0, "k_3": 0.5, "GA_L": 9.0}
SHEAR = Options(shear=True)


def material(dtype, **changes):
    return Material(**{k: jnp.asarray(v, dtype) for k, v in (VALUES | changes).items()})


@pytest.fixture(scope="module", params=["float64", *late("float32")])
def bound(request):
    """The program, the tube and `press` of a dtype."""
    dtype = request.param
    tube = table_1(dtype=dtype)
    program = jt.bind(tube, material(dtype), 75.0, DEPTHS.astype(dtype), SHEAR)
    whole = jax.jit(lambda m, s, D, o: press(tube, m, s, D, SHEAR, onset=o))
    return program, whole, np.dtype(dtype)


@pytest.mark.parametrize(
    ("s", "changes", "status"),
    [
        (75.0, {}, PressStatus.OK),
        (22.0, {"k_M": 0.6, "k_3": 0.0}, PressStatus.OK),
        (161.0, {}, PressStatus.OFF_TUBE),
        (75.0, {"k_1": -1.0}, PressStatus.BAD_MATERIAL),
        (75.0, {"EI_L": 1e9, "GA_L": 1e6, "k_M": 1e4, "k_1": 5.0, "k_3": -1.0}, PressStatus.PULLS),
    ],
)
def test_it_is_press(bound, s, changes, status):
    program, whole, dtype = bound
    m, D = material(dtype, **changes), DEPTHS.astype(dtype)
    known = whole(m, jnp.asarray(s, dtype), D, jnp.asarray(0.25, dtype))
    numbers = program.pack(m, s, D, onset=0.25)
    for given in (numbers, jnp.asarray(numbers)):
        found = program.result(program(given))
        for name, a, b in zip(known._fields, found, known, strict=True):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            scale = np.abs(b)
            if b.ndim > 1:  # of rings: far ones are sums that cancel, exact to the row's largest
                scale = np.max(scale, axis=-1, keepdims=True)
            a, b = (v / np.where(scale > 0, scale, 1) for v in (a, b))
            np.testing.assert_allclose(a, b, rtol=0, atol=100 * np.finfo(dtype).eps, err_msg=name)
    assert status in found.status
    assert found.status.dtype == np.int8


def test_force_in_closed_form():
    """Without rings and cubic stiffness: two springs in series, the clamped beam and k_1."""
    tube = jt.Geometry.create(160.0, [80.0])
    program = jt.bind(tube, Material(1.862, 0.0, 0.3, 0.0), 80.0, 1.0)
    for k_1, D in ((0.3, 2.0), (5.0, 3.0)):
        out = program(program.pack(Material(1.862, 0.0, k_1, 0.0), 80.0, D, onset=0.5))
        C = 160.0**3 / (192 * 1.862)
        np.testing.assert_allclose(program.result(out).force, (D - 0.5) / (C + 1 / k_1), rtol=1e-12)


def test_views_on_what_goes_in(bound):
    program, _, dtype = bound
    numbers = program.pack(material(dtype), 75.0, DEPTHS.astype(dtype))
    given = program.given(numbers)
    given.material.k_M[...], given.s_c[...], given.displacement[3] = 0.3, 60.0, 2.5
    changed = DEPTHS.astype(dtype)
    changed[3] = 2.5
    expected = program.pack(material(dtype, k_M=0.3), 60.0, changed)
    np.testing.assert_array_equal(numbers, expected)
    before = program(numbers)
    kept = np.array(before)
    given.s_c[...] = 30.0
    np.testing.assert_array_equal(before, kept)


def test_other_numbers_compile_nothing(bound):
    program, _, dtype = bound
    D = DEPTHS.astype(dtype)
    program(jax.device_put(program.pack(material(dtype), 75.0, D)))
    others = [material(dtype, k_M=0.1 * k) for k in range(1, 4)]
    with compilations() as counted:
        for m in others:
            numbers = program.pack(m, 40.0, D)
            program.result(program(numbers))
            program.result(program(jax.device_put(numbers)))
    assert not counted
    with compilations() as counted:  # the count sees one
        jax.jit(lambda v: v * 1.23456)(1.0)
    assert counted


@pytest.mark.slow
@pytest.mark.compiling
def test_within_jit_vmap_and_derivatives(bound):
    program, whole, dtype = bound
    m, D = material(dtype), DEPTHS.astype(dtype)
    rows = np.stack([program.pack(m, s, D) for s in (40.0, 75.0, 170.0)])
    out = jax.jit(jax.vmap(lambda v: program.result(program(v))))(rows)
    for s, force, status in zip((40.0, 75.0, 170.0), out.force, out.status, strict=True):
        known = whole(m, jnp.asarray(s, dtype), D, jnp.zeros((), dtype))
        np.testing.assert_allclose(force, known.force, rtol=200 * np.finfo(dtype).eps)
        np.testing.assert_array_equal(status, known.status)

    def last(numbers):
        return program.result(program(numbers)).force[-1]

    slope = program.given(np.array(jax.grad(last)(jnp.asarray(rows[1]))))
    known = jax.grad(lambda m, s: whole(m, s, D, jnp.zeros((), dtype)).force[-1], (0, 1))(
        m, jnp.asarray(75.0, dtype)
    )
    expected = [*jax.tree.leaves(known[0]), known[1]]
    found = [*jax.tree.leaves(slope.material), slope.s_c]
    np.testing.assert_allclose(found, expected, rtol=1e-3 if dtype == np.float32 else 1e-9)
    if dtype == np.float64:
        step = np.zeros_like(rows[1])
        program.given(step).s_c[...] = 1e-4
        numeric = (last(jnp.asarray(rows[1] + step)) - last(jnp.asarray(rows[1] - step))) / 2e-4
        np.testing.assert_allclose(slope.s_c, numeric, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_python_numbers_and_blend():
    program = jt.bind(table_1(), Material(1.862, 0.1, 0.3, 0.02), 75, [1, 2], blend=0.2)
    assert program.dtype == np.float64
    numbers = program.pack(Material(2.0, 0.2, 0.4, 0.0), 40, [2, 3], onset=1, blend=0.1)
    known = press(table_1(), Material(2.0, 0.2, 0.4, 0.0), 40, [2, 3], onset=1, blend=0.1)
    np.testing.assert_allclose(program.result(program(numbers)).force, known.force, rtol=1e-13)


def same_error(*calls):
    """The text of the ValueError that all of them raise."""
    texts = set()
    for call in calls:
        with pytest.raises(ValueError) as told:  # noqa: PT011
            call()
        texts.add(str(told.value))
    assert len(texts) == 1, texts
    return texts.pop()


def test_refusals_as_press():
    tube, m = table_1(), material("float64")
    program = jt.bind(tube, m, 75.0, DEPTHS, SHEAR)
    wrong = material("float64", k_M=np.ones(4))
    for args in ((wrong, 75.0, DEPTHS), (m, [1.0, 2.0], DEPTHS), (m, 75.0, "deep")):
        text = same_error(
            lambda a=args: press(tube, *a, SHEAR),
            lambda a=args: jt.bind(tube, *a, SHEAR),
            lambda a=args: program.pack(*a),
        )
        assert "expected" in text
    bare = Material(1.862, 0.1, 0.3, 0.02)
    same_error(
        lambda: press(tube, bare, 75.0, 1.0, SHEAR), lambda: jt.bind(tube, bare, 75.0, 1.0, SHEAR)
    )
    with pytest.raises(ValueError, match="bind presses a line of joints"):
        jt.bind(tube, m, 75.0, 1.0, Options(skeleton="sections", contact="bonded"))


def test_refusals_of_what_was_not_bound():
    tube, m = table_1(), material("float64")
    program = jt.bind(tube, m, 75.0, DEPTHS, SHEAR)
    bare = Material(**{k: v for k, v in VALUES.items() if k != "GA_L"})
    for call, says in (
        (lambda: program.pack(bare, 75.0, DEPTHS), "Material.GA_L is missing.*compiled with it"),
        (lambda: program.pack(m, 75.0, DEPTHS[:3]), "displacement has 3 values;.*for 7 values"),
        (lambda: program.pack(m, 75.0, 1.0), "displacement has no axis"),
        (lambda: program.pack(m, 75.0, DEPTHS.astype("float32")), "displacement is float32"),
        (lambda: program.pack(m, 75.0, DEPTHS, blend=0.1), "blend: .* without it"),
        (lambda: program(np.zeros(3)), r"numbers is float64 of shape \(3,\); expected float64"),
        (lambda: program(np.zeros(program.size, "float32")), "numbers is float32"),
        (lambda: program([0.0]), "numbers is list; expected"),
    ):
        with pytest.raises(ValueError, match=says):
            call()
