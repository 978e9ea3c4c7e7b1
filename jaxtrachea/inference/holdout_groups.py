"""Trials that are left out together: mirror images and other twins, which tell of each other."""

from collections.abc import Iterable, Sequence

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.build import with_recipe
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.read import BadCurve, Curve

#: Trials that a message names.
MANY = 8


def with_holdout_groups(
    study: Study, groups: Iterable[Sequence[str]], unusable: Iterable[BadCurve] = ()
) -> Study:
    """The study with trials that no fit without one of them may see another of.

    Args:
        groups: names of trials; of each specimen those of a group are left out together.
        unusable: curves that are known, but not in the study.

    Raises:
        InputError: a name that no curve has, a trial that stands twice, a group of which no
            specimen has two. Its key is the group's number.
    """
    groups = tuple(map(tuple, groups))
    seen: dict[str, int] = {}
    specimens: dict[str, set[str]] = {}
    for curve in [c for lane in study.curves for c in lane] + list(unusable):
        specimens.setdefault(curve.specimen, set()).add(curve.trial)
    names = sorted({name for trials in specimens.values() for name in trials})
    for i, group in enumerate(groups):
        for name in group:
            _ensure_trial(name, names, str(i))
            if name in seen:
                where = "twice" if seen[name] == i else f"in group {seen[name]}, too"
                raise InputError(
                    f"trial {name!r} stands {where}",
                    key=str(i),
                    cure="name each trial once; all that belong together make one group",
                )
            seen[name] = i
        if not any(len(trials.intersection(group)) > 1 for trials in specimens.values()):
            raise InputError(
                f"no specimen has two of {', '.join(map(repr, group))}, so that none would be "
                "left out with another",
                key=str(i),
                cure="name trials of one specimen, or leave the group out",
            )
    return with_recipe(study, holdout_groups=tuple(tuple(group) for group in groups))


def _ensure_trial(name: str, names: Sequence[str], key: str) -> None:
    if name in names:
        return
    more = f" and {len(names) - MANY} more" if len(names) > MANY else ""
    raise InputError(
        f"no curve has the trial {name!r}",
        key=key,
        expected=f"one of {', '.join(map(repr, names[:MANY]))}{more}",
    )


def companions(curves: Sequence[Curve], holdout_groups: Sequence[Sequence[str]]) -> list[list[int]]:
    """For each curve of a lane, all that are left out with it, itself among them."""
    group = {name: i for i, names in enumerate(holdout_groups) for name in names}
    keys = [(c.specimen, group.get(c.trial, c.trial)) for c in curves]
    members: dict[tuple[str, str | int], list[int]] = {}
    for t, key in enumerate(keys):
        members.setdefault(key, []).append(t)
    return [members[key] for key in keys]


def holdout_sentence(holdout_groups: Sequence[Sequence[str]]) -> list[str]:
    """Which trials are left out together, in words; empty if none are."""
    if not holdout_groups:
        return []
    groups = [", ".join(group) for group in holdout_groups[:MANY]]
    if len(holdout_groups) > MANY:
        groups.append(f"{len(holdout_groups) - MANY} more groups")
    return [f"Left out together: {'; '.join(groups)}"]
