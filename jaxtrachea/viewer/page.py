"""The page of a scene: the view, the curve, the sliders."""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import app, ui
from nicegui.element import Element
from nicegui.elements.scene.scene import Scene as _Scene  # registers the module that holds three.js

from jaxtrachea.viewer.frame import COLOURS
from jaxtrachea.viewer.live import Live
from jaxtrachea.viewer.serve import SMALL, Page, serve
from jaxtrachea.viewer.server import Frames, add_routes

__all__ = ["serve_scene"]

_ = _Scene
KEYS = (
    "drag the tool, or click the wall to press there. Arrows: along x and y; page up and down: z; "
    "shift: a tenth. Q E, A D, W S turn the tool about x, y, z."
)
MORE_KEYS = " 1 to 9: the tool in hand; so does a drag of it."


class Wall(Element, component="wall.js"):
    """The view of the scene."""


def serve_scene(
    path: Path, port: int, opened: Callable[[str], None], set_up: Callable[[], None]
) -> None:
    """Serve the page of a scene until Ctrl-C.

    Args:
        port: see `serve`.
        opened: likewise.
        set_up: called by the thread of the session before it reads.
    """
    live = Live(path, set_up)
    frames = Frames(live)
    live.changed = frames.changed
    add_routes(app, live, frames)
    serve(path.name, ScenePage, live, port, opened)


