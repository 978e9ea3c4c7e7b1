"""The parts of the public API that the table of hard cases runs, each as arrays in, arrays out.

Every function takes a dictionary of arrays and gives `(outputs, status)`; it is differentiated in
all of its inputs. The first output is the one that must be NaN where the model has no answer.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import box, sphere
from jaxtrachea.mechanics.axial import stretch
from jaxtrachea.mechanics.beam import Beam, deflect
from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.equilibrium import press_series, press_total
from jaxtrachea.mechanics.force_law import Law, ring_weight
from jaxtrachea.mechanics.friction import Coulomb, slide
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique
from jaxtrachea.mechanics.press import Contact, Options, compliance, press
from jaxtrachea.mechanics.press import respond as touch_and_respond
from jaxtrachea.mechanics.press_in_time import press_in_time
from jaxtrachea.mechanics.ring import Ring, respond, ring_compliance
from jaxtrachea.mechanics.vector_equilibrium import press_vector
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.surface.local import correction, fit
from jaxtrachea.surface.regions import Binding, Keys, clamped, interpolate, weigh
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

Values = dict[str, Array]
Answer = tuple[Values, Array]

_OK = np.int8(0)


def _done(**outputs) -> Answer:
    return outputs, jnp.asarray(_OK)


def series(v: Values) -> Answer:
    """`press_series`: local law and skeleton in series."""
    got = press_series(v["D"], v["c"], Law(v["k_1"], v["k_3"]))
    return {"force": got.force, "depth": got.depth}, got.status


def quintic(v: Values) -> Answer:
    """`press_series` with a fifth power in the law: found by Newton steps."""
    got = press_series(v["D"], v["c"], Law(v["k_1"], v["k_3"], v["k_5"]))
    return {"force": got.force, "depth": got.depth}, got.status


def total(v: Values) -> Answer:
    """`press_total`: the paper's printed coupling."""
    got = press_total(v["D"], v["c"], Law(v["k_1"], v["k_3"]))
    return {"force": got.force, "depth": got.depth}, got.status


def first_touch(v: Values) -> Answer:
    """`model.respond`: unilateral contact with the smooth onset of 1e-3 mm, series coupling."""
    law = Law(v["k_1"], v["k_3"])
    got = touch_and_respond(v["D"], v["c"], Contact(law, v["onset"]), Options())
    return {"force": got.force, "depth": got.depth}, got.status


def vector(v: Values) -> Answer:
    """`press_vector`: oblique press; C as (xx, yy, zz, yz, xz, xy)."""
    xx, yy, zz, yz, xz, xy = v["C"]
    C = jnp.stack([jnp.stack(r) for r in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])])
    got = press_vector(v["D"], C, Law(v["k_1"], v["k_3"]))
    return {"force": got.force, "depth": got.depth}, got.status


def _tube(rings: int, length, dtype) -> Geometry:
    """Rings evenly spaced; positions as the float32 numbers that the truth was made for."""
    x = (np.arange(1, rings + 1) * (length / (rings + 1))).astype(np.float32)
    given = (np.float32(length), x, np.float32(11.25), np.float32(2), np.float32(4))
    return Geometry(*(jnp.asarray(a, dtype) for a in given))


def _press(v: Values, rings: int, length: float) -> Answer:
    geometry = _tube(rings, length, v["s"].dtype)
    material = Material(v["EI_L"], v["k_M"], v["k_1"], v["k_3"])
    got = press(geometry, material, v["s"], v["D"])
    out = {"force": got.force, "depth": got.depth, "compliance": got.compliance}
    return out | {"reactions": got.reactions}, got.status


def press_9(v: Values) -> Answer:
    """`press` on 9 rings 10 mm apart, L = 100 mm."""
    return _press(v, 9, 100.0)


def press_1(v: Values) -> Answer:
    """`press` on one ring in the middle, L = 100 mm."""
    return _press(v, 1, 100.0)


def compliance_200(v: Values) -> Answer:
    """`model.compliance` on 200 rings 0.5 mm apart, L = 100.5 mm."""
    zero = jnp.zeros_like(v["s"])
    material = Material(v["EI_L"], v["k_M"], zero, zero)
    tube = _tube(200, 100.5, v["s"].dtype)
    return _done(compliance=compliance(tube, material, v["s"], Options()))


def _deflect(v: Values, **options) -> Answer:
    beam = Beam(v["x"], v["length"], v["EI"], v["k"], v.get("GA"))
    got = deflect(beam, v["s"], v["F"], **options)
    return _done(w_C=got.w_C, theta_C=got.theta_C, w=got.w, reaction=got.reaction)


def beam(v: Values) -> Answer:
    """`deflect`: seven rings, every array an input."""
    return _deflect(v)


def beam_shear(v: Values) -> Answer:
    """`deflect` with shear flexibility."""
    return _deflect(v)


def beam_alone(v: Values) -> Answer:
    """`deflect`, split `independent` (paper eq. 3)."""
    out, status = _deflect(v, split="independent")
    return {n: out[n] for n in ("w_C", "reaction")}, status


def axial(v: Values) -> Answer:
    """`stretch`: the ligament as bars, with end springs."""
    ends = {"k_A": v["k_A"], "k_B": v["k_B"]}
    got = stretch(v["x"], v["length"], v["EA"], v["s"], v["F"], **ends)
    return _done(u_C=got.u_C, u=got.u, force_A=got.force_A, force_B=got.force_B)


