"""What each level of a normal press costs against `mat` with shear, in one run, and its fits.

    python tests/bench/levels.py [--fits]

Table 1's tube, 15 rings, 200 displacements to 6 mm at one position: per call and per lane of 256.
`sections` (32 lanes) takes 8 displacements in place of 200 (a path by Newton's method). Fits: a
specimen has 4 presses of 50 samples (`sections`: 3 of 6 on a tube of two rings), noise of 0.5 % of
its peak, one start; the level's own forces are the data. `tests/bench/tradeoff.py` puts them on
docs/evidence/tradeoff.md.
"""

import common  # isort: skip

import functools
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.sections.material import SECTION_VALUES, SectionMaterial, from_wall
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.material import Material
from jaxtrachea.tradeoff.load import QUIET, Load

VALUES = {"EI_L": 1887.0, "k_M": 0.214, "k_1": 6.83, "k_3": 0.01, "GA_L": 7.16}
SOFT = {"e_1": 0.116, "e_2": 0.0065}
LEVELS = {
    "mat": Options(shear=True),
    "two-material": Options(shear=True, local="two-material"),
    "punch": Options(shear=True, half_width=2.36),
    "softening": Options(shear=True, skeleton="softening"),
    "punch, softening": Options(shear=True, half_width=2.36, skeleton="softening"),
}
SECTIONS = {"sections": 0.0, "sections, 90 deg": np.pi / 2}
#: Specimens of a batch of fits, of lines of joints and of sections.
SPECIMENS, FEW = 256, 8
PLACES, DEPTHS = (22.0, 48.0, 75.0, 130.0), np.linspace(0.12, 6, 50)
SHORT, SHORT_PATH = Geometry.create(30.0, [10.0, 20.0], radius=11.7), np.linspace(0.5, 3, 6)
NOISE = 0.005


def calls() -> dict[str, Any]:
    """A call and a batch of each level."""
    geometry, D = table_1(), jnp.linspace(0, 6, 200)
    material = Material(**VALUES, k_1_ring=1e4, **SOFT)
    places = jnp.asarray(np.linspace(15, 145, 256))
    cases = {}
    for name, options in LEVELS.items():

        def one(s, material, options=options):
            out = press(geometry, material, s, D, options)
            return out.force, out.joints

        call, lanes = jax.jit(one), jax.jit(jax.vmap(one, (0, None)))
        cases[name] = lambda f=call: jax.block_until_ready(f(jnp.asarray(74.0), material))
        cases[f"{name}, lanes"] = lambda f=lanes: jax.block_until_ready(f(places, material))
    wall, path = from_wall(geometry), jnp.linspace(0.75, 6, 8)
    for name, phi in SECTIONS.items():

        def section(s, D, phi=phi):
            return press_sections(
                geometry, wall, s, phi, D, options=SectionOptions(midline=phi == 0)
            ).force

        call, lanes = jax.jit(section), jax.jit(jax.vmap(section, (0, None)))
        cases[name] = lambda f=call: jax.block_until_ready(f(jnp.asarray(74.0), path))
        cases[f"{name}, lanes"] = lambda f=lanes: jax.block_until_ready(f(places[::8], path))
    return cases


def line_study(options: Options, specimens: int):
    """Specimens pressed by `press` itself, with noise; EI_L, k_M, k_1 and k_3 are fitted."""
    geometry, rng = table_1(), np.random.default_rng(5)
    truth = np.array([VALUES[n] for n in ("EI_L", "k_M", "k_1", "k_3")])
    drawn = truth * np.exp(0.2 * rng.standard_normal((specimens, 4)))
    more = SOFT if options.skeleton == "softening" else {}
    held = {"GA_L": VALUES["GA_L"]} | more
    held |= {"k_1_ring": 1e4} if options.local == "two-material" else {}

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def force(values, s):
        own = dict(zip(("EI_L", "k_M", "k_1", "k_3"), values, strict=True))
        return press(geometry, Material(**own, **held), s, jnp.asarray(DEPTHS), options).force

    clean = np.asarray(force(jnp.asarray(drawn), jnp.asarray(PLACES)))
    forces = clean + NOISE * clean.max(axis=-1, keepdims=True) * rng.standard_normal(clean.shape)
    curves = [
        Curve(f"s{i:05d}", f"{s:g}", s, 0.0, DEPTHS, f)
        for i, row in enumerate(forces) for s, f in zip(PLACES, row, strict=True)
    ]  # fmt: skip
    table = {name: {"value": float(v), "fixed": True} for name, v in held.items()}
    return build_study(curves, geometry, options, table)