class ScenePage(Page):
    """The widgets of one page, and the scene that they show."""

    def __init__(self, live: Live):
        """Nothing is built yet."""
        super().__init__(live)
        self.live = live
        self.shown: object = None
        self.place: list[float] = []

    def ready(self) -> None:
        """What there is once the scene is compiled."""
        self.wall = Wall().style(
            "width:calc(100vw - 420px);height:calc(100vh - 24px);min-width:480px"
        )
        self.wall.on("lost", lambda e: self.lost(e.args))
        with ui.column().style("width:376px;gap:6px"):
            several = MORE_KEYS if self.live.tools > 1 else ""
            ui.label(KEYS + several).style("font-size:12px;color:#555")
            for note in self.live.handled.notes if self.live.handled else ():
                ui.label(note).style("font-size:12px;color:#555")
            self.position()
            self.chart = ui.echart(
                {"animation": False, "color": COLOURS,
                 "grid": {"left": 56, "right": 16, "top": 28, "bottom": 40},
                 "xAxis": {"type": "value", "name": "depth of the tool below the rest wall [mm]",
                           "nameLocation": "middle", "nameGap": 24},
                 "yAxis": {"type": "value", "name": "|F| [N]"},
                 "legend": {"show": self.live.tools > 1, "top": 0},
                 "series": [{"type": "line", "showSymbol": False, "data": [], "name": name}
                            for name in self.live.handled.names]}
            ).style("height:210px;width:370px")  # fmt: skip
            with ui.row().style("gap:6px"):
                ui.button("clear", on_click=self.clear).props(SMALL)
                ui.button("CSV", on_click=self.save_curve).props(SMALL)
                self.recorder = ui.button("record", on_click=self.record)
                self.recorder.props(f"{SMALL} id=record")
            self.widgets = [self.slider(s) for s in self.live.sliders]
            if self.live.sliders:
                ui.button("values as TOML", on_click=self.save_values).props(f"{SMALL} id=toml")

    def position(self) -> None:
        """Three numbers to type, which follow the tool in hand, and the way back to the start."""
        with ui.row().style("gap:6px;align-items:center;flex-wrap:nowrap"):
            self.boxes = [
                ui.number(f"{axis} [mm]", format="%.3f", min=-1e3, max=1e3)
                .style("width:76px").props(f"dense id=place-{axis}")
                for axis in "xyz"
            ]  # fmt: skip

            def go() -> None:
                typed = [float(box.value) for box in self.boxes if box.value is not None]
                if len(typed) == 3:
                    self.wall.run_method("place", *typed)

            ui.button("go", on_click=go).props(f"{SMALL} id=go")
            ui.button("reset", on_click=self.reset).props(f"{SMALL} id=reset")

    def slider(self, s: Any):
        """A slider over the shares 0 to 1, with the value beside it."""
        with ui.row().style("width:100%;gap:8px;align-items:center;flex-wrap:nowrap"):
            ui.label(s.name).style("width:52px").tooltip(s.description)
            value = ui.label(f"{s.value:.4g} {s.unit}").style(
                "width:112px;order:3;white-space:nowrap;font-size:12px"
            )

            def change(share: float) -> None:
                self.live.set_value(s.name, s.at(share))
                value.set_text(f"{s.at(share):.4g} {s.unit}")

            return ui.slider(
                min=0,
                max=1,
                step=0.002,
                value=s.share,
                on_change=lambda e: change(float(e.value or 0)),
            ).props(f"id=value-{s.name}")

    def reset(self) -> None:
        """The start again: tool, values and what the session remembers."""
        for widget, s in zip(self.widgets, self.live.sliders, strict=True):
            widget.set_value(s.share)
        self.live.reset()
        self.wall.run_method("posed", self.live.handled.poses.ravel().tolist())

    def clear(self) -> None:
        """Begin the curve anew."""
        self.live.steps.clear()
        self.shown = None
        self.draw()

    def draw(self) -> None:
        """Where the tool is, and force over depth of the last steps that have a force."""
        frame = self.live.frame
        if frame is None or frame is self.shown:
            return
        self.shown = frame
        place = [float(v) for v in frame.touches[self.live.in_hand].pose[9:]]
        if place != self.place:
            for box, v in zip(self.boxes, place, strict=True):
                box.set_value(v)
            self.place = place
        for k, series in enumerate(self.chart.options["series"]):
            touches = [f.touches[k] for f in self.live.steps[-300:] if f.has_force(k)]
            series["data"] = [[t.depth, float((t.force**2).sum() ** 0.5)] for t in touches]
        self.chart.update()

    def save_curve(self) -> None:
        """The steps as CSV."""
        text = io.StringIO()
        rows = csv.writer(text)
        rows.writerow(["time_s", "tool", "x_mm", "y_mm", "z_mm", "depth_mm",
                       "force_x_N", "force_y_N", "force_z_N", "status"])  # fmt: skip
        for f in self.live.steps:
            for k, (name, t) in enumerate(zip(self.live.handled.names, f.touches, strict=True)):
                # No force is an empty cell, never a zero.
                numbers = [*t.pose[9:], t.depth, *t.force] if f.has_force(k) else t.pose[9:]
                cells = [f"{v:.9g}" for v in numbers] + [""] * (7 - len(numbers))
                rows.writerow([f"{f.time:.9g}", name, *cells, t.status.name])
        ui.download.content(text.getvalue(), "curve.csv", "text/csv")

    def save_values(self) -> None:
        """The scene file with the values of the sliders."""
        from jaxtrachea.viewer.values import with_values

        try:
            new = with_values(self.live.path.read_text("utf-8-sig"), self.live.values)
        except (OSError, ValueError) as error:
            ui.notify(str(error), type="warning", multi_line=True)
            return
        ui.download.content(new, self.live.path.name, "text/plain")

    def record(self) -> None:
        """Begin a recording, or end it and save it as one page that plays by itself."""
        live = self.live
        if live.recording is None:
            live.recording = []
            self.recorder.set_text("end and save")
            return
        frames, live.recording = live.recording, None
        self.recorder.set_text("record")
        if not any(f.vertices is not None for f in frames):
            ui.notify("nothing was recorded: no step with a surface", type="warning")
            return
        from jaxtrachea.viewer.play import of_frames

        page = of_frames(live.handled, frames)
        ui.download.content(page, "play.html", "text/html")

    def lost(self, code: object) -> None:
        """Say why the frames have stopped."""
        self.timer.deactivate()
        self.slow_timer.deactivate()
        why = "this scene is open in another page; reload to go on here"
        if str(code) != "4409":
            why = "the connection is lost; reload, or start jaxtrachea view again"
        self.status.set_text(why)
        self.status.set_visibility(True)
