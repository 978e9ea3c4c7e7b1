"""Ten curves of one specimen, pressed and identified by MuJoCo 4 and by ours.

    pip install 'mujoco[sysid]>=4'; python tests/bench/identification.py

MuJoCo has no beam on springs; this one is made of its own parts and is exact for forces at nodes:
a node at every ring and at the tool has two sliding joints, deflection and rotation, and the two
bending modes of a span are fixed tendons. A ring is the stiffness of a joint, the local law a
tendon of stiffness (k_1, 0, k_3), the tool a position servo, its force the measurement. The step is
1 s and the mass 1e-9, so that a step of the implicit integrator `discrete` is a Newton step to
rest. `sysid.optimize` differentiates by differences; bodies are not compiled anew for it, their
stiffness is written into a copy of the model.
"""

import contextlib
import copy
import time

import common  # First: it pins the process before numpy and jax are loaded.

# isort: split
import fitting
import jax
import numpy as np

from jaxtrachea.fitting import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.mechanics.press import press
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

try:
    import mujoco
    from mujoco import batch, sysid
except ImportError as missing:
    raise SystemExit(f"skipped: {missing}; pip install 'mujoco[sysid]>=4'") from missing

SPOTS = np.array([15.0, 30.0, 40.0, 55.0, 65.0, 80.0, 95.0, 110.0, 125.0, 140.0])
LENGTH, RINGS = 160.0, 10.0 * np.arange(1, 16)
#: Steps at each depth (the force is right to 1e-9 of its peak), stiffness of the servo, N/mm.
STEPS, SERVO = 8, 1e4
SPECIMENS, SAMPLE = 500, 2
START, TRUTH = fitting.start(), (100.0, 1.0, 1.0, 0.01)
OURS, LAW = "jaxtrachea", "law"


def beam(spot: float) -> mujoco.MjSpec:
    """The tube with the tool at `spot`, all stiffness 1; as many nodes wherever it is."""
    nodes = np.unique([0.0, *RINGS, spot, LENGTH])
    if len(nodes) == len(RINGS) + 2:
        nodes = np.unique([*nodes, spot + 5])
    spec, last = mujoco.MjSpec(), len(nodes) - 1
    spec.option.timestep, spec.option.gravity = 1.0, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE

    def slide(name, stiffness=0.0):
        mass = {"mass": 1e-9, "inertia": [1e-9] * 3, "explicitinertial": True}
        body = spec.worldbody.add_body(name=name, **mass)
        kind = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=name, type=kind, axis=[0, 0, 1], stiffness=[stiffness, 0, 0])

    def spring(name, stiffness, **factors):
        tendon = spec.add_tendon(name=name, stiffness=stiffness, springlength=[0, 0])
        for joint, factor in factors.items():
            if joint not in ("w0", "r0", f"w{last}", f"r{last}"):  # clamped
                tendon.wrap_joint(joint, factor)

    for i, x in enumerate(nodes[1:-1], 1):
        slide(f"w{i}", float(x in RINGS))
        slide(f"r{i}")
    for i, h in enumerate(np.diff(nodes)):
        turns = {f"r{i}": -1.0, f"r{i + 1}": 1.0}
        spring(f"bend{i}", [1 / h, 0, 0], **turns)
        sways = {f"w{i}": -1 / h, f"w{i + 1}": 1 / h, f"r{i}": -0.5, f"r{i + 1}": -0.5}
        spring(f"sway{i}", [12 / h, 0, 0], **sways)
    slide("tool")
    spring(LAW, [1, 0, 1], tool=1.0, **{f"w{int(np.searchsorted(nodes, spot))}": -1.0})
    servo = spec.add_actuator(name="tool", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="tool")
    servo.set_to_position(kp=SERVO)
    force, what = mujoco.mjtSensor.mjSENS_ACTUATORFRC, mujoco.mjtObj.mjOBJ_ACTUATOR
    spec.add_sensor(name="force", type=force, objtype=what, objname="tool")
    spec.modelname = f"at {spot:g}"
    return spec


def with_values(model: mujoco.MjModel, values) -> mujoco.MjModel:
    """A copy of a model of unit stiffness with EI_L, k_M, k_1, k_3."""
    EI, k, k_1, k_3 = values
    made, law = copy.copy(model), model.tendon(LAW).id
    made.tendon_stiffness[:] *= EI
    made.tendon_stiffness[law], made.tendon_stiffnesspoly[law, 1] = k_1, k_3
    made.jnt_stiffness[:] *= k
    return made


def values_of(theta):
    """As `fitting.Numpy`: logarithms, and k_3 in steps."""
    return (*np.exp(theta[:3]), fitting.STEP_K_3 * theta[3])


def pressed(models, depths):
    """A call that presses all positions together; forces (positions, depths)."""

    def call():
        many = batch.Batch(models[0], nsim=len(models), nthread=1)
        many.set_models(models)
        ctrl, sensor = many.bind("ctrl"), many.bind("sensordata")
        force = np.empty((len(models), len(depths)))
        for i, depth in enumerate(depths):
            ctrl[:] = depth
            many.step(nstep=STEPS)
            force[:, i] = sensor[:, 0]
        return force

    return call


