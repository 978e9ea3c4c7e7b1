"""The same programs on a GPU and on the CPU beside it: values and times, for docs/evidence/gpu.md.

    python tests/bench/devices.py [--lanes 16384] [--specimens 8192]

Values of 16 lanes, in float32 and float64, of the first device that JAX names against the CPU;
times of one call and of many lanes on both; fits a second of a cohort by how many are computed
together (with JAX_PLATFORMS=cpu those of the CPU). Needs no GPU to run: without one it says so and
compares the CPU with itself.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxtrachea import (  # noqa: E402
    Material,
    ObliqueOptions,
    Options,
    Poses,
    make_scene,
    press,
    press_oblique,
    simulate,
    table_1,
)
from jaxtrachea.contact.patches import straight_patches, touch  # noqa: E402
from jaxtrachea.contact.pose import pose_from_vector  # noqa: E402
from jaxtrachea.contact.shapes import box, sphere  # noqa: E402
from jaxtrachea.fitting import fit  # noqa: E402
from jaxtrachea.fitting.build import build_study, default_parameters  # noqa: E402
from jaxtrachea.fitting.parameters import in_model  # noqa: E402
from jaxtrachea.fitting.settings import Settings  # noqa: E402
from jaxtrachea.measurements.read import Curve  # noqa: E402
from jaxtrachea.mechanics.sections.material import from_wall  # noqa: E402
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections  # noqa: E402
from jaxtrachea.trachea.tube import make_tube  # noqa: E402

FITTED = {"EI_L": 1887.0, "k_M": 0.214, "k_1": 6.83, "k_3": 0.01, "GA_L": 7.16}
FITTED |= {"e_1": 0.116, "e_2": 0.0065}
SOFT = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02}
BONDED = {"EA_L": 5.0, "EI_C": 100.0, "k_t": 2.0, "k_A": 1.0, "k_B": 1.0}
BORDERS = np.r_[0.0, np.arange(10, 151, 10), 160.0]
#: Lanes of a press of sections and of a surface are larger: so many fewer.
FEWER = {"sections": 8, "sections, 90°": 8, "scene with its surface": 4}
#: Specimens fitted together, and whether in single precision.
ROUNDS = [(128, False), (1024, False), (8192, False), (8192, True)]


def cases(dtype: str):
    """Name, function of the place along the tube, and the places' range, mm."""

    def material(values):
        return Material(**{name: jnp.asarray(v, dtype) for name, v in values.items()})

    def numbers(v):
        return jnp.asarray(v, dtype)

    geometry, depths = table_1(dtype), numbers(np.linspace(0, 6, 50))
    fitted, soft = material(FITTED), material(SOFT)

    def straight(options):
        def run(s, m=fitted):
            found = press(geometry, m, s, depths, options)
            return found.force, found.joints

        return run

    def gradient(s):
        return jax.grad(lambda m: jnp.sum(straight(Options(shear=True))(s, m)[0]))(fitted)

    bonded, along = material(SOFT | BONDED), np.linspace(0.1, 1, 20)[:, None] * [[0.1, -1.0, 0.2]]

    def oblique(s):
        options = ObliqueOptions(Options(contact="bonded"))
        return press_oblique(geometry, bonded, s, numbers(0.5), numbers(along), options).force

    wall, path = from_wall(geometry), numbers(np.linspace(0.75, 6, 8))

    def sections(phi):
        return lambda s: (
            press_sections(
                geometry, wall, s, phi, path, options=SectionOptions(midline=phi == 0)
            ).force
        )

    tool = box(numbers([2.0, 1.5, 4.0]), numbers(0.3))
    tube = straight_patches(BORDERS, 12.0, dtype=dtype)

    def contact(s):
        pose = pose_from_vector(numbers([0.3, -0.7, 0.5]), jnp.stack([s, s * 0 + 15.5, s * 0 + 1]))
        return touch(tool, pose, tube).gap

    def poses(s):
        return Poses(jnp.eye(3, dtype=s.dtype)[None], jnp.stack([s, s * 0 + 15.6, s * 0])[None])

    ball = sphere(numbers(5.0))
    made = make_scene(geometry, soft, poses(numbers(73.0)), tool=ball, mesh=make_tube(geometry))

    def scene(s):
        found = simulate(made, soft, poses(s))
        return found.force, found.vertices

    return {
        "`press`, 50 depths": (straight(Options(shear=True)), (15, 145)),
        "its gradient": (gradient, (15, 145)),
        "the same, punch": (straight(Options(shear=True, half_width=2.36)), (15, 145)),
        "the same, softening": (straight(Options(shear=True, skeleton="softening")), (15, 145)),
        "`press_oblique`, 20 rows": (oblique, (20, 140)),
        "sections": (sections(0.0), (40, 100)),
        "sections, 90°": (sections(np.pi / 2), (40, 100)),
        "contact of a box": (contact, (10, 150)),
        "scene with its surface": (scene, (40, 110)),
    }


