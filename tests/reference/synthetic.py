"""Synthetic studies for the tests of identification: known truth, one set of shapes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

GEOMETRY = table_1()
OPTIONS = Options(onset_width=0.0)
S_C = np.array([22.0, 45.0, 75.0, 80.0])
DEPTHS = np.linspace(0.1, 6.0, 50)
NAMES = ("EI_L", "k_M", "k_1", "k_3")
MIDDLE = np.array([100.0, 1.0, 1.0, 0.01])
CHANGES = {
    "EI_L": {"value": 100.0, "lower": 1e-2, "upper": 1e6},
    "k_M": {"value": 1.0},
    "k_1": {"value": 1.0},
    "k_3": {"value": 0.01, "scale": "log", "lower": 1e-6, "upper": 1e3},
}


@functools.partial(jax.jit, static_argnums=0)
def _pressed(options, truth, s_c, displacement):
    def one(t, s, d):
        p = press(GEOMETRY, Material(t[0], t[1], t[2], t[3]), s, d, options)
        return p.force, p.joints

    return jax.vmap(jax.vmap(one, (None, 0, None)), (0, None, None))(truth, s_c, displacement)


def forces(truth, s_c=S_C, displacement=DEPTHS, options=OPTIONS):
    """Forces (M, positions, samples) and ring deflections (..., rings) of truths (M, 4)."""
    out = _pressed(options, jnp.asarray(truth), jnp.asarray(s_c), jnp.asarray(displacement))
    return tuple(np.array(v) for v in out)


def curves(force, s_c=S_C, displacement=DEPTHS, **more):
    """One `Curve` per specimen and position."""
    return [
        Curve(f"s{i:04d}", f"t{j}", float(s_c[j]), 0.0, displacement, force[i, j], **more)
        for i in range(force.shape[0])
        for j in range(force.shape[1])
    ]


def parameters(options=OPTIONS, joints=False, **changes):
    """The table of parameters, with `changes` over the synthetic study's own.

    Onset and force offset are held unless they are named: one of some thousand records takes one
    by chance.
    """
    names = in_model(options, joints=joints)
    held = {n: {"fixed": True, "value": 0.0} for n in ("onset", "force_offset") if n in names}
    merged = {name: CHANGES.get(name, {}) | changes.get(name, {}) for name in CHANGES | changes}
    return default_parameters(names, held | merged)


def study(force, options=OPTIONS, changes=None, **settings):
    """A study of `force` at the standard positions and depths."""
    return build_study(
        curves(force), GEOMETRY, options, parameters(options, **(changes or {})), **settings
    )


def draw(seed, count, spread, middle=MIDDLE):
    """Truths: log-uniform within `spread` above and below `middle`; (count, 4)."""
    unit = np.random.default_rng(seed).uniform(-1, 1, (count, 4))
    return middle * np.exp(unit * np.log(spread))
