"""How processes find each other: run as a program of its own, so that nothing of it stays behind.

`jax.distributed` knows clusters (Slurm, Open MPI, Kubernetes, TPU), but binds the devices of all
processes together for as long as a program runs. Here each process computes for itself: the
program that asks for the others ends before the computation begins, and sees CPUs only.
"""

import json
import os
import subprocess
import sys
import uuid

#: Settings that share the devices of a machine between its processes.
_VISIBLE = ("jax_cuda_visible_devices", "jax_rocm_visible_devices")
#: Devices of the meeting alone, and how they speak to each other.
_ENVIRONMENT = {"JAX_PLATFORMS": "cpu", "JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo"}


def place(
    coordinator: str | None, processes: int | None, process: int | None, timeout: int
) -> dict:
    """Index of this process, number of all, and a name that only they share.

    Args:
        coordinator: HOST:PORT of process 0; None: as the cluster says, like the next two.
        processes: how many.
        process: index of this one.
        timeout: seconds to wait for the others.

    Returns:
        `process`, `processes`, `session` and `devices`, JAX's settings that leave this process the
        devices that the cluster means for it; or `error`, in words.
    """
    asked = json.dumps([coordinator, processes, process, timeout])
    done = subprocess.run(
        [sys.executable, "-m", "jaxtrachea.runs.meet", asked],
        env=os.environ | _ENVIRONMENT,
        capture_output=True,
        text=True,
    )
    lines = done.stdout.splitlines()
    if done.returncode == 0 and lines:
        return json.loads(lines[-1])
    last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
    return {"error": f"the processes did not meet: {last[0]}"}


def _meet(
    coordinator: str | None, processes: int | None, process: int | None, timeout: int
) -> dict:
    """As `place`, in this process."""
    import jax
    import numpy as np
    from jax.experimental.multihost_utils import broadcast_one_to_all

    try:
        jax.distributed.initialize(coordinator, processes, process, initialization_timeout=timeout)
        numbers = np.frombuffer(uuid.uuid4().bytes, np.int32)
        session = np.asarray(broadcast_one_to_all(numbers)).tobytes().hex()
        index, count = jax.process_index(), jax.process_count()
        jax.distributed.shutdown()
    except (ValueError, TypeError) as error:
        return {"error": f"no cluster found ({error})"}
    except RuntimeError as error:
        return {"error": f"the processes did not meet: {str(error).splitlines()[0]}"}
    devices = {name: jax.config.values[name] for name in _VISIBLE if name in jax.config.values}
    return {"process": index, "processes": count, "session": session, "devices": devices}


if __name__ == "__main__":
    print(json.dumps(_meet(*json.loads(sys.argv[1]))))
