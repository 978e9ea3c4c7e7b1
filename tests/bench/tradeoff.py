"""Accuracy against time of the repository's scenes, and docs/tradeoff.md from it.

Run: python tests/bench/tradeoff.py. Options: `--quick` (three rungs a ladder, 100 calls),
`--scenes A,B` and `--choices A,B` (these only; "": none), `--page` (write the page from the JSON,
measure nothing).
"""

import argparse
from pathlib import Path

if __name__ == "__main__":
    import common  # noqa: F401 (pins one core; before jax)

ROOT = Path(__file__).parents[2]
FOLDER, DOCUMENT = ROOT / "docs" / "tradeoff", ROOT / "docs" / "tradeoff.md"
HEAD = ROOT / "docs" / "tradeoff.md.in"
SCENES = {
    "table_1": "",  # the scene that `jaxtrachea tradeoff` takes by itself
    "normal": "configs/normal.toml",
    "capsule": "configs/capsule.toml",
    "off_midline": "configs/off_midline.toml",
    "friction": "configs/friction.toml",
    "virtual_trachea": "fits/virtual_trachea/scene.toml",
}
DATA = {"virtual_trachea": "fits/virtual_trachea/fit.toml"}
#: Scenes and tolerances of the table of choices; names not in `SCENES` are those of configs/.
CHOICES = ("table_1", "no_surface", "bonded_pull", "normal", "off_midline", "friction",
           "virtual_trachea")  # fmt: skip
TOLERANCES = (0.1, 0.01, 0.001)


def document() -> str:
    """The page that the recorded measurements give."""
    from jaxtrachea.tradeoff.page import document as made

    return made(FOLDER, HEAD.read_text("utf-8"))


def full_of(name: str, coupling: str | None = None):
    """A scene of the repository at its finest."""
    from jaxtrachea.scene.build import stage
    from jaxtrachea.scene.spec import SceneSpec, load_scene_spec
    from jaxtrachea.tradeoff.levels import BUILT_IN, full_scene

    path = ROOT / (SCENES.get(name, f"configs/{name}.toml") or "configs")
    spec = SceneSpec.model_validate(BUILT_IN) if path.is_dir() else load_scene_spec(path)
    return full_scene(spec, stage(spec, path.parent), coupling=coupling)


def scene(name: str, settings) -> None:
    """Measure one scene; writes its JSON lines and its picture."""
    from jaxtrachea.cli.tradeoff import measured_curves
    from jaxtrachea.tradeoff.measure import measure
    from jaxtrachea.tradeoff.page import lines
    from jaxtrachea.tradeoff.plots import draw

    curves, radius, _ = measured_curves(ROOT / DATA[name] if name in DATA else None)

    def say(text):
        return print(name, text, flush=True)

    rows = measure(name, full_of(name, "series"), settings, say, curves, radius)
    (FOLDER / f"{name}.jsonl").write_text(lines(rows), "utf-8")
    draw([row for row in rows if "left_out" not in row], name).savefig(FOLDER / f"{name}.png")


def choices(names: list[str], settings) -> None:
    """Choose plans for these scenes at every tolerance, and time them against the full ones."""
    import jax

    from jaxtrachea.tradeoff.choice import choose
    from jaxtrachea.tradeoff.measure import choice_row, compiled, timed
    from jaxtrachea.tradeoff.page import lines

    rows, settings = [], settings._replace(lanes=0)
    for name in names:
        full = full_of(name)
        found = [choose(full, v, lambda text: print(text, flush=True)) for v in TOLERANCES]
        levels = {full.levels, *(choice.levels for choice in found)}
        programs = {v: compiled(full, v, 0, slopes=False) for v in levels}
        times = timed(programs, settings)
        rows += [choice_row(name, full, choice, times, settings) for choice in found]
        (FOLDER / "choice.jsonl").write_text(lines(rows), "utf-8")
        del programs
        jax.clear_caches()  # programs of one scene at a time: see measure


def main() -> None:
    """Measure and write."""
    import jax

    parser = argparse.ArgumentParser(description=__doc__)
    for option in ("--quick", "--page"):
        parser.add_argument(option, action="store_true")
    parser.add_argument("--calls", type=int, default=1000)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--choices", default=",".join(CHOICES))
    asked = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    from jaxtrachea.tradeoff.measure import Settings

    settings = Settings(100, 0, True) if asked.quick else Settings(asked.calls)
    FOLDER.mkdir(exist_ok=True)
    if not asked.page:
        for name in filter(None, asked.scenes.split(",")):
            scene(name, settings)
        if asked.choices:
            choices(asked.choices.split(","), settings)
    DOCUMENT.write_text(document(), "utf-8")


if __name__ == "__main__":
    main()
