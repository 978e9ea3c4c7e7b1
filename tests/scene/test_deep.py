"""What scenes cannot do is refused: what softens, or a tool with a width, as vectors."""

import dataclasses

import jax.numpy as jnp
import pytest
from small_scenes import BALL, BARE, MATERIAL, TUBE, ball

from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.stage import Presses


@pytest.mark.parametrize("changes", [{"half_width": 2.4}, {"skeleton": "softening"}])
def test_oblique_presses_refuse(changes):
    with pytest.raises(ValueError, match="half_width=0 and options.skeleton='linear'"):
        ObliqueOptions(Options(**changes))


@pytest.mark.slow
@pytest.mark.compiling
def test_plan_refuses_a_split_without_an_energy():
    """Of a tool that wanders; a place that is kept, and presses at places, have it."""
    effects = dataclasses.replace(BARE, contact_point="per_step")
    plan = make_scene(
        TUBE, MATERIAL, ball([75, 1, 0], [75, -2, 0]), tool=BALL, effects=effects
    ).plan
    options = dataclasses.replace(plan.options, split="independent")
    with pytest.raises(InputError, match="options.split is 'independent'.*'continuous'.*fixed"):
        dataclasses.replace(plan, options=options)
    path = Presses(jnp.array([75.0, 62.0]), jnp.zeros(2), jnp.array([[0.0, -1.0, 0.0]] * 2))
    plan = make_scene(TUBE, MATERIAL, path, effects=BARE).plan
    assert plan.contact_point == "per_step"
    assert dataclasses.replace(plan, options=options).options.split == "independent"
