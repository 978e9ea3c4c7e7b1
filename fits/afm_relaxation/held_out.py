"""Which law of relaxation predicts the withdrawal that it has not seen.

    python fits/afm_relaxation/held_out.py

Each law is fitted to the record until 0.02 s after its peak, and predicts the force of the next
0.08 s, in which the tool leaves. Printed are the root mean square errors of both over the range of
the force. Other settings are those of fit.toml.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.config import load_fit_spec
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.data_files import read_data
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import table_1

HERE = Path(__file__).parent
LAWS = ("off", "prony-1", "prony-2", "prony-3", "power", "fung")
#: s after the peak until which is fitted, and predicted.
SEEN, PREDICTED = 0.02, 0.1
CHANGES = {
    "k_1": {"value": 1e-6, "lower": 1e-12, "upper": 1.0},
    "k_3": {"value": 1e-3, "lower": 1e-9, "upper": 1e3, "scale": "log"},
    "onset": {"value": 0.0237, "lower": 0.02, "upper": 0.0265},
    "force_offset": {"fixed": True, "value": -6.7e-10},
}


def until(curve: Curve, time: float) -> Curve:
    """The record until a time."""
    assert curve.time is not None
    keep = curve.time <= time
    names = ("displacement", "force", "time", "sigma")
    held = {name: getattr(curve, name) for name in names if getattr(curve, name) is not None}
    return dataclasses.replace(curve, **{name: v[keep] for name, v in held.items()})


def errors(law: str, curve: Curve) -> tuple[float, float]:
    """Root mean square error over the range of the force, of what was fitted and predicted."""
    assert curve.time is not None
    options = Options(coupling="total")
    if law != "off":
        options = dataclasses.replace(options, relaxation="uniform", branches=law)
    top = float(curve.time[np.argmax(curve.force)])
    study = build_study([until(curve, top + SEEN)], table_1(), options, CHANGES)
    result = fit(study, Settings(verify=False))
    values = {p.name: p.value for p in study.parameters}
    values |= {p.name: v for (p, _, _), v in zip(study.unknowns[0], result.value[0], strict=True)}
    level = level_of(study.model.options)
    material = level.material({name: jnp.asarray(v) for name, v in values.items()})
    time = None if law == "off" else curve.time
    place, way, onset = (jnp.asarray(v) for v in (80.0, curve.displacement, values["onset"]))
    motion = Motion(place, way, onset=onset, time=None if time is None else jnp.asarray(time))
    force = np.asarray(level.response(table_1(), material, motion).force) + values["force_offset"]
    off = (force - curve.force) / np.ptp(curve.force)
    seen = curve.time <= top + SEEN
    later = ~seen & (curve.time <= top + PREDICTED)
    return float(np.sqrt(np.mean(off[seen] ** 2))), float(np.sqrt(np.mean(off[later] ** 2)))


def record() -> Curve:
    """The record as fit.toml reads it."""
    (curve,) = read_data(load_fit_spec(HERE / "fit.toml"), HERE).curves
    return curve


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for word in LAWS:
        seen, later = (100 * v for v in errors(word, record()))
        print(f"{word:8s} fitted {seen:.2f} %, predicted {later:.2f} %", flush=True)
