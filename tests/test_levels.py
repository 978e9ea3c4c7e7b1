"""A level is an object: every one answers the same questions, and nobody asks which it is."""

import ast
import dataclasses
import functools
import pathlib
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrachea
from jaxtrachea.config import ModelSection
from jaxtrachea.fitting import forward_residual
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import DECLARED, DEFAULTS, in_model
from jaxtrachea.fitting.residual import of_press, of_trials, residual
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.choose import LEVELS, level_of
from jaxtrachea.mechanics.levels.level import Level, Motion, Response, Size
from jaxtrachea.mechanics.levels.options import Options, Skeleton
from jaxtrachea.mechanics.levels.relaxing import Relaxing
from jaxtrachea.relaxation import laws as relaxation_laws
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

PACKAGE = pathlib.Path(jaxtrachea.__file__).parent
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
GEOMETRY = Geometry.create(60.0, [15.0, 30.0, 45.0], radius=11.7)
SIZE = Size.of(GEOMETRY)
FREE = {"fixed": False, "scope": "specimen"}
BOTH = {"onset": FREE, "force_offset": FREE}


def options_of(word):
    return Options(skeleton=word, contact="bonded" if word == "sections" else "unilateral")


def curve(s=20.0, **changes):
    D = np.linspace(0.0, 3.0, 6)
    fields = {"displacement": D, "force": 0.3 * D, "s_c": s, "phi_c": 0.0}
    return Curve(**{"specimen": "one", "trial": f"s{s:g}"} | fields | changes)


@pytest.fixture(params=LEVELS)
def word(request):
    return request.param


def test_every_word_is_a_level(word):
    assert set(LEVELS) == set(get_args(Skeleton))
    assert set(LEVELS) == set(get_args(ModelSection.model_fields["skeleton"].annotation))
    level = level_of(options_of(word))
    assert isinstance(level, Level)
    assert level.name == word
    assert level_of(options_of(word)) is level
    assert hash(level) == hash(LEVELS[word](options_of(word)))


def test_parameters_are_declared(word):
    """All that a level needs can be fitted, and is its own or of the press."""
    level = level_of(options_of(word))
    for joints in (False, True):
        names = in_model(options_of(word), joints=joints, named=DECLARED)
        assert set(names) == level.needs(joints=joints)
        assert {"onset", "force_offset"} <= set(names)
        assert all(n in level.declares or DECLARED[n].part == "press" for n in names)


@pytest.mark.long
def test_a_response_has_what_is_observed(word):
    """Each observed field is there, of one shape, and nothing else that can be measured."""
    level = level_of(options_of(word))
    values = {n: jnp.asarray(DEFAULTS[n].value) for n in level.needs(joints=True)}
    motion = Motion(jnp.asarray(20.0), jnp.array([0.0, 0.5]), onset=jnp.asarray(0.0))
    press = functools.partial(level.response, GEOMETRY)
    found = jax.eval_shape(lambda v: press(level.material(v), motion), values)
    assert isinstance(found, Response)
    shapes = {"force": (2,), "side_force": (2,), "joints": (2, 3), "joint_side": (2, 3),
              "ends": (2, 3, 2, 2)}  # fmt: skip
    for name, shape in shapes.items():
        value = getattr(found, name)
        assert (value is not None) == (name in level.observes), name
        assert value is None or value.shape == shape
    assert found.status.shape == (2,)


def test_what_a_level_presses_it_admits(word):
    level = level_of(options_of(word))
    aside = curve(phi_c=0.5, direction=(0.8, 0.6))
    assert level.admits(curve(), SIZE) is None
    assert (level.admits(aside, SIZE) is None) == level.off_midline
    assert (level.validated_angle(SIZE.half_angle) > 0.5) == level.off_midline
    deep = curve(displacement=np.linspace(0, 13, 6))
    assert (level.admits(deep, SIZE) is None) == (level.deepest(SIZE.radius) > 13)
    assert level.admits(deep, SIZE, onset=5.0) is None