def places(between, count: int, dtype: str):
    """Places along the tube, mm."""
    return jnp.asarray(np.linspace(*between, count), dtype)


def apart(a, b) -> float:
    """Largest difference relative to the largest entry; NaN where one has NaN or both no number."""
    worst = 0.0
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x, float), np.asarray(y, float)
        if (np.isnan(x) != np.isnan(y)).any() or np.isnan(y).all():
            return float("nan")
        worst = max(worst, float(np.nanmax(np.abs(x - y)) / max(np.nanmax(np.abs(y)), 1e-300)))
    return worst


def seconds(f, s) -> float:
    """Median of calls, compiled before."""
    jax.block_until_ready(f(s))
    found = []
    while len(found) < 5 or (sum(found) < 0.3 and len(found) < 100):
        start = time.perf_counter()
        jax.block_until_ready(f(s))
        found.append(time.perf_counter() - start)
    return float(np.median(found))


def cohort(specimens: int):
    """A study of specimens with four positions of 50 points, noise of 0.5 % of the peak."""
    rng = np.random.default_rng(11)
    geometry, depths, spots = table_1("float64"), np.linspace(0.12, 6, 50), [15.0, 40.0, 65.0, 80.0]
    truths = np.array([100.0, 1.0, 1.0, 0.01]) * np.exp(0.2 * rng.standard_normal((specimens, 4)))

    def forces(truth):
        material = Material(**dict(zip(("EI_L", "k_M", "k_1", "k_3"), truth, strict=True)))
        return jnp.stack([press(geometry, material, s, depths).force for s in spots])

    clean = np.asarray(jax.jit(jax.vmap(forces))(truths))
    noise = 0.005 * clean.max(axis=2, keepdims=True) * rng.standard_normal(clean.shape)
    curves = [
        Curve(f"s{i:05d}", f"{s:g}", s, 0.0, depths, force)
        for i, rows in enumerate(clean + noise)
        for s, force in zip(spots, rows, strict=True)
    ]
    return build_study(
        curves, geometry, Options(), default_parameters(in_model(Options(), joints=False), {})
    )


def fits(study, settings) -> tuple[str, list[float]]:
    """Fits a second, the better of two after one that compiles, and medians of the estimates."""
    found, best = fit.fit(study, settings), float("inf")
    for _ in range(2):
        start = time.perf_counter()
        found = fit.fit(study, settings)
        best = min(best, time.perf_counter() - start)
    return f"{found.lanes / best:,.0f}", np.median(found.value, axis=0).tolist()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lanes", type=int, default=16384)
    parser.add_argument("--specimens", type=int, default=8192)
    told = parser.parse_args()
    lanes = told.lanes
    device, cpu = jax.devices()[0], jax.devices("cpu")[0]
    print(f"{device.device_kind} against {cpu.device_kind}, jax {jax.__version__}")
    if device == cpu:
        print("JAX finds no GPU here: the CPU is compared with itself")
    print("| differences | float64 | float32 |\n|---|---|---|")
    found: dict[str, list[str]] = {}
    for dtype in ("float64", "float32"):
        answers = {}
        for at in (cpu, device):
            with jax.default_device(at):
                for name, (f, between) in cases(dtype).items():
                    run = jax.jit(jax.vmap(f))
                    answers[name, at] = jax.device_get(run(places(between, 16, dtype)))
        for name in cases(dtype):
            off = apart(answers[name, device], answers[name, cpu])
            found.setdefault(name, []).append(f"{off:.1e}")
    for name, cells in found.items():
        print(f"| {name} | {' | '.join(cells)} |")
    print("| µs, float64 | a call | lanes | a lane | CPU: a call | a lane |")
    print("|---|---|---|---|---|---|")
    for name in found:
        row = []
        for at in (device, cpu):
            with jax.default_device(at):
                f, between = cases("float64")[name]
                count = max(1, lanes // FEWER.get(name, 1) // (1 if at == device else 32))
                one = seconds(jax.jit(f), places(between, 1, "float64")[0])
                many = seconds(jax.jit(jax.vmap(f)), places(between, count, "float64"))
            row += [f"{1e6 * one:.3g}", f"{count:,}", f"{1e6 * many / count:.3g}"]
        print(f"| {name} | {' | '.join([*row[:4], *row[5:]])} |", flush=True)
    print(
        f"| fits of {told.specimens:,} specimens | batch | a second | medians |\n|---|---|---|---|"
    )
    study = cohort(told.specimens)
    for most, single in ROUNDS:
        batch = study.batch_size(told.specimens, most)
        settings = Settings(starts=1, verify=False, batch=most, float32=single)
        speed, medians = fits(study, settings)
        dtype = "float32" if single else "float64"
        print(f"| {device.device_kind}, {dtype} | {batch:,} | {speed} | {medians} |", flush=True)


if __name__ == "__main__":
    main()
