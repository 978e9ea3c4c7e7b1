"""How well the model predicts presses off the midline, 30 and 90 deg, by level of the rings.

    python fits/virtual_trachea/off_midline.py

Fits every level to the midline presses alone and to all presses (small strain, `vectors.h5`), and
writes off_midline.json beside this file and docs/evidence/off_midline.md. About a minute; needs
SciPy.
"""

import functools
import json
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.mechanics.oblique import ObliqueOptions, local_frame, press_oblique
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

HERE = Path(__file__).parent
DOC = HERE.parents[1] / "docs" / "evidence" / "off_midline.md"
RECORD = HERE / "off_midline.json"
OPTIONS = Options(shear=True, local="two-material", contact="bonded")
TOOL_RADIUS = 3.0  # mm; markers under the punch are held by it
RIGID = 1e6  # N/mm; k_1 on a ring, as the midline fit finds it
LEVELS = {
    "mat": ("mat", ("EI_L", "GA_L", "k_M", "k_1")),
    "arch": ("arch", ("EI_L", "GA_L", "k_M", "k_1", "EI_C", "k_t")),
    "arch2": ("arch2", ("EI_L", "GA_L", "k_M", "k_1", "EI_C", "k_t")),
    "arch2, sides": (
        "arch2",
        ("EI_L", "GA_L", "k_M", "k_1", "EI_C", "k_t", "EI_side", "GA_side"),
    ),
}
START = {"EI_L": 1400.0, "GA_L": 9.3, "k_M": 0.5, "k_1": 23.0, "EI_C": 100.0, "k_t": 0.1}
START |= {"EI_side": 1400.0, "GA_side": 9.3}
#: Standard deviations that weigh forces (relative) against markers (per mm of press).
FORCE, MARKER = 0.01, 0.02


def read() -> dict:
    """The measured vectors per mm of press; markers under the punch are NaN."""
    with h5py.File(HERE / "vectors.h5") as file:
        data = {name: file[name][()] for name in file}
    rings = 10.0 * np.arange(1, 16)
    held = np.abs(rings - data["s_c"][:, None]) <= TOOL_RADIUS  # as `data.tool_radius` of a fit
    data["joints"][held] = np.nan
    return data


def geometry() -> Geometry:
    """The specimen; ring line in the middle of the cartilage (outer 60 % of the wall)."""
    return Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.8)


@functools.partial(jax.jit, static_argnames=("level", "names"))
def predict(values, s_c, phi_c, level, names):
    """Force (inward, circumferential), joints (same) and ends (y, z) per mm of inward press."""
    material = Material(**{**dict(zip(names, values, strict=True)), "k_3": 0.0, "k_1_ring": RIGID})

    def one(s, phi):
        frame = local_frame(phi)
        options = ObliqueOptions(OPTIONS, rings=level, axial=False)
        got = press_oblique(geometry(), material, s, phi, frame[0], options)
        local = frame[::2].T
        return got.force @ local, got.joints @ local, got.end_U[:, 1:], got.end_V[:, 1:]

    return jax.vmap(one)(s_c, phi_c)


def measured(data: dict) -> tuple:
    """The data in the components of `predict`."""
    frames = np.stack([np.asarray(local_frame(jnp.asarray(p)))[::2] for p in data["phi_c"]])

    def local(v):
        return np.einsum("npq,n...q->n...p", frames, v)

    return (
        local(data["force"]),
        local(data["joints"]),
        data["end_U"][..., 1:],
        data["end_V"][..., 1:],
    )


def fit(level: str, names: tuple, rows: np.ndarray, data: dict) -> dict:
    """Least squares over forces, joints and, but for `mat`, the ends of the rings."""
    import scipy.optimize

    s, phi, truth = data["s_c"][rows], data["phi_c"][rows], [v[rows] for v in measured(data)]
    ends = 0.0 if level == "mat" else 1.0
    scales = (FORCE * truth[0][:, :1], MARKER, MARKER / ends if ends else np.inf)

    def residual(log):
        got = predict(jnp.exp(log), s, phi, level, names)
        parts = [(g - t) / w for g, t, w in zip(got, truth, (*scales, scales[2]), strict=True)]
        return jnp.concatenate([jnp.where(jnp.isfinite(p), p, 0).ravel() for p in parts])

    start = np.log([START[name] for name in names])
    span = np.log(1e5)
    run = jax.jit(residual)
    found = scipy.optimize.least_squares(
        lambda v: np.asarray(run(v)),
        start,
        jax.jit(jax.jacfwd(residual)),
        bounds=(start - span, start + span),
        x_scale="jac",
    )
    return dict(zip(names, map(float, np.exp(found.x)), strict=True))