@pytest.mark.long
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("options", "changes"),
    [
        (Options(), BOTH),
        (Options(skeleton="softening", shear=True, half_width=2.0), {}),
        (Options(coupling="total"), {}),
    ],
    ids=["onset", "softening punch", "total"],
)
def test_a_closed_form_is_what_the_response_gives(options, changes):
    """Two ways to one residual and Jacobian: few inputs, and forward mode through `response`."""
    moved = 0.1 * np.linspace(0, 1, 12).reshape(6, 2)
    marked = {"joint_rings": np.array([0, 2]), "joint_displacement": moved}
    curves = [curve(s, **marked) for s in (12.0, 20.0, 33.0)]
    study = build_study(curves, GEOMETRY, options, changes, noise=Noise(force=0.1, joints=0.2))
    lane = jax.tree.map(lambda v: jax.device_put(v[0]), study.lanes)
    theta = np.array([p.to_scaled(p.value) for p, _, _ in study.unknowns[0]]) + 0.1
    assert study.model.level.closed is not None

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(theta, lane):
        free = of_trials(study.model, theta, lane)
        plain = forward_residual.residual(study.model, free, of_press(lane), GEOMETRY)
        return residual(study.model, theta, lane)[:2], plain

    (value, jacobian), (plain, slopes) = jax.device_get(both(theta, lane))
    assert np.abs(jacobian).max() > 0.1
    np.testing.assert_allclose(value, plain, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jacobian, slopes, rtol=1e-9, atol=1e-9)


TIMED = [
    Options(relaxation="uniform"),
    Options(relaxation="parts", branches="fung", skeleton="softening"),
    Options(relaxation="uniform", branches="power", skeleton="sections", contact="bonded"),
]


#: Two presses on deforming sections are ten seconds of compilation.
LATE = {"marks": (pytest.mark.slow, pytest.mark.compiling)}


@pytest.mark.parametrize("options", TIMED, ids=["line", "parts", "sections"])
def test_a_level_relaxes_around_any_other(options):
    """It needs the numbers of its law and a curve's time."""
    level, off = level_of(options), level_of(dataclasses.replace(options, relaxation="off"))
    assert isinstance(level, Relaxing)
    assert level.inner.name == off.name == level.name
    names = relaxation_laws.names(options.branches, parts=options.relaxation == "parts")
    assert level.needs(joints=True) == off.needs(joints=True) | set(names)
    assert set(in_model(options, joints=True, named=DECLARED)) == level.needs(joints=True)
    assert level.observes == off.observes
    assert level.stepwise == off.stepwise
    assert level.closed == off.closed
    assert "no time" in str(level.admits(curve(), SIZE))
    assert level.admits(curve(time=np.arange(6.0)), SIZE) is None
    aside = curve(phi_c=0.5, direction=(0.8, 0.6), time=np.arange(6.0))
    assert (level.admits(aside, SIZE) is None) == off.off_midline
    values = {n: jnp.asarray(DEFAULTS[n].value) for n in level.needs(joints=True)}
    motion = Motion(jnp.asarray(20.0), jnp.array([0.5]), onset=jnp.asarray(0.0))
    with pytest.raises(ValueError, match="no time"):
        level.response(GEOMETRY, level.material(values), motion)


