"""Accuracy against time of the repository's scenes, and docs/evidence/tradeoff.md from it.

Run: python tests/bench/tradeoff.py. It measures everything on the page: choices, ladders, levels of
the skeleton (tests/bench/levels.py); an hour on two busy cores.
Options: `--quick` (few calls, two rungs a ladder, no fits), `--scenes A,B` (these only; "": none),
`--no-levels`, `--only-choices` (choices and the ladder of their plans; others stay as they are),
`--page` (write the page and the pictures from the JSON, measure nothing).
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

if __name__ == "__main__":
    import common

    sys.path.insert(0, str(common.FOLDER.parent / "reference"))

    # One thread computes, on any core; programs are compiled on all of them.
    os.sched_setaffinity(0, common.ALL_CORES)

ROOT = Path(__file__).parents[2]
EVIDENCE = ROOT / "docs" / "evidence"
FOLDER, DOCUMENT = EVIDENCE / "tradeoff", EVIDENCE / "tradeoff.md"
HEAD = EVIDENCE / "tradeoff.md.in"
#: The scenes, and at most how many rungs of each ladder.
SCENES = {
    "no_surface": ("configs/no_surface.toml", 3),
    "bonded_pull": ("configs/bonded_pull.toml", 3),
    "normal": ("configs/normal.toml", 3),
    "virtual_trachea": ("fits/virtual_trachea/scene.toml", 3),
    "deep": ("configs/deep.toml", 3),
    "table_1": ("", 2),  # the scene that `jaxtrachea tradeoff` takes by itself
}
DATA = {"virtual_trachea": "fits/virtual_trachea/fit.toml"}
TOLERANCES = (0.5, 0.1, 0.01, 0.001)
#: What is made least: see `price.Objective`.
LEAST = ("path", "step")


def document() -> str:
    """The page that the recorded measurements give."""
    from tradeoff_page import document as made

    return made(FOLDER, HEAD.read_text("utf-8"))


def full_of(name: str, coupling: str | None = None):
    """A scene of the repository at its finest."""
    from jaxtrachea.scene.build import stage
    from jaxtrachea.scene.spec import SceneSpec, load_scene_spec
    from jaxtrachea.tradeoff.levels import BUILT_IN, full_scene

    path = ROOT / (SCENES[name][0] or "configs")
    spec = SceneSpec.model_validate(BUILT_IN) if path.is_dir() else load_scene_spec(path)
    return full_scene(spec, stage(spec, path.parent), coupling=coupling)


def say(text: str) -> None:
    """A line with the time since the start."""
    print(f"{time.perf_counter() - START:6.0f} s  {text}", flush=True)


def cheapest(name: str, full) -> list:
    """The choices, by the time of the path and of a pose a call."""
    from jaxtrachea.tradeoff.choice import choose
    from jaxtrachea.tradeoff.trial import Trial

    trial = Trial(full, lambda text: say(f"{name}: choice: {text}"))
    return [choose(trial, v, by=by) for by in LEAST for v in TOLERANCES]


def choices(name: str, full, settings) -> tuple[list[dict], list]:
    """Rows of the table of choices of one scene, and the choices."""
    import jax
    from tradeoff_page import choice_row

    from jaxtrachea.tradeoff.calls import turn_medians
    from jaxtrachea.tradeoff.cost import Cost, compiled
    from jaxtrachea.tradeoff.levels import program
    from jaxtrachea.tradeoff.load import Load
    from jaxtrachea.tradeoff.measure import environment

    found = cheapest(name, full)
    say(f"{name}: choice: timing")
    rows = []
    for by in LEAST:
        chosen = [choice for choice in found if choice.by == by]
        levels = list(dict.fromkeys([full.levels, *(choice.levels for choice in chosen)]))
        calls = [compiled(by, program(full, v)) for v in levels]
        load = Load()
        seconds = dict(zip(levels, turn_medians(calls), strict=True))
        end = environment(settings._replace(lanes=0), load) | {"turns": len(seconds[full.levels])}
        for choice in chosen:
            others = None if end["others"] is None else max(choice.others, end["others"])
            repeat = Cost.measured(seconds[full.levels], seconds[choice.levels])
            rows.append(choice_row(name, choice, repeat, end | {"others": others}))
    del calls
    jax.clear_caches()  # programs of one scene at a time: see measure
    return rows, found


def together(full, found):
    """The ladder of the plans chosen, and of everything at its coarsest."""
    from jaxtrachea.tradeoff.ladders import Ladder, ladders

    coarsest: dict = {}
    for ladder in ladders(full)[0]:
        if ladder.kind != "algebra" and ladder.name not in ("split", "coupling"):
            coarsest |= next(iter(ladder.rungs.values()))
    rungs, seen = {"all at the coarsest": coarsest}, [full.levels.changed(**coarsest)]
    for choice in found:
        if choice.levels not in (*seen, full.levels):
            rungs[f"{100 * choice.tolerance:g} %, {choice.by}"] = choice.changed
            seen.append(choice.levels)
    return Ladder("together", "together", rungs | {"full": {}}, {})


def scene(name: str, settings, *, only_choices: bool) -> list[dict]:
    """Measure one scene; writes its JSON lines; rows of its choices."""
    from tradeoff_page import read
    from tradeoff_text import lines

    from jaxtrachea.cli.tradeoff import measured_curves
    from jaxtrachea.tradeoff.measure import measure, measure_ladders

    def report(text):
        say(f"{name}: {text}")

    full, file = full_of(name, "series"), FOLDER / f"{name}.jsonl"
    rows, found = choices(name, full, settings)
    curves, radius, _ = measured_curves(ROOT / DATA[name] if name in DATA else None)
    given = settings, report, curves, radius
    if only_choices:
        measured = [row for row in read(file) if row["ladder"] != "together"]
    else:
        measured = measure(name, full, *given)
    measured += measure_ladders(name, full, [together(full, found)], *given)
    file.write_text(lines(measured), "utf-8")
    return rows


def pages() -> None:
    """The pictures of all scenes, and the page."""
    from tradeoff_page import read
    from tradeoff_plots import draw

    for name in (name for name in SCENES if (FOLDER / f"{name}.jsonl").exists()):
        rows = read(FOLDER / f"{name}.jsonl")
        points = [row for row in rows if "left_out" not in row]
        draw(points, name).savefig(FOLDER / f"{name}.png")
    DOCUMENT.write_text(document(), "utf-8")


def measure_all(asked) -> None:
    """Everything asked for, a scene at a time."""
    import levels
    from tradeoff_page import read
    from tradeoff_text import lines

    from jaxtrachea.tradeoff.timing import Settings

    FOLDER.mkdir(exist_ok=True)
    if not (asked.no_levels or asked.only_choices):
        say("levels of the skeleton")
        (FOLDER / "levels.jsonl").write_text(lines(levels.rows(quick=asked.quick)), "utf-8")
    file = FOLDER / "choice.jsonl"
    rows = [row for row in read(file) if row["scene"] in SCENES] if file.exists() else []
    for name in filter(None, asked.scenes.split(",")):
        rungs = 2 if asked.quick else SCENES[name][1]
        settings = Settings(20 if asked.quick else asked.calls, 256, rungs, slopes=False)
        rows = [row for row in rows if row["scene"] != name] + scene(
            name, settings, only_choices=asked.only_choices
        )
        rows.sort(key=lambda row: list(SCENES).index(row["scene"]))
        file.write_text(lines(rows), "utf-8")


def main() -> None:
    """Measure and write."""
    import jax

    parser = argparse.ArgumentParser(description=__doc__)
    for option in ("--quick", "--page", "--no-levels", "--only-choices"):
        parser.add_argument(option, action="store_true")
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--scenes", default=",".join(SCENES))
    asked = parser.parse_args()
    files = [FOLDER / f"{name}.jsonl" for name in filter(None, asked.scenes.split(","))]
    if asked.only_choices and (asked.page or not all(map(Path.exists, files))):
        parser.error("--only-choices is for scenes that have been measured, and not with --page")
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    sys.path.insert(0, str(Path(__file__).parent))
    if not asked.page:
        with tempfile.TemporaryDirectory() as folder:
            jax.config.update("jax_compilation_cache_dir", folder)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
            measure_all(asked)
    pages()
    say("written")


if __name__ == "__main__":
    START = time.perf_counter()
    main()