def identified(specs, depths, force, optimizer: str):
    """A call that identifies one specimen by `mujoco.sysid`; gives theta."""
    times = np.arange(len(depths) * STEPS + 1.0)

    def sequence(spec, forces):
        control, seen = (np.append(np.repeat(v, STEPS), v[-1])[:, None] for v in (depths, forces))
        model = spec.compile()
        return sysid.ModelSequences(
            spec.modelname, spec, "press", sysid.create_initial_state(model, np.zeros(model.nq)),
            sysid.TimeSeries.from_control_names(times, control, model),
            sysid.TimeSeries.from_names(times[1:], seen[:-1], model),
        )  # fmt: skip

    def difference(params, found, measured, model, everything, state=None):
        at_rest = slice(STEPS - 1, None, STEPS)
        return found.data[at_rest] - measured.data[at_rest], found, measured

    sequences = list(map(sequence, specs, force))
    models = {s.name: s.gt_model for s in sequences}

    def with_params(params, spec):
        return with_values(models[spec.modelname], values_of(params.as_vector()))

    residual = sysid.build_residual_fn(
        models_sequences=sequences, build_model=with_params, modify_residual=difference,
        resample_true=False, n_threads=1,
    )  # fmt: skip
    # A law that softens made steps diverge, and times that start anew are refused.
    low, high = [np.log(1e-3)] * 3 + [0.0], [np.log(1e5)] * 3 + [100.0]

    def call():
        params = sysid.ParameterDict()
        for name, *three in zip(fitting.NAMES, START, low, high, strict=True):
            params.add(sysid.Parameter(name, *three))
        with contextlib.redirect_stdout(None):  # `verbose=False` leaves the solver's own lines
            found, _ = sysid.optimize(params, residual, optimizer, verbose=False)
        return found.as_vector()

    return call


def our_press(values):
    """The same forces by ours."""
    geometry, material = table_1(np.float64), Material(*values)
    along = jax.vmap(lambda s, d: press(geometry, material, s, d).force, (None, 0))
    run = jax.jit(jax.vmap(along, (0, None))).lower(SPOTS, fitting.DEPTHS).compile()
    return lambda: np.asarray(run(SPOTS, fitting.DEPTHS))


def in_turns(calls, turns: int) -> tuple[dict, dict[str, list[float]]]:
    """Results by name, and processor seconds of every call, one of each in turn."""
    calls[OURS]()  # compiled
    found, seconds = {}, {name: [] for name in calls}
    for _ in range(turns):
        for name, call in calls.items():
            begin = time.process_time()
            found[name] = call()
            seconds[name].append(time.process_time() - begin)
    return found, seconds


def main() -> None:
    """Measure in turns, compare with ours, write."""
    out = common.Writer("identification", "mujoco", "scipy")
    specs, depths = list(map(beam, SPOTS)), fitting.DEPTHS
    models = [with_values(spec.compile(), TRUTH) for spec in specs]
    calls = {OURS: our_press(TRUTH), "mujoco.batch": pressed(models, depths)}
    found, seconds = in_turns(calls, 9)
    differs = {name: common.close(name, f, found[OURS], 2e-4) for name, f in found.items()}
    out.table("press", seconds, differs=differs)

    study, model, forces = fitting.make_study(SPECIMENS, SPOTS, depths)
    settings = Settings(starts=1, verify=False)
    calls = {
        OURS: lambda: fit.fit(study, settings),
        "scipy least_squares lm, numpy": fitting.one_by_one(
            model, forces[:SAMPLE], lambda i: fitting.with_scipy(model.value, model.jacobian)[0]
        ),
    }
    for optimizer in ("mujoco", "scipy"):
        ready = [identified(specs, depths, force, optimizer) for force in forces[:SAMPLE]]
        calls[f"mujoco.sysid, {optimizer}"] = lambda ready=ready: [call() for call in ready]
    found, seconds = in_turns(calls, 1)
    # Further columns are of lanes that free more; these two have the four alone.
    for unknowns in found[OURS].study.unknowns[:SAMPLE]:
        assert [p.name for p, *_ in unknowns] == list(fitting.NAMES)
    ours = found[OURS].theta[:SAMPLE, :4]
    found[OURS], error = ours, model_errors(model, forces[:SAMPLE], ours)
    differs = {name: float(np.max(abs(np.array(t) - ours) / error)) for name, t in found.items()}
    assert max(differs.values()) < 0.1, differs
    lanes = {name: SPECIMENS if name == OURS else SAMPLE for name in calls}
    out.table("fit", seconds, differs=differs, lanes=lanes)
    out.write()


def model_errors(model, forces, theta):
    """Standard errors of the first specimens at our estimates, in scaled coordinates."""
    errors = []
    for force, at in zip(forces, theta, strict=False):
        model.load(force)
        errors.append(fitting.standard_errors(model.jacobian(at), model.value(at)))
    return np.array(errors)


if __name__ == "__main__":
    main()