def errors(level: str, parameters: dict, data: dict) -> list[dict]:
    """Errors of every press: forces relative to F_n, markers per D (rms)."""
    names = tuple(parameters)
    values = jnp.asarray(list(parameters.values()))
    got = [np.asarray(v) for v in predict(values, data["s_c"], data["phi_c"], level, names)]
    truth = measured(data)

    def rms(v):
        return float(np.sqrt(np.nanmean(v * v)))

    return [
        {
            "s_c": float(data["s_c"][i]),
            "phi_c": round(float(np.degrees(data["phi_c"][i])), 1),
            "compliance": float(truth[0][i, 0] / got[0][i, 0] - 1),
            "side_force": float(got[0][i, 1] / got[0][i, 0]),
            "side_force_measured": float(truth[0][i, 1] / truth[0][i, 0]),
            "joints_normal": rms(got[1][i, :, 0] - truth[1][i, :, 0]),
            "joints_side": rms(got[1][i, :, 1] - truth[1][i, :, 1]),
            "ends": rms(np.stack([got[2][i] - truth[2][i], got[3][i] - truth[3][i]])),
        }
        for i in range(len(data["s_c"]))
    ]


def summary(name: str, on: str, parameters: dict, data: dict) -> dict:
    """A record of one fit: parameters, and errors on and off the midline."""
    found = errors(LEVELS[name][0], parameters, data)
    middle = [e for e in found if e["phi_c"] == 0]
    keys = ("compliance", "joints_normal", "joints_side", "ends")
    rms = {k: float(np.sqrt(np.mean([e[k] ** 2 for e in middle]))) for k in keys}
    off = [e for e in found if e["phi_c"] != 0]
    return {"rings": name, "fitted": on, "parameters": parameters, "midline": rms, "off": off}


def document(record: list[dict]) -> str:
    """docs/evidence/off_midline.md."""

    def percent(v):
        return f"{100 * v:.1f}"

    def signed(v):
        return f"{100 * v:+.1f}"

    rows = [["rings", "fitted to", "press", "F", "side force (FE)", "J normal", "J side", "ends"]]
    rows.append(["---"] * 8)
    for one in record:
        m = one["midline"]
        marks = [percent(m[k]) for k in ("joints_normal", "joints_side", "ends")]
        head = [one["rings"], one["fitted"]]
        rows.append([*head, "midline, rms of 10", percent(m["compliance"]), "", *marks])
        for e in one["off"]:
            marks = [percent(e[k]) for k in ("joints_normal", "joints_side", "ends")]
            side = f"{e['side_force']:.2f} ({e['side_force_measured']:.2f})"
            place = f"{e['phi_c']:g} deg, s = {e['s_c']:g}"
            rows.append([*head, place, signed(e["compliance"]), side, *marks])
    names = list(START)
    values = [["rings", "fitted to", *names], ["---"] * (2 + len(names))]
    for one in record:
        cells = (one["parameters"].get(n) for n in names)
        values.append(
            [one["rings"], one["fitted"], *("" if v is None else f"{v:.3g}" for v in cells)]
        )

    def table(t):
        return "\n".join(f"| {' | '.join(r)} |" for r in t)

    text = (HERE / "off_midline.md.in").read_text(encoding="utf-8")
    return text.replace("@ERRORS@", table(rows)).replace("@VALUES@", table(values))


def main() -> None:
    """Fit, record and write."""
    jax.config.update("jax_enable_x64", True)
    data, record = read(), []
    middle, everything = np.flatnonzero(data["phi_c"] == 0), np.arange(len(data["s_c"]))
    for name, (level, names) in LEVELS.items():
        for on, rows in (("midline", middle), ("all", everything)):
            if "EI_side" in names and on == "midline":
                continue  # the midline says nothing of the sides
            record.append(summary(name, on, fit(level, names, rows, data), data))
    RECORD.write_text(json.dumps(record, indent=1) + "\n")
    DOC.write_text(document(record), encoding="utf-8")


if __name__ == "__main__":
    main()
