"""The parameters of a scene that a plan reads, as sliders, and their way back into its file."""

import re
import tomllib
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.scene.plan import Plan
from jaxtrachea.trachea.material import VALUES, Declaration

#: A slider goes from the value over this to the value times this.
SPAN = 10.0


class Slider(NamedTuple):
    """One parameter under a slider, in its unit.

    Attributes:
        name: of the parameter.
        unit: of it.
        description: in words.
        value: in the scene.
        low: end of the slider.
        high: likewise.
        log: the slider is logarithmic; one of a value that is not positive is linear.
    """

    name: str
    unit: str
    description: str
    value: float
    low: float
    high: float
    log: bool

    def at(self, share: float) -> float:
        """The value at a share of the way of the slider, 0 to 1."""
        if self.log:
            return float(self.low * (self.high / self.low) ** share)
        return self.low + share * (self.high - self.low)

    @property
    def share(self) -> float:
        """Where the scene's value stands on the slider, 0 to 1."""
        if self.log:
            return float(np.log(self.value / self.low) / np.log(self.high / self.low))
        return (self.value - self.low) / (self.high - self.low)


def is_read(parameter: Declaration, plan: Plan) -> bool:
    """Whether a plan reads a parameter of a line of joints."""
    if parameter.name in ("k_A", "k_B"):
        return plan.end_motion
    if parameter.name == "GA_side":
        return plan.has("shear") and plan.second_plane
    bends = plan.rings != "mat"
    return {
        "": True, "shear": plan.has("shear"), "two-material": plan.has("two_material"),
        "softening": plan.options.skeleton == "softening", "axial": plan.axial, "arch": bends,
        "arch, sections": bends, "second plane": plan.second_plane,
    }.get(parameter.needs, False)  # fmt: skip


def sliders(material: Any, plan: Plan) -> list[Slider]:
    """One for every given parameter that the plan reads."""
    found = []
    for name, p in VALUES.items():
        value = getattr(material, name)
        if value is None or np.ndim(value) or not is_read(p, plan):
            continue
        value = float(value)
        if value > 0:
            ends = value / SPAN, value * SPAN
        else:
            step = p.fit.step if p.fit is not None else 1.0
            ends = value - SPAN * step, value + SPAN * step
        found.append(Slider(name, p.unit, p.description, value, *ends, log=value > 0))
    return found


def with_values(text: str, values: dict[str, float]) -> str:
    """The text of a scene file with other values in its `[material]`.

    Args:
        text: TOML with a table `[material]`.
        values: in the units of the parameters.

    Raises:
        ValueError: the file writes a value in a way that is not replaced (it is not on a line of
            its own below `[material]`).
    """
    parts = re.split(r"(?m)^(?=\s*\[)", text)
    done = []
    for part in parts:
        if re.match(r"\s*\[material\]", part):
            for name, value in values.items():
                written = f'{name} = "{value:.6g} {VALUES[name].unit}"'
                part = re.sub(rf"(?m)^\s*{name}\s*=[^#\n]*?(?=\s*(#|$))", written, part)
        done.append(part)
    new = "".join(done)
    table = tomllib.loads(new).get("material", {})
    for name, value in values.items():
        if str(table.get(name)) != f"{value:.6g} {VALUES[name].unit}":
            raise ValueError(
                f"material.{name}: not on a line of its own in the file; write {name} = "
                f'"{value:.6g} {VALUES[name].unit}" there by hand'
            )
    return new