@pytest.mark.long
@pytest.mark.parametrize(
    "options", [*TIMED[:2], pytest.param(TIMED[2], **LATE)], ids=["line", "parts", "sections"]
)
def test_at_once_it_is_as_stiff_as_its_branches_say(options):
    level, off = level_of(options), level_of(dataclasses.replace(options, relaxation="off"))
    values = {n: jnp.asarray(DEFAULTS[n].value) for n in level.needs(joints=True)}
    D, time = jnp.array([0.5, 0.5, 0.5]), jnp.array([0.0, 0.0, 1e9])
    motion = Motion(jnp.asarray(20.0), D, onset=jnp.asarray(0.0))

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(values):
        material = level.material(values)
        timed = level.response(GEOMETRY, material, motion._replace(time=time))
        return timed, off.response(GEOMETRY, off.material(values), motion), material.relaxation

    timed, plain, made = jax.device_get(both(values))
    assert np.all(timed.status == plain.status)
    rises = np.asarray(timed.force) / np.asarray(plain.force)
    assert rises[1] == pytest.approx(rises[0], rel=1e-6)
    lasts = [np.sum(b.gamma[b.tau > 1e9]) for b in made if b is not None]
    assert max(lasts) == pytest.approx(rises[2] - 1, abs=1e-6)
    strength = 1 + np.sum(made.local.gamma)
    assert rises[0] == pytest.approx(strength, rel=1e-9) or options.relaxation == "parts"
    if level.name == "sections":
        shape = timed.joints / plain.joints
        np.testing.assert_allclose(shape[np.isfinite(shape)], 1.0)


@dataclasses.dataclass(frozen=True)
class Half(Level):
    """A wrapper, as one for time is: half the force of the level within."""

    within: Level
    observes = frozenset({"force", "joints"})
    declares = property(lambda self: self.within.declares)
    material_type = property(lambda self: self.within.material_type)
    name = validated_depth = property(lambda self: 0.1)

    def needs(self, *, joints):
        return self.within.needs(joints=joints)

    def admits(self, curve, size, onset=0.0):
        return self.within.admits(curve, size, onset)

    def check(self, tube, material):
        self.within.check(tube, material)

    def without_negative(self, material, also):
        return self.within.without_negative(material, also)

    def material(self, values):
        return self.within.material(values)

    def response(self, tube, material, motion):
        found = self.within.response(tube, material, motion)
        return found._replace(force=found.force / 2)


@pytest.mark.compiling
def test_a_level_that_wraps_another_needs_no_word_in_the_residual(monkeypatch):
    """It has no closed form: forward mode takes it as it stands, with data of its own."""
    options = Options(transition=3.125)  # of no other test: programs are kept by it
    study = build_study([curve(12.0), curve(33.0)], GEOMETRY, options, noise=Noise(force=0.1))
    lane = jax.tree.map(lambda v: jax.device_put(v[0]), study.lanes)
    theta = np.array([p.to_scaled(p.value) for p, _, _ in study.unknowns[0]])
    run = functools.partial(jax.jit, compiler_options=QUICK)
    whole = run(lambda t: residual(study.model, t, lane)[:2])(theta)
    monkeypatch.setattr("jaxtrachea.fitting.model.level_of", lambda o: Half(level_of(o)))
    half = run(lambda t: residual(study.model, t, lane)[:2])(theta)
    whole, half = jax.device_get((whole, half))
    data = np.asarray(lane.force) * np.asarray(lane.precision)
    np.testing.assert_allclose(half[0] + data, (whole[0] + data) / 2, rtol=1e-12)
    np.testing.assert_allclose(half[1], whole[1] / 2, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("word", [w for w in LEVELS if w != "sections"])
def test_a_sample_without_a_solution_has_a_status_and_no_number(word):
    """Off the tube: of every level the same word."""
    level = level_of(options_of(word))
    values = {n: jnp.asarray(DEFAULTS[n].value) for n in level.needs(joints=True)}
    motion = Motion(jnp.asarray(-5.0), jnp.array([0.5]), onset=jnp.asarray(0.0))

    @functools.partial(jax.jit, compiler_options=QUICK)
    def off(values):
        found = level.response(GEOMETRY, level.material(values), motion)
        return found.force, found.status

    force, status = off(values)
    assert np.isnan(force).all()
    assert (status == PressStatus.OFF_TUBE).all()


@pytest.mark.long
def test_nobody_asks_which_level_it_is():
    """Outside of the mechanics no module of fits or predictions compares the skeleton's word."""
    for room in ("fitting", "prediction", "inference", "results"):
        for path in (PACKAGE / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Compare) and isinstance(node.left, ast.Attribute):
                    assert node.left.attr != "skeleton", f"{path.name}: {ast.unparse(node)}"
