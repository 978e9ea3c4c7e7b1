"""What each level of a normal press costs against `mat` with shear, in one run.

    python tests/bench/levels.py

Table 1's tube, 15 rings, 200 displacements to 6 mm at one position: per call and per lane of 256.
`sections` takes 8 displacements in place of 200 (a path by Newton's method).
"""

import common  # isort: skip

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.sections.material import from_wall
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

VALUES = {"EI_L": 1887.0, "k_M": 0.214, "k_1": 6.83, "k_3": 0.01, "GA_L": 7.16}
LEVELS = {
    "mat": Options(shear=True),
    "two-material": Options(shear=True, local="two-material"),
    "punch": Options(shear=True, half_width=2.36),
    "softening": Options(shear=True, skeleton="softening"),
    "punch, softening": Options(shear=True, half_width=2.36, skeleton="softening"),
}


def main() -> None:
    geometry, D = table_1(), jnp.linspace(0, 6, 200)
    material = Material(**VALUES, k_1_ring=1e4, e_1=0.116, e_2=0.0065)
    places = jnp.asarray(np.linspace(15, 145, 256))
    cases = {}
    for name, options in LEVELS.items():

        def one(s, material, options=options):
            out = press(geometry, material, s, D, options)
            return out.force, out.joints

        call, lanes = jax.jit(one), jax.jit(jax.vmap(one, (0, None)))
        cases[name] = lambda f=call: jax.block_until_ready(f(jnp.asarray(74.0), material))
        cases[f"{name}, 256 lanes"] = lambda f=lanes: jax.block_until_ready(f(places, material))
    wall, path = from_wall(geometry), jnp.linspace(0.75, 6, 8)
    for name, phi in (("sections", 0.0), ("sections, 90 deg", np.pi / 2)):

        def section(s, D, phi=phi):
            return press_sections(geometry, wall, s, phi, D, midline=phi == 0).force

        call, lanes = jax.jit(section), jax.jit(jax.vmap(section, (0, None)))
        cases[name] = lambda f=call: jax.block_until_ready(f(jnp.asarray(74.0), path))
        cases[f"{name}, 256 lanes"] = lambda f=lanes: jax.block_until_ready(f(places, path))
    samples = common.interleaved(cases, rounds=10)
    best = {name: float(np.median(v)) for name, v in samples.items()}
    for name, seconds in best.items():
        base = best["mat, 256 lanes" if "256 lanes" in name else "mat"]
        print(f"{name:28s} {1e6 * seconds:10.1f} us  {seconds / base:8.2f} x mat")


if __name__ == "__main__":
    main()
