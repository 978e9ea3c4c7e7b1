"""`simulate` of tools at places, unturned, by the program of a hand.

    python simulate_places.py SCENE PLACES SIMULATION.h5

PLACES: a list of positions, mm (JSON); of several tools by name.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from jaxtrachea.output.results import write_simulation
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses
from jaxtrachea.viewer.scene import read_handled


def path_of(places):
    if isinstance(places, dict):
        return {name: path_of(own) for name, own in places.items()}
    return Poses(np.tile(np.eye(3), (len(places), 1, 1)), np.array(places))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    staged, path = read_handled(Path(sys.argv[1])).staged, path_of(json.loads(sys.argv[2]))
    out = jax.jit(simulate)(staged.scene, staged.material, path)
    write_simulation(Path(sys.argv[3]), staged.scene, staged.material, path, out, {})
