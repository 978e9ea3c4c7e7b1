"""What presses refuse: words, shapes, places off the tube, negative stiffnesses.

Statuses and gradients are checked against presses of the good rows alone, values of refused ones
against NaN; nothing here is a number of the code's own.
"""

import ast
import dataclasses
import functools
import importlib
import inspect
import json
import math
import pathlib
import subprocess
import sys
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrachea
from jaxtrachea.fitting.descent import Descent
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.mechanics import beam
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique, press_path
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.skeleton import skeleton_response
from jaxtrachea.mechanics.vector_equilibrium import press_vector_total
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses, Presses
from jaxtrachea.scene.sweep import sweep
from jaxtrachea.status import PressStatus, RingStatus
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling

VALUES = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02}
FULL = VALUES | {"EA_L": 3.9, "EI_C": 13.0, "k_t": 0.4}
OK, OFF, BAD = PressStatus.OK, PressStatus.OFF_TUBE, PressStatus.BAD_MATERIAL
PACKAGE = pathlib.Path(jaxtrachea.__file__).parent
BEAM = beam.Beam(jnp.array([3.0]), jnp.array(9.0), jnp.ones(2), jnp.ones(1))


def bare(kind, start=None, **changes):
    """Make a record as users do, who have no checker of annotations in front of it."""
    record, kinds = object.__new__(kind), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value = getattr(start, field.name, None if start else field.default)
        if value is dataclasses.MISSING and dataclasses.is_dataclass(inner := kinds[field.name]):
            value = object.__new__(inner)
        object.__setattr__(record, field.name, changes.get(field.name, value))
    if not start and kind is Parameter:
        return bare(kind, DEFAULTS["k_1"], **changes)
    if hasattr(record, "effects"):  # a `Plan`
        for field, word in (
            ("contact_point", "fixed"),
            ("rings", "mat"),
            ("dent", 0),
            ("surface", None),
            ("options", Options()),
        ):
            object.__setattr__(record, field, changes.get(field, word))
        for field in ("contact", "curved", "friction", "second_plane", "axial", "end_motion",
                      "joints", "ring_ends"):  # fmt: skip
            object.__setattr__(record, field, False)
    record.__post_init__()
    return record


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"split": "indep"}, "split is 'indep'; expected 'continuous' or 'independent'"),
        ({"form": "x"}, "form is 'x'; expected 'recursion' or 'reactions'"),
        ({"contact": "bond"}, "contact is 'bond'; expected 'unilateral' or 'bonded'"),
        ({"coupling": "serie"}, "coupling is 'serie'; expected 'series' or 'total'"),
        ({"local": "two"}, "local is 'two'; expected 'uniform' or 'two-material'"),
        ({"shear": "off"}, "shear is 'off'; expected True or False"),
        ({"onset_width": -1}, "onset_width is -1; expected a finite number, 0 or more"),
        ({"onset_width": math.nan}, "onset_width is nan; expected a finite number, 0 or more"),
        ({"transition": 0.0}, "transition is 0 mm; expected more than 0, or None"),
    ],
)
def test_options(change, says):
    with pytest.raises(ValueError, match=f"^{says}"):
        bare(Options, **change)
    assert bare(Options, transition=np.float64(2), onset_width=0, shear=True)


def test_other_records():
    """Numbers and words of every other record that is made by hand."""
    for kind, change in (
        (Settings, {"method": "lm"}),
        (Settings, {"starts": 0}),
        (Settings, {"starts": 1.5}),
        (Settings, {"decades": math.nan}),
        (Settings, {"tolerances": Tolerances(iterations=0)}),
        (Settings, {"tolerances": Tolerances(cost=-1.0)}),
        (Noise, {"force": 0.0}),
        (Noise, {"joints": math.inf}),
        (Weighting, {"balance": "curves"}),
        (Weighting, {"loss": "square"}),
        (Weighting, {"loss_scale": 0.0}),
        (Weighting, {"loss_scale": math.inf}),
        (ObliqueOptions, {"axial": "on"}),
        (Descent, {"method": "sgd"}),
        (Descent, {"learning_rate": math.nan}),
        (EffectOptions, {"contact_point": "every"}),
        (EffectOptions, {"onset_width": -1.0}),
        (EffectOptions, {"want_joints": "no"}),
        (Parameter, {"scale": "ln"}),
        (Parameter, {"scope": "specimens"}),
        (Parameter, {"step": 0.0}),
    ):
        with pytest.raises(ValueError, match="expected"):
            bare(kind, **change)
        bare(kind)