def section_study(phi: float, specimens: int):
    """Specimens of deforming sections, three presses at one angle; EI_C and bed_n are fitted."""
    rng = np.random.default_rng(5)
    given = from_wall(SHORT)
    wall = {name: np.median(getattr(given, name)) for name in SECTION_VALUES}
    names = ("EI_C", "bed_n")
    truth = np.array([wall[n] for n in names]) * np.exp(0.1 * rng.standard_normal((specimens, 2)))
    places = (8.0, 15.0, 19.0)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def force(values, s):
        material = SectionMaterial(**(wall | dict(zip(names, values, strict=True))))
        got = press_sections(
            SHORT,
            material,
            s,
            phi,
            jnp.asarray(SHORT_PATH),
            options=SectionOptions(midline=phi == 0),
        )
        return -jnp.cos(phi) * got.force[:, 1] - jnp.sin(phi) * got.force[:, 2]

    clean = np.asarray(force(jnp.asarray(truth), jnp.asarray(places)))
    forces = clean + NOISE * clean.max(axis=-1, keepdims=True) * rng.standard_normal(clean.shape)
    curves = [
        Curve(f"s{i:05d}", f"{s:g}", s, phi, SHORT_PATH, f)
        for i, row in enumerate(forces) for s, f in zip(places, row, strict=True)
    ]  # fmt: skip
    fixed = {n: {"fixed": True} for n in wall if n not in names}
    return build_study(curves, SHORT, Options(skeleton="sections", contact="bonded"), fixed)


def fits_per_second(study, specimens: int) -> tuple[float, int]:
    """Of a second, compiled run; and how many have an estimate."""
    settings = Settings(starts=1, more_starts=0, verify=False)
    fit(study, settings)
    start = time.perf_counter()
    result = fit(study, settings)
    taken = time.perf_counter() - start
    return specimens / taken, int(sum(FitStatus(int(v)).succeeded for v in result.status))


def fits_of(name: str, specimens: int) -> tuple[float, int]:
    """Fits a second of a level, and how many have an estimate; prints them."""
    study = (
        section_study(SECTIONS[name], specimens) if name in SECTIONS
        else line_study(LEVELS[name], specimens)
    )  # fmt: skip
    found, good = fits_per_second(study, specimens)
    print(f"{name:20s} {found:10.4g} fits/s, {good} of {specimens} estimated", flush=True)
    return found, good


def fits() -> None:
    """Print the fits a second of every level, in one run."""
    load = Load()
    for name in (*LEVELS, *SECTIONS):
        fits_of(name, FEW if name in SECTIONS else 64)
    print(f"others kept {load.others() or 0.0:.2g} cores busy")


def rows(*, quick: bool = False) -> list[dict[str, Any]]:
    """Every level: seconds of a call and of a lane, fits a second; the first names the machine."""
    load = Load()
    samples = common.interleaved(calls(), rounds=2 if quick else 5)
    best = {name: float(np.median(v)) for name, v in samples.items()}
    found = []
    for name in (*LEVELS, *SECTIONS):
        few = FEW if name in SECTIONS else SPECIMENS
        fits, good = None, 0
        if not quick:
            fits, good = fits_of(name, few)
        lanes = 32 if name in SECTIONS else 256
        row = {"level": name, "call": best[name], "lane": best[f"{name}, lanes"] / lanes}
        found.append(row | {"fits": fits, "estimated": good, "specimens": few})
    others = load.others() or 0.0
    noise = "" if others < QUIET else ": compare ratios, not times"
    day = time.strftime("%Y-%m-%d", time.gmtime())
    base = f"{1e6 * best['mat']:.3g} µs a call, {1e6 * found[0]['lane']:.3g} µs a lane"
    found[0]["where"] = (
        f"Measured {day}, {common.cpu_model()}, others kept {others:.2g} cores busy{noise}; `mat`: "
        f"{base}."
    )
    return found


def main() -> None:
    """Print them."""
    if "--fits" in sys.argv[1:]:
        fits()
        return
    found = rows()
    for row in found:
        call, lane = row["call"] / found[0]["call"], row["lane"] / found[0]["lane"]
        print(f"{row['level']:20s} {1e6 * row['call']:10.1f} us a call  {call:8.2f} x mat")
        print(f"{'':20s} {1e6 * row['lane']:10.1f} us a lane  {lane:8.2f} x mat")


if __name__ == "__main__":
    main()
