"""Cost of derivatives against that of the value. Run: python tests/bench/gradient.py.

The whole update of update.py, the residual of the fits of fitting.py and a press curve: a program
that gives the value, and programs that give derivatives with it, timed in turn.
"""

import functools
import itertools

import common
import fitting
import jax
import jax.numpy as jnp
import numpy as np
import update

from jaxtrachea import Material, press, simulate, table_1
from jaxtrachea.fitting import cost, residual
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
from jaxtrachea.optimisation import trust_region
from jaxtrachea.scene.stage import Poses

jax.config.update("jax_cpu_enable_async_dispatch", False)

LANES, FITS = 64, 512
WALLS = ("patches of the mesh", "round tube")


def wait(f, *args):
    """A compiled call without arguments, its result waited for."""
    run = jax.jit(f).lower(*args).compile()
    return lambda: jax.block_until_ready(run(*args))


def scalar_of(scene):
    """Material and place of the tool in; force and mean square of the vertices' motion out."""
    turn = jnp.eye(3, dtype=scene.footprint.dtype)[None]

    def value(material: Material, place):
        found = simulate(scene, material, Poses(turn, place[None]))
        moved = found.vertices[0] - scene.mesh.vertices
        return -found.force[0, 1] + jnp.mean(jnp.sum(moved**2, axis=1))

    return value


def forward(value, directions: int):
    """Value and its derivative along the first `directions` material parameters."""

    def program(material, place):
        flat, tree = jax.tree.flatten(material)
        along = jnp.eye(len(flat), dtype=place.dtype)[:directions]

        def of(m):
            return value(jax.tree.unflatten(tree, m), place)

        def push(t):
            return jax.jvp(of, (flat,), (list(t),))

        if directions == 1:
            return push(along[0])
        return jax.vmap(push, out_axes=(None, 0))(along)

    return program


def arguments(dtype, material, lanes: int):
    """Material and place of the ball; of many lanes, all different."""
    if lanes == 1:
        return material, update.at(dtype).translation[0]
    rng = np.random.default_rng(0)

    def spread(v):
        return v * jnp.asarray(rng.uniform(0.8, 1.25, lanes), v.dtype)

    s = rng.uniform(update.S - 2, update.S + 2, lanes)
    away = update.OUTER + update.RADIUS - rng.uniform(0.5, 3, lanes)
    places = np.stack([s, away, 0 * s], axis=1)
    return jax.tree.map(spread, material), jnp.asarray(places, dtype)


def pipeline(out: common.Writer) -> None:
    """Tool, contact, skeleton, surface; by four material parameters and three of the pose."""
    for lanes, dtype in itertools.product((1, LANES), ("float32", "float64")):
        made, material = update.scenes(dtype)
        args = arguments(dtype, material, lanes)
        for walls in WALLS:
            value = scalar_of(made[f"whole, dent of 16; {walls}"])
            programs = {
                "value": value,
                "value and gradient (reverse)": jax.value_and_grad(value, argnums=(0, 1)),
                "value and one direction (forward)": forward(value, 1),
                "value and 4 directions (forward)": forward(value, 4),
            }
            batched = {k: f if lanes == 1 else jax.vmap(f) for k, f in programs.items()}
            cases = {name: wait(f, *args) for name, f in batched.items()}
            check(cases)
            if lanes > 1:
                for name in list(cases)[:2]:
                    cases[f"{name}, one at a time"] = wait(map_sequentially(programs[name]), *args)
            found = common.interleaved(cases, rounds=25, target=0.02)
            out.table("pipeline", found, lanes=lanes, dtype=dtype, walls=walls)
            out.write()


def map_sequentially(program):
    """The program for many lanes, one after the other in one call."""
    return lambda *args: jax.lax.map(lambda x: program(*x), args)


def check(cases) -> None:
    """Forward and reverse mode agree, and both give the value."""
    value, (back, along, columns) = cases["value"](), [c() for c in list(cases.values())[1:]]
    reverse = jnp.stack(jax.tree.leaves(back[1][0]))
    tolerance = 1e-8 if value.dtype == jnp.float64 else 2e-3
    for name, v in (("reverse", back[0]), ("forward", along[0]), ("forward", columns[0])):
        common.close(name, v, value, tolerance)
    common.close("one direction", along[1], reverse[0], tolerance)
    common.close("four directions", columns[1].reshape(value.shape + (4,)).T, reverse, tolerance)


def fits(out: common.Writer) -> None:
    """Residual of a fit, with its Jacobian, and a whole step of Levenberg-Marquardt; 512 lanes."""
    study, *_ = fitting.make_study(FITS)
    model, lanes = study.model, jax.device_put(study.lanes)
    settings = Settings(starts=1)
    theta = jnp.asarray(draw_starts(study, settings))
    sigma = jnp.asarray(first_sigma(study))

    def of(f):
        return jax.vmap(functools.partial(f, model))

    point = jax.jit(of(cost.evaluate))(theta, lanes, sigma)

    objective = cost.LaneCost(model, lanes, sigma)
    state = jax.jit(jax.vmap(trust_region.initial_state))(theta, objective)
    state = state._replace(point=point, iteration=jnp.ones(FITS, jnp.int32))
    step = jax.vmap(functools.partial(trust_region.iterate, trust_region.Tolerances()))
    cases = {
        "residual": wait(of(residual.residual_value), theta, lanes),
        "residual and Jacobian": wait(of(residual.residual), theta, lanes),
        "residual, Jacobian, normal equations": wait(of(cost.evaluate), theta, lanes, sigma),
        "one Levenberg-Marquardt step": wait(step, objective, state),
    }
    common.close("residual", cases["residual and Jacobian"]().value, cases["residual"]())
    assert bool(jnp.all(cases["one Levenberg-Marquardt step"]().iteration == 2))
    out.table("fit", common.interleaved(cases, rounds=25, target=0.05), lanes=FITS)


def curve(out: common.Writer) -> None:
    """Sum of squares of a press curve of 50 displacements, by five arguments."""
    geometry, D = table_1(), jnp.linspace(0.0, 6.0, 50)

    def value(EI_L, k_M, k_1, k_3, s):
        return jnp.sum((press(geometry, Material(EI_L, k_M, k_1, k_3), s, D).force - 0.1) ** 2)

    args = [jnp.asarray(v) for v in (100.0, 1.0, 1.0, 0.01, 83.0)]
    gradient = jax.value_and_grad(value, argnums=(0, 1, 2, 3, 4))
    lanes = [v * jnp.linspace(0.9, 1.1, LANES) for v in args]
    for count, given in ((1, args), (LANES, lanes)):
        of = (lambda f: f) if count == 1 else jax.vmap
        cases = {"value": wait(of(value), *given), "value and gradient": wait(of(gradient), *given)}
        out.table("curve", common.interleaved(cases, rounds=25, target=0.01), lanes=count)


def main() -> None:
    """Measure and write."""
    out = common.Writer("gradient", "equinox")
    curve(out)
    fits(out)
    pipeline(out)


if __name__ == "__main__":
    main()