def has_words(hint):
    """Whether a `Literal` stands anywhere in a hint."""
    if typing.get_origin(hint) is typing.Literal:
        return any(isinstance(word, str) for word in typing.get_args(hint))
    return any(map(has_words, typing.get_args(hint)))


#: Imported by some modules for their annotations only.
FOR_TYPES = {"Lane": Lane}


def takes_words():
    """Public functions of the package with an argument that is a `Literal`."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(["jaxtrachea", *path.relative_to(PACKAGE).with_suffix("").parts])
        if "__" in name or "cli" in name:
            continue
        functions = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)]
        for node in functions:
            if not node.name.startswith("_"):
                function = inspect.unwrap(getattr(importlib.import_module(name), node.name))
                for argument, hint in typing.get_type_hints(function, localns=FOR_TYPES).items():
                    if argument != "return" and has_words(hint):
                        yield f"{name.removeprefix('jaxtrachea.')}.{node.name}", argument


def any_words(function, argument):
    """Call a function with a word that there is not; all else is never looked at."""
    signature = inspect.signature(function)
    filled = {
        n: None if p.default is p.empty else p.default for n, p in signature.parameters.items()
    }
    known = {"geometry": table_1(), "material": Material(**FULL), "s_c": 40.0, "phi_c": 0.0,
             "displacement": np.zeros((1, 3)), "force": 1.0, "count": 100,
             "block": 1, "options": Options(), "beam": BEAM}  # fmt: skip
    filled |= {n: v for n, v in known.items() if n in filled}
    return function(**filled | {argument: "no such word"})


#: Called by what checks the word, with its own word; never from outside.
INNER = {
    "mechanics.compliance.divide_load", "mechanics.reactions.deflect_dense",
    "mechanics.beam.deflect_on",
    "mechanics.skeleton.respond", "mechanics.skeleton.read_values",
    "mechanics.energy.gradient", "mechanics.skeleton.turned_rings", "fitting.noise.normal_psi2",
}  # fmt: skip


def test_no_function_runs_a_misspelt_word():
    """Any argument of any public function that is one of several words."""
    seen = set()
    for name, argument in takes_words():
        module, _, function = f"jaxtrachea.{name}".rpartition(".")
        seen.add(name)
        if name in INNER:
            continue
        real = inspect.unwrap(getattr(importlib.import_module(module), function))
        with pytest.raises(ValueError, match="'no such word'.*expected"):
            any_words(real, argument)
    assert seen >= INNER | {
        "mechanics.beam.deflect",
        "mechanics.skeleton.skeleton_response",
    }


def test_no_record_keeps_a_misspelt_word():
    """Any field of any dataclass that is one of several words (specifications: pydantic)."""
    seen = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(["jaxtrachea", *path.relative_to(PACKAGE).with_suffix("").parts])
        if "__" in name or "cli" in name:
            continue
        for node in ast.parse(path.read_text()).body:
            kind = isinstance(node, ast.ClassDef) and getattr(
                importlib.import_module(name), node.name
            )
            if not (kind and dataclasses.is_dataclass(kind)) or node.name in RESULTS:
                continue
            for field, hint in typing.get_type_hints(kind).items():
                if has_words(hint):
                    seen.add(node.name)
                    with pytest.raises(ValueError, match="'no such word'; expected"):
                        bare(kind, **{field: "no such word"})
    assert seen >= {
        "Options", "EffectOptions", "Plan", "Settings", "Parameter", "Levels", "Weighting",
        "Descent", "ObliqueOptions",
    }  # fmt: skip


#: Made by the package out of words that were checked.
RESULTS = {"Bootstrap", "Request", "Study", "Situation", "Choice", "Ladder"}


@functools.cache
def compiled(which):
    """Presses of one kind: status, force and compliance; arguments material and s_c."""
    g, inward = table_1(), np.array([0.0, -1.0, 0.0])
    more = {"local": "two-material", "shear": True}

    def one(values, s):
        m = Material(**{n: v for n, v in values.items() if n != "friction"})
        if which == "press":
            out = press(g, m, s, [0.0, 1.0, 3.0], Options(**more))
            return out.status, out.force, out.compliance
        if which == "oblique":
            out = press_oblique(g, m, s, 0.3, inward, ObliqueOptions(Options(**more)))
            return out.status, out.force, out.joints
        if which == "path":
            mu = Coulomb(values["friction"])
            out = press_path(g, m, s, 0.3, np.stack([inward, 2 * inward]), mu)
            return out.press.status, out.press.force, out.slip
        out = skeleton_response(g, m, s, 0.3, shear=True)
        return out.status, out.compliance, out.loads

    def summed(values, s):
        status, force, more = one(values, s)
        return jnp.sum(jnp.where(jnp.isfinite(force), force, 0)), (status, force, more)

    return jax.jit(jax.vmap(jax.value_and_grad(summed, (0, 1), has_aux=True), (0, 0)))


ALL = FULL | {"GA_L": 1.1, "k_1_ring": 0.9, "EI_side": 1.5, "GA_side": 1.3, "k_A": 1.0, "k_B": 2.0}
ALL["friction"] = 0.5
READ = {
    "press": ("EI_L", "k_M", "k_1", "GA_L", "k_1_ring"),
    "oblique": ("EI_L", "EI_side", "k_M", "k_1", "GA_L", "GA_side", "k_1_ring", "EI_C", "k_t",
                "EA_L", "k_A", "k_B"),
    "path": ("EI_L", "EI_side", "k_M", "k_1", "EI_C", "k_t", "EA_L", "k_A", "k_B",
             "friction"),
    "skeleton": ("EI_L", "EI_side", "k_M", "GA_L", "GA_side", "EI_C", "k_t", "EA_L", "k_A", "k_B"),
}  # fmt: skip


@pytest.mark.parametrize(
    "which",
    ["press", *(pytest.param(n, marks=pytest.mark.slow) for n in ("oblique", "path", "skeleton"))],
)
def test_statuses_in_a_batch(which):
    """Off the tube and each negative stiffness in turn: NaN with a status of their own.

    Good rows keep every bit, and all derivatives are finite: those of refused rows are 0. Values
    that the model does not read, and k_3, may be negative.
    """
    read = READ[which]
    rows = [{}, *({n: -0.1} for n in read), {"k_3": -1e-4}, {}, {}, {}]
    s = np.array([63.0] * (len(rows) - 3) + [-1e-9, 160.0001, 400.0])
    refused = np.array([0, *[1] * len(read), 0, 1, 1, 1], bool)
    wanted = ["OK", *["BAD_MATERIAL"] * len(read), "OK", *["OFF_TUBE"] * 3]
    values = {n: np.array([row.get(n, v) for row in rows]) for n, v in ALL.items()}
    (_, (status, force, more)), slopes = compiled(which)(values, s)
    names = RingStatus if which == "skeleton" else PressStatus
    last = np.asarray(status).reshape(len(rows), -1)[:, -1]
    assert [names(int(k)).name for k in last] == wanted
    for out in (force, more):
        bad = ~np.isfinite(np.asarray(out)).reshape(len(rows), -1)
        np.testing.assert_array_equal(bad.all(axis=1), refused)
        np.testing.assert_array_equal(bad.any(axis=1), refused)
    for slope in jax.tree.leaves(slopes):
        assert np.all(np.isfinite(slope))
        assert np.all(slope[refused] == 0)
    alone = {n: np.repeat(v[:1], len(rows)) for n, v in values.items()}
    (_, (_, same, _)), others = compiled(which)(alone, np.full(len(rows), 63.0))
    np.testing.assert_array_equal(force[0], same[0])
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(others), strict=True):
        np.testing.assert_array_equal(a[0], b[0])


def test_zero_limits():
    """A cut span, its stiffness to 0; no rings, k_M = 0: a beam between two clamps; both ends."""
    run = jax.jit(jax.vmap(lambda EI, k, s: press(table_1(), Material(EI, k, 0.3, 0.02), s, 1.0)))
    EI = np.full((4, 16), 1.862)
    EI[0, 3] = 1e-9
    out = run(EI, np.array([0.1, 0.0, 0.1, 0.1]), np.array([63.0, 80.0, 0.0, 160.0]))
    assert out.status.tolist() == [OK] * 4
    np.testing.assert_allclose(out.compliance[1:], [160.0**3 / (192 * 1.862), 0, 0], rtol=1e-12)


@pytest.mark.slow
def test_python_numbers():
    """Numbers, integers, lists and numpy arrays are the arrays they stand for, in both dtypes."""
    run = jax.jit(lambda *arguments: press(*arguments))  # a cache of its own: counted below
    for dtype in (jnp.float64, jnp.float32):
        g = table_1(dtype=dtype)
        arrays = Material(**{n: jnp.asarray(v, dtype) for n, v in VALUES.items()})
        exact = run(g, arrays, jnp.asarray(40, dtype), jnp.asarray([1, 2], dtype))
        for s, D, onset in ((40.0, [1.0, 2.0], 0.0), (40, (1, 2), None), (np.int64(40), [1, 2], 0),
                            (np.float32(40), np.array([1, 2]), None)):  # fmt: skip
            m = Material(**VALUES)
            got = jax.eval_shape(functools.partial(press, g, m, s, D, onset=onset))
            assert (got.force.shape, got.force.dtype) == ((2,), dtype)
        got = jax.jit(lambda g=g: press(g, Material(**VALUES), 40, [1, 2]))()
        for a, b in zip(got, exact, strict=True):
            np.testing.assert_allclose(a, b, rtol=50 * jnp.finfo(dtype).eps)
    one = jax.jit(lambda: press(table_1(), Material(2, 1, 1, 0), 40, 2))()
    assert (one.force.shape, one.force.dtype) == ((), jnp.float64)
    for k in range(3):  # one program for every new number
        run(table_1(), Material(2.0 + k, 1.0, 1.0, 0.0), 40.0 + k, 2.0)
    assert run._cache_size() == 3
    path = functools.partial(
        press_path, table_1(), Material(**FULL), 40, 0, [[0, -1, 0]], Coulomb(1)
    )
    assert jax.eval_shape(path).press.force.shape == (1, 3)
    assert Geometry(160, [20, 40], 11, 2, 4).ring_positions.dtype == jnp.float64
    deflect = jax.jit(lambda: (beam.deflect(BEAM, 2, 1).w_C, beam.contact_compliance(BEAM, [2, 4])))
    w_C, compliance = deflect()
    np.testing.assert_allclose(compliance[0], w_C, rtol=1e-13)


PLAIN = {"s_c": 40.0, "displacement": 2.0}
WRONG = [
    ({"k_M": np.ones(14)}, PLAIN, "Material.k_M has 14 values; expected .* or 15 values .one for"),
    ({"EI_L": np.ones(15)}, PLAIN, "Material.EI_L has 15 values; .* 16 values .15 rings make 16"),
    ({"k_1": np.ones(15)}, PLAIN, "Material.k_1 has 15 values; expected no axis"),
    ({"GA_L": np.ones((2, 16))}, PLAIN, r"Material.GA_L has shape \(2, 16\); expected"),
    ({}, PLAIN | {"s_c": [1.0, 2.0]}, "s_c has 2 values; expected no axis .*jax.vmap"),
    ({}, PLAIN | {"onset": [1.0, 2.0]}, "onset has 2 values; expected no axis"),
    ({}, PLAIN | {"displacement": "2 mm"}, "displacement is '2 mm'; expected a number"),
    ({}, PLAIN | {"displacement": [[1.0], 2.0]}, "displacement is .* expected a number"),
    ({}, PLAIN | {"s_c": True}, "s_c is True; expected a number"),
]


def test_wrong_lengths():
    """Before anything is traced: the argument, its length and the expected one."""
    for values, arguments, says in WRONG:
        with pytest.raises(ValueError, match=f"^{says}"):
            press(table_1(), Material(**VALUES | values), **arguments)
    with pytest.raises(ValueError, match="k_M has 14 values"):
        jax.jit(press)(table_1(), Material(**VALUES | {"k_M": jnp.ones(14)}), 1.0, 1.0)


def test_wrong_lengths_elsewhere():
    g, m = table_1(), Material(**FULL)
    bad = Material(**FULL | {"EA_L": np.ones(3)})
    D = np.zeros((2, 3))
    path = Presses([40.0, 50.0], [0.0, 0.0], [[0, -1, 0], [0, -2, 0]])
    scene = make_scene(g, m, path, effects=EffectOptions(want_surface=False))
    flat = jnp.zeros((2, 2))
    short = eqx.tree_at(lambda p: p.phi, path, jnp.zeros(3))
    narrow = eqx.tree_at(lambda p: p.displacement, path, flat)
    one_turn = eqx.tree_at(lambda p: p.rotation, Poses(np.zeros((2, 3, 3)), D), jnp.ones((1, 3, 3)))
    for says, call in {
        r"displacement has 2 values; expected shape \(..., 3\)":
            lambda: press_oblique(g, m, 40, 0, [1, 2]),
        r"displacement has 3 values; expected shape \(steps, 3\)":
            lambda: press_path(g, m, 40, 0, [0, 1, 2], Coulomb(0.5)),
        "phi_c has 2 values": lambda: press_oblique(g, m, 40, [0, 1], D),
        "friction is 'a'": lambda: press_path(g, m, 40, 0, D, Coulomb("a")),
        "rounding is -1": lambda: Coulomb(0.5, rounding=-1.0),
        "Material.EA_L has 3 values; expected .*16": lambda: skeleton_response(g, bad, 40, 0),
        "s_c has 3 values": lambda: skeleton_response(g, m, [1, 2, 3], 0),
        "path.phi has 3 values; expected 2":
            lambda: make_scene(g, m, short, effects=EffectOptions(want_surface=False)),
        "path.rotation has": lambda: make_scene(g, m, one_turn),
        "path.displacement has": lambda: simulate(scene, m, narrow),
        "Material.EA_L has 3 ": lambda: simulate(scene, bad, path),
        "phi has 1 value; expected 2 values .as s": lambda: sweep(scene, m, [1, 2], [0], [1, 1]),
        "k_M is 'soft'; expected a number": lambda: Material(1.0, "soft", 1.0, 0.0),
        "length is 'long'; expected numbers":
            lambda: inspect.unwrap(Geometry.create.__func__)(Geometry, "long", [1.0]),
        "ring_positions has shape": lambda: Geometry.create(9.0, np.ones((1, 2))),
        r"radius has shape \(2,\)":
            lambda: inspect.unwrap(Geometry.create.__func__)(Geometry, 9.0, [1.0], radius=[1, 2]),
        "s_c has shape": lambda: beam.contact_compliance(BEAM, np.ones((2, 2))),
        "ring_load has 2 values": lambda: beam.deflect(BEAM, 1, 1, ring_load=[1, 2]),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match=f"^{says}"):
            # Traced, what comes before the refusal is not compiled; a scene needs numbers.
            call() if says.startswith("path.") else jax.eval_shape(call)


def masked(found):
    """A loss of the rows with a solution, of all that a press gives."""
    fine = (found.status == OK) | (found.status == PressStatus.NEGATIVE_LOCAL)
    numbers = [v.reshape(*fine.shape, -1) for v in (found.force, found.skeleton, found.joints)]
    rows = sum(jnp.sum(v, axis=-1) for v in numbers)
    return jnp.sum(jnp.where(fine, rows, 0))


def by_press(options):
    def loss(g, m, at, k_1, depth):
        def one(at, k_1, D):
            return press(g, dataclasses.replace(m, k_1=k_1), at, D, options)

        return masked(jax.vmap(one)(at, k_1, jnp.stack([depth / 2, depth], 1)))

    return loss


def by_oblique(g, m, at, k_1, depth):
    def one(at, k_1, D):
        return press_oblique(g, dataclasses.replace(m, k_1=k_1), at, 0.1, D)

    D = jnp.stack([depth / 2, depth], 1)[..., None] * jnp.array([[[0, -1.0, 0.1]]])
    return masked(jax.vmap(one)(at, k_1, D))


def by_scene(g, m, at, k_1, depth, scene):
    D = depth[:, None] * jnp.array([[0, -1.0, 0]])
    return masked(simulate(scene, m, Presses(at, jnp.zeros(2), D)))


def on_a_scene(loss):
    path = Presses([40.0] * 2, [0.0] * 2, [[0, -0.1, 0], [0, -0.2, 0]])
    effects = EffectOptions(contact_point="per_step", want_surface=False, want_ring_ends=False)
    scene = make_scene(table_1(), Material(**FULL), path, effects=effects)
    return functools.partial(loss, scene=scene)


#: Place, k_1 and displacement of a row without a solution.
LOST = {
    "past its fold": (40.0, 0.8, 80.0),
    "no displacement": (40.0, 0.8, np.nan),
    "infinite displacement": (40.0, 0.8, np.inf),
    "no place": (np.nan, 0.8, 1.0),
    "off the tube": (-1.0, 0.8, 1.0),
    "no stiffness": (40.0, np.nan, 1.0),
    "infinite stiffness": (40.0, np.inf, 1.0),
    "negative stiffness": (40.0, -1.0, 1.0),
}


@pytest.mark.parametrize(
    ("loss", "skip"),
    [
        (by_press(Options()), ()),
        (by_press(Options(coupling="total")), ()),
        (by_press(Options(skeleton="softening")), ()),
        pytest.param(by_oblique, (), marks=pytest.mark.slow),
        pytest.param(
            by_scene,
            ("no stiffness", "infinite stiffness", "negative stiffness"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["press", "press total", "press softening", "press_oblique", "simulate"],
)
def test_a_row_without_a_solution_leaves_shared_derivatives_as_they_are(loss, skip):
    """Those by tube and material are those of the other rows alone: 0 times NaN is NaN."""
    g, m = table_1(), Material(**FULL | {"k_3": -0.01, "e_1": 0.1, "e_2": 0.002})
    loss = on_a_scene(loss) if loss is by_scene else loss

    @jax.jit
    @jax.grad
    def grad(shared, *of_row):
        return loss(
            *shared, *(jnp.stack([v, w]) for v, w in zip((40.0, 0.8, 0.5), of_row, strict=True))
        )

    alone = jax.tree.leaves(grad((g, m), 40.0, 0.8, 0.0))
    assert any(np.any(v != 0) for v in alone)
    for name, row in LOST.items():
        if name not in skip:
            found = jax.tree.leaves(grad((g, m), *row))
            for p, q in zip(found, alone, strict=True):
                np.testing.assert_allclose(p, q, rtol=1e-12, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("options", [{}, {"coupling": "total"}, {"contact": "bonded"}], ids=str)
@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_displacement_that_is_no_number_says_nothing_of_the_onset(options, lost):
    """Nor of the angle of an oblique press: derivatives are those of the other rows alone."""
    g, m = table_1(), Material(**FULL)

    def straight(onset, D):
        return press(g, m, 40.0, D, Options(**options), onset=onset).force[0]

    def oblique(phi, onset, D):
        D = D[:, None] * jnp.array([[0.1, -1.0, 0.2]])
        found = press_oblique(g, m, 40.0, phi, D, ObliqueOptions(Options(**options)), onset=onset)
        return jnp.sum(found.force[0])

    for f, at in ((straight, (0.2,)), (oblique, (0.1, 0.2))):
        grad = jax.jit(jax.grad(f, range(len(at))))
        found, alone = (grad(*at, jnp.array([1.0, D])) for D in (lost, 2.0))
        assert all(np.asarray(alone) != 0)
        np.testing.assert_allclose(found, alone, rtol=1e-12)


@pytest.mark.parametrize("lost", [np.nan, np.inf, -1.0])
def test_a_place_off_the_beam_says_nothing_of_the_beam(lost):
    """As if it had not been asked for: `contact_compliance` of one and of many, `deflect`."""

    def one_by_one(beam_, s):
        return jnp.stack([beam.contact_compliance(beam_, v) for v in s])

    def deflected(beam_, s):
        return jax.vmap(lambda v: beam.deflect(beam_, v, 2.0).w_C)(s)

    for solve in (beam.contact_compliance, one_by_one, deflected):

        def f(beam_, s, solve=solve):
            return jnp.nansum(solve(beam_, s))

        grad = jax.jit(jax.grad(f))
        found, alone = (jax.tree.leaves(grad(BEAM, jnp.array(s))) for s in ([2.0, lost], [2.0]))
        assert all(np.any(v != 0) for v in alone)
        for p, q in zip(found, alone, strict=True):
            np.testing.assert_allclose(p, q, rtol=1e-12)


def test_a_vector_that_is_no_number_says_nothing_of_the_skeleton():
    """The printed coupling, row by row."""
    D = jnp.array([[1.0, 0.2, 0.1], [np.nan, 0, 0]])

    def force(k_1, C, D):
        solve = jax.vmap(press_vector_total, (0, None, None))
        found = solve(D, C, Law(k_1, jnp.asarray(0.1)))
        return jnp.sum(found.force[0]) + jnp.sum(found.depth[0])

    found, alone = (jax.grad(force, (0, 1))(0.8, jnp.eye(3), v) for v in (D, D[:1]))
    for p, q in zip(found, alone, strict=True):
        np.testing.assert_allclose(p, q, rtol=1e-13)
    status = press_vector_total(D[1], jnp.eye(3), Law(jnp.asarray(0.8), jnp.asarray(0.1))).status
    assert status == PressStatus.NON_FINITE


def test_friction_that_is_no_number():
    """Without limit the tool sticks; negative is a bad material, as a stiffness is."""
    D = np.linspace(0, 1, 3)[:, None] * np.array([0.1, -1.0, 0.0])
    for mu, status in ((np.nan, PressStatus.NON_FINITE), (-0.1, BAD), (np.inf, OK)):
        found = press_path(table_1(), Material(**FULL), 40.0, 0.0, D, Coulomb(mu))
        assert found.press.status[-1] == status
        assert np.isfinite(found.press.force[-1]).all() == (status == OK)
        assert not found.sliding.any()


#: Calls with what is no record of the right kind, and what is named.
NO_RECORDS = {
    "jt.press(None, m, 40.0, 1.0)": "geometry is None; expected Geometry",
    "jt.press(g, None, 40.0, 1.0)": "material is None; expected Material",
    "jt.press(g, {}, 40.0, 1.0)": "material is {}; expected Material",
    "jt.press(g, g, 40.0, 1.0)": "expected Material",
    "jt.press_oblique('x', m, 40.0, 0.0, [0, -1, 0])": "geometry is 'x'; expected Geometry",
    "jt.press_path(None, m, 40.0, 0.0, [[0, -1, 0]], jt.Coulomb(0.5))": "geometry is None",
    "jt.deflect(None, 40.0, 1.0)": "beam is None; expected Beam",
    "jt.contact_compliance(None, 40.0)": "beam is None; expected Beam",
    "jt.deflect(jt.Beam([], 9.0, [1.0], []), 4.0, 1.0)": "Beam.x has no values",
    "jt.make_scene(None, m, path)": "geometry is None",
    "jt.make_scene(g, None, path)": "material is None",
    "jt.make_scene(g, m, None)": "path is None; expected Presses or Poses",
    "jt.make_scene(g, m, path, tool='x')": "tool is 'x'; expected Tool or Shape or None",
    "jt.make_scene(g, m, path, mesh='x')": "mesh is 'x'; expected Mesh or None",
    "jt.make_scene(g, m, path, effects=None)": "effects is None; expected EffectOptions",
    "jt.Tool('x')": "tool.shape is 'x'; expected Shape or None",
    "make_tube(g, wall=None)": "wall is None; expected a finite number",
    "make_tube(g, relief='x')": "relief is 'x'; expected a finite number or None",
    "make_tube(g, around=3.5)": "around is 3.5; expected a whole number",
    "jt.simulate(None, m, path)": "scene is None; expected Scene",
    "jt.simulate(scene, m, 'x')": "path is 'x'; expected Presses or Poses",
    "jt.simulate(scene, None, path)": "material is None",
    "jt.sweep(None, m, [40.0], [0.0], [1.0])": "scene is None; expected Scene",
    "jt.sweep(scene, None, [40.0], [0.0], [1.0])": "material is None",
    "jt.sweep(scene, m, [40.0], [0.0], [1.0], chunk=0)": "chunk is 0; expected a whole number",
    "jt.sweep(scene, m, [40.0], [0.0], [1.0], chunk='x')": "chunk is 'x'; expected a whole number",
}


def test_what_is_no_record_is_named():
    """As users call, who have no checker of annotations in front of it."""
    code = """