def ring(v: Values) -> Answer:
    """`ring_compliance` and `ring.respond`: the arch with its tie."""
    arch = Ring(v["R"], v["alpha"], v["EI"], v["k_M"], v["k_t"])
    C, status = ring_compliance(arch, v["phi"])
    got = respond(arch, v["phi"], v["P"])
    both = {"C": C, "end_U": got.end_U, "end_V": got.end_V}
    return both | {"opening": got.opening, "tie": got.tie}, status


def oblique(v: Values) -> Answer:
    """`press_oblique`: bonded, level `arch2`, stretch and end springs, five rings."""
    names = ("EI_L", "k_M", "k_1", "k_3", "EA_L", "EI_C", "k_t", "k_A", "k_B")
    material = Material(**{n: v[n] for n in names})
    geometry = _tube(5, 60.0, v["s"].dtype)
    options = ObliqueOptions(Options(contact="bonded"))
    got = press_oblique(geometry, material, v["s"], v["phi"], v["D"], options)
    return {"force": got.force, "skeleton": got.skeleton}, got.status


def spheres(v: Values) -> Answer:
    """`signed_distance` of two balls."""
    pose = pose_from_vector(jnp.zeros_like(v["t"]), v["t"])
    got = signed_distance(sphere(v["r_A"]), sphere(v["r_B"]), pose)
    return {"distance": got.distance}, got.status


def boxes(v: Values) -> Answer:
    """`signed_distance` of two boxes at the sharpness `beta`, turned by `turn`."""
    pose = pose_from_vector(v["turn"], v["t"])
    got = signed_distance(box(v["A"]), box(v["B"]), pose, beta=v["beta"])
    return {"distance": got.distance}, got.status


def dent(v: Values) -> Answer:
    """`surface.local.fit` and `correction`: eight centres of which some nearly coincide."""
    centres = jnp.stack([v["cx"], v["cy"], jnp.zeros_like(v["cx"])], 1)
    targets = v["target"][:, None] * jnp.ones((1, 3), centres.dtype)
    got = fit(centres, targets, v["reach"])
    points = jnp.stack([v["px"], v["py"], jnp.zeros_like(v["px"])], 1)
    return _done(u=correction(got, points)[:, 0])


def global_shape(v: Values) -> Answer:
    """`weigh` and `interpolate` (linear): vertices at given s and phi, three rings."""
    x, length = v["x"], v["length"]
    nodes = jnp.concatenate([jnp.zeros_like(x[:1]), x, length[None]])
    patch = jnp.searchsorted(x, v["s"], side="right").astype(jnp.int32)
    span = (nodes[1:] - nodes[:-1])[patch]
    fraction = jnp.clip((v["s"] - nodes[patch]) / span, 0, 1)
    s, phi, fraction = (w[:, None] for w in (v["s"], v["phi"], fraction))
    binding = Binding(s, phi, fraction, patch, nodes, v["alpha"])

    def row(y):
        return jnp.broadcast_to(y[..., None], (*y.shape, 3))

    keys: Keys = clamped(v["s_c"], row(v["w_C"]), row(v["J"]), row(v["U"]), row(v["V"]))
    moved = interpolate(binding, weigh(binding, v["phi_c"]), keys, method="linear")
    return _done(u=moved[:, 0])


def on_ring_weight(v: Values) -> Answer:
    """`ring_weight`: how much the contact rests on a ring (two-material law)."""
    return _done(weight=ring_weight(v["s"], v["x"], v["transition"]))


def friction(v: Values) -> Answer:
    """`slide`: one step of the return mapping; skeleton compliance (normal, tangential)."""
    C = jnp.diag(jnp.stack([v["C"][0], v["C"][1], v["C"][1]]))
    got = slide(v["D"], C, Law(v["k_1"], v["k_3"]), Coulomb(v["mu"]), v["slip"])
    return {"force": got.force, "slip": got.slip}, got.status


def in_time(v: Values) -> Answer:
    """`press_in_time`: two branches, one ring, L = 100 mm; status of the last sample."""
    geometry = _tube(1, 100.0, v["D"].dtype)
    material = Material(v["EI_L"], v["k_M"], v["k_1"], v["k_3"])
    motion = Motion(jnp.asarray(50.0, v["D"].dtype), v["D"], time=v["time"])
    relaxation = Relaxation(Branches(v["gamma"], v["tau"]))
    options = Options(relaxation="uniform", branches="prony-2")
    got = press_in_time(geometry, material, motion, relaxation, options)
    return {"force": got.force, "depth": got.depth}, got.status[-1]


def contacts(v: Values) -> Answer:
    """`contacts.solve`: three tools on one skeleton; status of the last."""
    width = jnp.asarray(1e-12, v["D"].dtype)
    there = v["there"] > 0
    got = solve(v["D"], v["C"], Law(v["k_1"], v["k_3"]), width=width, present=there)
    return {"force": got.force, "depth": got.depth}, got.status[-1]


FUNCTIONS: dict[str, Callable[[Values], Answer]] = {
    f.__name__: f
    for f in (
        series, quintic, total, first_touch, vector, press_9, press_1, compliance_200, beam,
        beam_shear, beam_alone, axial, ring, oblique, spheres, boxes, dent, global_shape,
        on_ring_weight, friction, in_time, contacts,
    )
}  # fmt: skip
