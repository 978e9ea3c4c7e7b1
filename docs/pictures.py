"""Takes the pictures of docs/figures anew: scenes by the command, pages in a headless Chromium.

    PYTHONPATH=.:tests/reference python docs/pictures.py [NAME ...]

pressed_hra.png needs the mesh that docs/simulate.md names as configs/meshes/trachea.glb, which is
not in the repository; without it the picture stays.
"""

import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import synthetic
from browser import Browser
from page_server import Server

FIGURES, CONFIGS = Path(__file__).parent / "figures", Path(__file__).parents[1] / "configs"
MATERIAL = """[material]
EI_L = "1.862 N mm^2"
EA_L = "3.9 N"
EI_C = "13.07 N mm^2"
k_M = "0.1 N/mm"
k_t = "0.4 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
"""
BALL = f"""title = "A ball pressed in at -100 deg, on the far side"
{MATERIAL}[tool]
shape = "sphere"
radius = "5 mm"
[path]
start = ["75 mm", "-3.126 mm", "-17.726 mm"]
end = ["75 mm", "-2.448 mm", "-13.886 mm"]
steps = 10
"""
HANDS = MATERIAL + "".join(
    f"""[[tool]]
name = "{name}"
shape = "sphere"
radius = "{radius} mm"
[[path]]
tool = "{name}"
positions = [["{x} mm", "{y} mm", "{z} mm"]]
"""
    for name, radius, x, y, z in (
        ("finger", 6, 75, 0, 19), ("thumb", 6, 75, 0, -19), ("probe", 3, 60, 17, 0),
    )
)  # fmt: skip
#: The picture that the command makes of a scene, and the scene: a file, or its text.
SCENES = {
    "pressed_far_side": ("surface", BALL),
    "pressed_oblique": ("surface", CONFIGS / "off_midline.toml"),
    "pressed_hra": ("surface", CONFIGS / "imported_tool.toml"),
    "drawn": ("surface", CONFIGS / "bonded_pull.toml"),
    "two_fingers": ("surface", CONFIGS / "two_fingers.toml"),
    "series_friction": ("series", CONFIGS / "friction.toml"),
}
#: Depths of the fit, mm, its truth (EI_L, k_M, k_1, k_3) and its specification.
DEPTHS, TRUTH = np.linspace(0.12, 6.0, 50), np.array([300.0, 1.0, 0.5, 0.2])
FIT = """[data]
files = "curves.csv"
[noise]
force = "0.05 N"
[parameters]
onset = { fixed = 0.0 }
force_offset = { fixed = 0.0 }
"""


def simulate(scene: Path | str, folder: Path) -> Path:
    """The results of a scene."""
    text = scene if isinstance(scene, str) else scene.read_text()
    (folder / "scene.toml").write_text(text.replace("pictures = false", ""))
    if (CONFIGS / "meshes").exists():
        shutil.copytree(CONFIGS / "meshes", folder / "meshes", dirs_exist_ok=True)
    command = [sys.executable, "-m", "jaxtrachea", "simulate", folder / "scene.toml"]
    subprocess.run([*command, "--out", folder / "out"], check=True)
    return folder / "out"


@contextlib.contextmanager
def page(file: Path, there: str, height: int = 760) -> Iterator[Browser]:
    """A window on the page of a scene or a fit, once something is there."""
    server = Server("-m", "jaxtrachea", "view", file, "--no-browser")
    with contextlib.closing(Browser(height=height)) as window:
        try:
            window.go(server.address)
            window.wait(there, 600)
            yield window
            assert not window.errors
        finally:
            server.end()


def take(window: Browser, name: str) -> None:
    """The window as it is, after what is on its way."""
    time.sleep(2)
    window.picture(FIGURES / f"{name}.png")


def press(window: Browser, *places: tuple[float, float, float]) -> None:
    """The tool in hand from place to place, each seen."""
    for x, y, z in places:
        window.run(f"trachea.place({x}, {y}, {z})")
        time.sleep(0.5)


def hand(folder: Path) -> None:
    """One tool: pressed in, and where there is no force."""
    (folder / "hand.toml").write_text(BALL)
    with page(folder / "hand.toml", "window.trachea?.last") as window:
        press(window, *((60, y, 0) for y in (18, 17, 16, 15, 14, 13, 12)))
        take(window, "view")
        for option, value in (("colour", "depth"), ("map", "cividis")):
            box = f"document.querySelector('[data-option={option}]')"
            window.run(f"{box}.value = '{value}'; {box}.onchange()")
        press(window, (60, -14, 2))
        take(window, "view_no_force")


def tools(folder: Path) -> None:
    """Three of them."""
    (folder / "hands.toml").write_text(HANDS)
    with page(folder / "hands.toml", "window.trachea?.last") as window:
        press(window, *((75, 0, z) for z in (18, 17, 16, 15.5)))
        window.run("trachea.take(1)")
        press(window, *((75, 0, z) for z in (-18, -17, -16, -15.5)))
        window.run("trachea.take(2)")
        press(window, *((60, y, 0) for y in (16, 15, 14.5, 14)))
        window.run("trachea.take(0)")
        take(window, "view_tools")


def play(folder: Path) -> None:
    """The ball that drags."""
    out = simulate(CONFIGS / "friction.toml", folder)
    command = [sys.executable, "-m", "jaxtrachea", "play", out / "simulation.h5"]
    subprocess.run(command, check=True)
    with contextlib.closing(Browser()) as window:
        window.go((out / "play.html").as_uri())
        window.wait("window.trachea?.last")
        window.run("row.value = 12; row.oninput()")
        take(window, "view_play")


def stream(folder: Path) -> None:
    """A fit of seven presses, at its end."""
    places = np.array([75.0, 45.0, 22.0, 80.0, 30.0, 60.0, 100.0])
    force = synthetic.forces(TRUTH[None], s_c=places, displacement=DEPTHS)[0][0]
    force = force + 0.05 * np.random.default_rng(0).normal(size=force.shape)
    rows = ["specimen,trial,s_mm,displacement_mm,force_N"]
    for i, (s, row) in enumerate(zip(places, force, strict=True)):
        rows += [f"T1,p{i},{s},{d},{f}" for d, f in zip(DEPTHS, row, strict=True)]
    (folder / "curves.csv").write_text("\n".join(rows) + "\n")
    (folder / "fit.toml").write_text(FIT)
    with page(folder / "fit.toml", "!!document.querySelector('#play')", 860) as window:
        window.run("document.querySelector('#play').click()")
        window.wait("/settled/.test(document.querySelector('#where').innerText)", 300)
        take(window, "view_stream")


PAGES = {"view": hand, "view_tools": tools, "view_play": play, "view_stream": stream}


def main(names: list[str]) -> None:
    """All of them, or those of these names."""
    for name in names or [*SCENES, *PAGES]:
        with tempfile.TemporaryDirectory() as folder:
            if name in PAGES:
                PAGES[name](Path(folder))
            elif name != "pressed_hra" or (CONFIGS / "meshes").exists():
                picture, scene = SCENES[name]
                out = simulate(scene, Path(folder))
                shutil.copy(out / f"{picture}.png", FIGURES / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
