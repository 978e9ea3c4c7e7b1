"""`simulate` of the tool at places, unturned, by the program of a hand.

    python simulate_places.py SCENE PLACES SIMULATION.h5

PLACES: a list of positions, mm (JSON).
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from jaxtrachea.scene.results import write_simulation
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses
from jaxtrachea.viewer.scene import read_handled

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    staged, places = read_handled(Path(sys.argv[1])).staged, np.array(json.loads(sys.argv[2]))
    path = Poses(np.tile(np.eye(3), (len(places), 1, 1)), places)
    out = jax.jit(simulate)(staged.scene, staged.material, path)
    write_simulation(Path(sys.argv[3]), staged.scene, staged.material, path, out, {})
