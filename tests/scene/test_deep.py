"""What scenes cannot do yet is refused: a skeleton that softens, a tool's width off the midline."""

import jax.numpy as jnp
import pytest

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.oblique import press_oblique, press_path
from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.spec import MaterialSection
from jaxtrachea.scene.stage import Presses
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

VALUES = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02}
UNITS = {"EI_L": "N mm^2", "k_M": "N/mm", "k_1": "N/mm", "k_3": "N/mm^3"}


def test_scene_refuses_a_softening_skeleton():
    path = Presses(jnp.array([75.0]), jnp.zeros(1), jnp.array([[0.0, -1.0, 0.0]]))
    material = Material(**VALUES, e_1=0.1, e_2=0.005)
    with pytest.raises(InputError, match=r"Material\.e_1.*linear"):
        make_scene(table_1(), material, path)
    written = {name: f"{v} {UNITS[name]}" for name, v in VALUES.items()}
    with pytest.raises(ValueError, match="e_2: the skeleton of a scene is linear"):
        MaterialSection(**written, e_2="0.005 1/mm^2")


@pytest.mark.parametrize("changes", [{"half_width": 2.4}, {"skeleton": "softening"}])
def test_oblique_presses_refuse(changes):
    options = Options(**changes)
    D = jnp.array([[0.0, -1.0, 0.0]])
    material = Material(**VALUES, e_1=0.1, e_2=0.005)
    with pytest.raises(ValueError, match="half_width=0 and options.skeleton='linear'"):
        press_oblique(table_1(), material, 75.0, 0.0, D, options)
    with pytest.raises(ValueError, match="half_width=0 and options.skeleton='linear'"):
        press_path(table_1(), material, 75.0, 0.0, D, 0.5, options)
