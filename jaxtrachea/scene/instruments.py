"""Several tools of one scene: what each sees of it, their paths side by side, their contact."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool

from jaxtrachea.contact.patches import Touch
from jaxtrachea.scene.stage import Instrument, Poses, Presses, Scene, check_path, touch_rows

#: From derivatives by s, phi and gap of every tool to those by its poses.
Pull = Callable[[list[tuple[Any, Any, Any]]], list[Poses]]


def scene_of(scene: Scene, instrument: Instrument) -> Scene:
    """The scene as if this instrument were its only tool."""
    own = {f.name: getattr(instrument, f.name) for f in dataclasses.fields(Instrument)}
    plan, contact = scene.plan, own.pop("contact")
    del own["name"]
    if contact is not None:
        options = dataclasses.replace(plan.options, contact=contact)
        plan = dataclasses.replace(plan, options=options)
    return dataclasses.replace(scene, instruments=(), plan=plan, **own)


def views(scene: Scene) -> list[Scene]:
    """The scene as each tool sees it."""
    return [scene_of(scene, instrument) for instrument in scene.instruments]


def glued(scene: Scene) -> Bool[np.ndarray, " m"]:
    """Which instruments of a scene are glued to the wall."""
    return np.array([view.plan.options.contact == "bonded" for view in views(scene)])


def paths_in_order(
    names: list[str], paths: Mapping[str, Presses | Poses]
) -> tuple[Presses | Poses, ...]:
    """Checked paths in the order of these tools; shorter ones rest at their last row.

    Raises:
        ValueError: other names than those; as `check_path`; presses beside motions; times for some
            paths alone, or clocks that do not agree.
    """
    if set(paths) != set(names):
        raise ValueError(f"path has the tools {_listed(paths)}; expected {_listed(names)}")
    found = [paths[name] for name in names]
    for name, path in zip(names, found, strict=True):
        try:
            check_path(path)
        except ValueError as error:
            raise ValueError(f"path of tool {name!r}: {error}") from None
    if len({type(path) for path in found}) > 1:
        kinds = ", ".join(f"{n!r} {type(p).__name__}" for n, p in zip(names, found, strict=True))
        raise ValueError(f"path mixes kinds ({kinds}); expected Poses for all tools, or Presses")
    _check_clocks(names, found)
    rows = max(map(rows_of, found))
    return tuple(_rested(path, rows) for path in found)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names)) or "none"


def rows_of(path: Presses | Poses) -> int:
    """How many rows a path has."""
    return len(path.s if isinstance(path, Presses) else path.translation)


def _rested(path: Presses | Poses, rows: int) -> Presses | Poses:
    """The path, resting at its last row up to so many."""
    more = rows - rows_of(path)
    if not more:
        return path
    return jax.tree.map(lambda v: jnp.concatenate([v, jnp.repeat(v[-1:], more, axis=0)]), path)


def _check_clocks(names: list[str], paths: list[Presses | Poses]) -> None:
    """Refuse times that are not those of one clock (traced ones are not looked at).

    Raises:
        ValueError: naming both tools and the row.
    """
    timed = [path.time is not None for path in paths]
    if any(timed) and not all(timed):
        without, other = names[timed.index(False)], names[timed.index(True)]
        raise ValueError(f"path of tool {without!r} has no time; expected one, as {other!r} has")
    first = paths[0].time
    for name, path in zip(names[1:], paths[1:], strict=True):
        if first is None or any(isinstance(v, Tracer) for v in (first, path.time)):
            continue
        a, b = np.asarray(first), np.asarray(path.time)
        most = min(len(a), len(b))
        unlike = np.flatnonzero(a[:most] != b[:most])
        if len(unlike) or len(a) != len(b):
            row = int(unlike[0]) if len(unlike) else most
            raise ValueError(
                f"path of tool {name!r} has {len(b)} rows and that of {names[0]!r} {len(a)}, and "
                f"their times differ from row {row + 1} on; expected one clock: the same times"
            )


def touch_and_pull(scene: Scene, paths: Sequence[Poses]) -> tuple[list[Touch], Pull]:
    """As `touch_together`, and from derivatives by place and gap to those by the poses."""

    def touched(paths):
        seen = touch_together(scene, paths)
        return [(one.s, one.phi, one.gap) for one in seen], seen

    _, pull, seen = jax.vjp(touched, list(paths), has_aux=True)
    return seen, lambda by: pull(by)[0]


def touch_together(scene: Scene, paths: Sequence[Poses]) -> list[Touch]:
    """As `touch_tube`, of every instrument; those that are alike in kind share one program."""
    found: dict[int, Touch] = {}
    alike: dict[Any, list[int]] = {}
    for i, one in enumerate(scene.instruments):
        shapes = tuple(v.shape for v in jax.tree.leaves(one.tool))
        alike.setdefault((shapes, one.near, one.quality), []).append(i)
    for (_, near, quality), which in alike.items():
        chosen = [
            (scene.instruments[i].tool, paths[i].rotation, paths[i].translation) for i in which
        ]
        tools, R, T = jax.tree.map(lambda *v: jnp.stack(v), *chosen)

        def touched(one, near=near, quality=quality):
            assert scene.tube is not None
            tool, R, T = one
            return touch_rows(tool, scene.tube, Poses(R, T), quality, near)

        seen = jax.lax.map(touched, (tools, R, T))
        found |= {i: jax.tree.map(lambda v, k=k: v[k], seen) for k, i in enumerate(which)}
    return [found[i] for i in range(len(paths))]