import json, sys
import jaxtrachea as jt
from jaxtrachea.trachea.tube import make_tube
g, m = jt.table_1(), jt.Material(1.862, 0.1, 0.3, 0.02, EA_L=3.9, EI_C=13.0, k_t=0.4)
path = jt.Presses([40.0], [0.0], [[0, -1, 0]])
scene = jt.make_scene(g, m, path, effects=jt.EffectOptions(want_surface=False))
said = []
for call in json.load(sys.stdin):
    try:
        eval(call)
    except Exception as error:
        said.append(f"{type(error).__name__}: {error}")
    else:
        said.append("nothing")
print(json.dumps(said))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(list(NO_RECORDS)),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    for call, said in zip(NO_RECORDS, json.loads(done.stdout), strict=True):
        assert said.startswith(("ValueError: ", "InputError: ")), (call, said)
        assert NO_RECORDS[call] in said, (call, said)


@pytest.mark.slow
def test_scenes_and_sweeps():
    """Rows off the tube, a negative stiffness or friction: their own status; the others keep it."""
    g, m = table_1(), Material(**FULL)
    path = Presses([40.0, 400.0, -1.0], [0.0] * 3, [[0, -1, 0]] * 3)
    none = {"want_surface": False, "want_joints": False, "want_ring_ends": False}
    run, swept_by = jax.jit(simulate), jax.jit(sweep)
    for effects in (
        EffectOptions(contact_point="per_step", **none),
        EffectOptions(contact_point="per_step", second_plane="on", **none),
    ):
        scene = make_scene(g, m, path, effects=effects)
        out = run(scene, m, path)
        assert out.status.tolist() == [OK, OFF, OFF]
        np.testing.assert_array_equal(np.isnan(out.force[:, 1]), [False, True, True])
        out = run(scene, Material(**FULL | {"k_M": -0.1}), path)
        assert out.status.tolist() == [BAD] * 3
        assert np.isnan(out.force[:, 1]).all()
    points = np.array([[40.0, 200, 50], [0, 0, 0], [1, 1, 1]])
    swept = swept_by(scene, m, *points)
    assert swept.status.tolist() == [OK, OFF, OK]
    assert np.isnan(swept.compliance).tolist() == [False, True, False]
    swept = swept_by(scene, Material(**FULL | {"k_1": -0.1}), *points)
    assert swept.status.tolist() == [BAD] * 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "other"), [("k_3_ring", "k_1_ring"), ("k_5_ring", "k_1_ring"), ("GA_side", "GA_L")]
)
def test_a_value_that_would_be_ignored_is_refused(name, other):
    """Whatever presses: with the value that it needs it is taken, without it is an error."""
    given = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, name: 0.5}
    g, D = table_1(), [0.0, -1.0, 0.0]
    path = Presses(jnp.full(1, 40.0), jnp.zeros(1), jnp.asarray([D]))
    plain = Material(**{k: v for k, v in given.items() if k != name})
    scene = make_scene(g, plain, path, effects=EffectOptions(want_surface=False))
    alone = Material(**given)
    for run in (
        lambda m: press(g, m, 40.0, 1.0),
        lambda m: press_oblique(g, m, 40.0, 0.0, D, ObliqueOptions(rings="mat", axial=False)),
        lambda m: make_scene(g, m, path, effects=EffectOptions(want_surface=False)),
        lambda m: simulate(scene, m, path),
        lambda m: sweep(scene, m, [40.0], [0.0], [1.0]),
    ):
        with pytest.raises(ValueError, match=f"Material.{name}: given without Material.{other}"):
            run(alone)
    assert press(g, Material(**given, **{other: 0.9}), 40.0, 1.0).status == PressStatus.OK
