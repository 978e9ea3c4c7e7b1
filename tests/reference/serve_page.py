"""`jaxtrachea view` of a scene, in a process that first simulates given places by itself.

    python serve_page.py SCENE PLACES.npy SIMULATION.h5

It prints a line for each program that XLA compiles.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from compilations import EVENT

from jaxtrachea.cli.main import main
from jaxtrachea.scene.results import write_simulation
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses
from jaxtrachea.viewer.scene import read_handled


def note(event, *_, **__):
    if event == EVENT:
        print("compiled", flush=True)


def simulate_places(scene, places, file):
    """`simulate` of the tool at these places, unturned, by the program of a hand."""
    staged = read_handled(scene).staged
    path = Poses(np.tile(np.eye(3), (len(places), 1, 1)), places)
    out = jax.jit(simulate)(staged.scene, staged.material, path)
    write_simulation(file, staged.scene, staged.material, path, out, {})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(note)
    scene, places, file = map(Path, sys.argv[1:])
    simulate_places(scene, np.load(places), file)
    sys.argv[1:] = ["view", str(scene), "--no-browser"]
    main()
