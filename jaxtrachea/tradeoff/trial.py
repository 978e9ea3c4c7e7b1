"""Programs of a scene run on its path and on two sample paths beside it, each once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._compiler import quick_options
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.declare import PlanError
from jaxtrachea.scene.simulation import Simulation, simulate
from jaxtrachea.scene.stage import Poses, Presses
from jaxtrachea.tradeoff.calls import Call, turn_medians
from jaxtrachea.tradeoff.cost import Cost, Objective, compiled, operations
from jaxtrachea.tradeoff.errors import Errors, compare
from jaxtrachea.tradeoff.levels import Full, Levels, cast, program
from jaxtrachea.tradeoff.load import Load

#: Sample paths: how far along the tube, in smallest ring spacings, and how much deeper.
BESIDE = ((0.0, 0.0), (0.25, 0.1), (-0.25, -0.1))


class Trial:
    """Runs programs on the sample paths, each once, for any number of choices.

    Raises:
        PlanError: the path, or a sample path beside it, has no row with a force.
    """

    def __init__(self, full: Full, report: Callable[[str], None] = lambda text: None):
        """Run the full program."""
        self.full, self.report = full, report
        self.paths = samples(full)
        self.known: dict[Levels, Errors] = {}
        self.counts: dict[tuple[bool, Levels], float] = {}
        self.times: dict[tuple[Objective, Levels], Cost] = {}
        self.calls: dict[Objective, Call] = {}
        #: Most cores that others kept busy while times were measured.
        self.others = 0.0
        report("full program")
        self.reference = self._run(full.levels)
        pressed = [bool(np.nan_to_num(v).any()) for v in np.asarray(self.reference.force)]
        if not all(pressed):
            where = "the path" + (" a quarter of a ring spacing beside it" if pressed[0] else "")
            raise PlanError(
                "plan.tolerance",
                f"no row of {where} is solved with a force: nothing that a tolerance could be "
                "measured by",
                cure="press deeper, further from the ends, or take no tolerance",
            )

    def errors(self, levels: Levels) -> Errors:
        """Of these levels against the full program."""
        if levels not in self.known:
            found = self._run(levels)
            self.known[levels] = compare(found, self.reference, (self.full.scene, self.full.scene))
        return self.known[levels]

    def share(self, by: Objective, levels: Levels) -> float:
        """Of the full program's operations; for `step` of the last row alone."""
        step = by == "step"
        return self._operations(levels, step=step) / self._operations(self.full.levels, step=step)

    def _operations(self, levels: Levels, *, step: bool = False) -> float:
        """Of the path, or of its last row; those in float32 counted half."""
        if (step, levels) not in self.counts:
            self.counts[step, levels] = operations(program(self.full, levels), step=step)
        return self.counts[step, levels]

    def cost(self, by: Objective, levels: Levels) -> Cost:
        """Of the full program and of these levels: s, measured in turns, or operations."""
        full = self.full.levels
        if by == "operations":
            return Cost.exact(self._operations(full), self._operations(levels))
        if by not in self.calls:
            self.calls[by] = compiled(by, program(self.full, full))
        if (by, levels) not in self.times:
            calls = [self.calls[by]]
            if levels != full:
                calls.append(compiled(by, program(self.full, levels)))
            load = Load()
            seconds = turn_medians(calls)
            self.others = max(self.others, load.others() or 0.0)
            self.times[by, levels] = Cost.measured(seconds[0], seconds[-1])
        return self.times[by, levels]

    def _run(self, levels: Levels) -> Simulation:
        """The sample paths, one after the other, with a leading axis."""
        scene, material, _ = program(self.full, levels)
        paths = cast(self.paths, levels.dtype)
        each = [jax.tree.map(lambda v, i=i: v[i], paths) for i in range(len(BESIDE))]
        made = _compiled(scene, material, each[0])
        outs = [made(scene, material, path) for path in each]
        return jax.tree.map(lambda *v: np.stack(v), *outs)


def _compiled(*arguments: Any):
    """The program of scene, material and path."""
    return jax.jit(simulate, compiler_options=quick_options()).lower(*arguments).compile()


def samples(full: Full) -> Poses | Presses:
    """The path, and the same beside it (`BESIDE`); a leading axis."""
    path, geometry = full.path, full.scene.geometry
    spacing = min(full.facts.spacing, float(geometry.length))
    low, high = full.scene.plan.options.places(float(geometry.length))
    if isinstance(path, Presses):
        moved = [
            Presses(jnp.clip(path.s + a * spacing, low, high), path.phi,
                    path.displacement * (1 + d), path.time) for a, d in BESIDE
        ]  # fmt: skip
    else:
        made = jax.jit(approach)(full.scene, path)
        row = int(np.argmin(np.asarray(made.seen.gap)))
        deep = max(-float(made.seen.gap[row]), 0.0)
        along = jnp.eye(3)[0] if made.frame is None else made.frame[row][:, 0]
        shifts = [a * spacing * along - d * deep * made.seen.normal[row] for a, d in BESIDE]
        moved = [Poses(path.rotation, path.translation + v, path.time) for v in shifts]
    return jax.tree.map(lambda *v: jnp.stack(v), *moved)
