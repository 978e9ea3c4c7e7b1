#!/usr/bin/env bash
# MuJoCo: tolerance = 0, "to disable early termination", breaks steps of the integrator `discrete`.
#
# Versions: mujoco 4.0.0, numpy 2.4.6, Python 3.11. Seen on 2026-11-30:
#   16 sliding bodies on springs, neighbours joined by tendons (1000 N/m), one pushed with 1 N, 20
#   steps of 1 s: with the default tolerance 1e-8 they rest at the solution of the linear system to
#   1e-8. With 0 the accelerations become NaN in the second step, and mj_step puts state AND controls
#   back to zero, without an exception: all that follows is a chain at rest, force 0.
# The guess that was wrong: a smaller tolerance costs time and is at least as accurate; the reference
# offers 0 as a way to run all iterations.
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "mujoco==4.0.0" "numpy==2.4.6"
cat > "$folder/run.py" <<'PY'
import sys

import mujoco
import numpy as np

COUNT, RING, TENDON, STEPS = 16, 1.0, 1000.0, 20
exact = RING * np.eye(COUNT)
for i in range(COUNT - 1):
    exact[i : i + 2, i : i + 2] += TENDON * np.array([[1, -1], [-1, 1]])
exact = np.linalg.solve(exact, np.eye(COUNT)[7])
found = {}
for tolerance in (1e-8, 0.0):
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity, spec.option.tolerance = 1.0, [0, 0, 0], tolerance
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    for i in range(COUNT):
        mass = {"mass": 1e-9, "inertia": [1e-9] * 3, "explicitinertial": True}
        body = spec.worldbody.add_body(name=f"w{i}", **mass)
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=f"w{i}", type=slide, axis=[0, 0, 1], stiffness=[RING, 0, 0])
    for i in range(COUNT - 1):
        tendon = spec.add_tendon(stiffness=[TENDON, 0, 0], springlength=[0, 0])
        tendon.wrap_joint(f"w{i}", -1)
        tendon.wrap_joint(f"w{i + 1}", 1)
    spec.add_actuator(name="push", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="w7")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    error = float(np.max(abs(data.qpos - exact)) / np.max(exact))
    resets = data.warning[int(mujoco.mjtWarning.mjWARN_BADQACC)].number
    found[tolerance] = error, data.time, float(data.ctrl[0])
    print(f"tolerance {tolerance:g}: error {error:.1e}, time {data.time:g} s after {STEPS} steps,"
          f" control {data.ctrl[0]:g}, resets seen {resets}")
error, time, control = found[1e-8]
sys.exit(not (error < 1e-8 and time == STEPS and control == 1
              and found[0.0][0] == 1 and found[0.0][1] < STEPS and found[0.0][2] == 0))
PY
cd "$folder"
"$folder/venv/bin/python" "$folder/run.py"
