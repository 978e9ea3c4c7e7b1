"""Joint fits against their number of specimens. Run: python tests/bench/joint.py.

Four positions x 50 points and 1 % noise per specimen; EI_L and k_M shared, k_1 and k_3 of each
specimen its own; two starts. "dense": the same study as one lane. Each size is fitted once before
it is timed, so that nothing is compiled. `cpu`: seconds of the processor in the best fit, which
other work on the core disturbs less than wall time; memory is the peak of the process so far.
"""

import resource
import sys
import time

import common
import numpy as np

sys.path.insert(0, str(common.FOLDER.parent / "reference"))
import synthetic  # noqa: E402

from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings

CLEAR = np.array([300.0, 1.0, 0.5, 0.2])
SIZES = {"joint": (10, 30, 100, 300, 1000, 3000, 10_000), "dense": (10, 20, 40, 80)}
SHARED = {name: {"scope": "shared"} for name in ("EI_L", "k_M")}


def make_study(count, *, joint):
    """Specimens with one skeleton."""
    truth = synthetic.draw(7, count, 1.3, CLEAR)
    truth[:, :2] = CLEAR[:2]
    force, _ = synthetic.forces(truth)
    sigma = 0.01 * np.abs(force).max((1, 2), keepdims=True)
    force = force + sigma * np.random.default_rng(8).normal(size=force.shape)
    return synthetic.study(force, changes=SHARED, joint=joint)


def timed(study, repeats):
    """Seconds of each fit, the least processor time, and the last result."""
    result, samples, cpu = fit(study, Settings(starts=2)), [], []
    for _ in range(repeats):
        begin, used = time.perf_counter(), time.process_time()
        result = fit(study, Settings(starts=2))
        samples.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - used)
    return samples, min(cpu), result


if __name__ == "__main__":
    writer = common.Writer("joint")
    for case, sizes in SIZES.items():
        for count in sizes:
            repeats = 2 if count > 3000 else 3
            samples, cpu, result = timed(make_study(count, joint=case == "joint"), repeats)
            pull = (result.value[0, :2] - CLEAR[:2]) / result.standard_error[0, :2]
            writer.add(
                "specimens", f"{case}, {count} specimens", samples, lanes=count, how=case, cpu=cpu,
                converged=int(np.sum(result.status == 0)), iterations=int(result.iterations[0]),
                pull=[float(f"{v:.3g}") for v in pull],
                peak_MB=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
            )  # fmt: skip
    writer.write()
