"""The page: the view, the curve, the sliders; and the server that runs it."""

import csv
import io
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import app, ui
from nicegui.element import Element
from nicegui.elements.scene.scene import Scene as _Scene  # registers the module that holds three.js

from jaxtrachea.viewer.live import Live
from jaxtrachea.viewer.server import Frames, Guard, add_routes

__all__ = ["serve"]

_ = _Scene
KEYS = (
    "drag the tool, or click the wall to press there. Arrows: along x and y; page up and down: z; "
    "shift: a tenth. Q E, A D, W S turn the tool about x, y, z."
)


class Wall(Element, component="wall.js"):
    """The view of the scene."""


def serve(path: Path, port: int, opened: Callable[[str], None], set_up: Callable[[], None]) -> None:
    """Serve the page of a scene on 127.0.0.1 until Ctrl-C.

    Args:
        path: of the scene file.
        port: that is free.
        opened: called with the address when the page can be opened.
        set_up: called by the thread of the session before it reads.
    """
    token = secrets.token_urlsafe(24)
    live = Live(path, set_up)
    frames = Frames(live)
    live.changed = frames.changed
    app.add_middleware(Guard, port=port, token=token)
    add_routes(app, live, frames)
    ui.page("/", title=f"{path.name} - jaxtrachea")(lambda: Page(live).build())

    def started() -> None:
        opened(f"http://127.0.0.1:{port}/?token={token}")
        live.start()

    app.on_startup(started)
    app.on_shutdown(live.end)
    ui.run(
        host="127.0.0.1", port=port, show=False, reload=False, tailwind=False, favicon="🫁",
        show_welcome_message=False, gzip_middleware_factory=None, ws_max_size=2**16,
        reconnect_timeout=30,  # a page that draws slowly is not a page that has gone
    )  # fmt: skip


class Page:
    """The widgets of one page, and the scene that they show."""

    def __init__(self, live: Live):
        """Nothing is built yet."""
        self.live = live
        self.phase = ""
        self.shown: object = None

    def build(self) -> None:
        """The page as it is now; it follows the work by a timer."""
        ui.run_javascript("history.replaceState(null, '', '/')")
        ui.query(".nicegui-content").style("padding:8px")
        self.status = ui.label().style("font-size:16px").mark("status").props("id=status")
        self.body = ui.row().style("width:100%;flex-wrap:nowrap;gap:12px")
        self.timer = ui.timer(0.1, self.follow)
        self.curve_timer = ui.timer(0.4, self.follow_curve)
        self.follow()

    def follow(self) -> None:
        """Show the phase, and what is new since the last call."""
        state, live = self.live.state, self.live
        text = state.text
        if state.phase == "ready":
            text = live.fault
        elif not text.startswith(state.phase):
            text = f"{state.phase}: {text}"
        self.status.set_text(text)
        self.status.set_visibility(bool(text))
        if state.phase == "ready" and self.phase != "ready":
            with self.body:
                self.ready()
        self.phase = state.phase

    def follow_curve(self) -> None:
        """Draw the curve where there is a new frame; more often it would slow the view."""
        if self.phase == "ready" and self.live.frame is not self.shown:
            self.shown = self.live.frame
            self.draw_curve()

    def ready(self) -> None:
        """What there is once the scene is compiled."""
        self.wall = Wall().style(
            "width:calc(100vw - 420px);height:calc(100vh - 24px);min-width:480px"
        )
        self.wall.on("lost", lambda e: self.lost(e.args))
        with ui.column().style("width:376px;gap:6px"):
            ui.label(KEYS).style("font-size:12px;color:#555")
            for note in self.live.handled.notes if self.live.handled else ():
                ui.label(note).style("font-size:12px;color:#555")
            self.position()
            self.chart = ui.echart(
                {"animation": False, "grid": {"left": 56, "right": 16, "top": 28, "bottom": 40},
                 "xAxis": {"type": "value", "name": "depth of the tool below the rest wall [mm]",
                           "nameLocation": "middle", "nameGap": 24},
                 "yAxis": {"type": "value", "name": "|F| [N]"},
                 "series": [{"type": "line", "showSymbol": False, "data": []}]}
            ).style("height:210px;width:370px")  # fmt: skip
            with ui.row().style("gap:6px"):
                ui.button("clear", on_click=self.clear).props(
                    "dense no-caps size=sm padding='3px 8px'"
                )
                ui.button("CSV", on_click=self.save_curve).props(
                    "dense no-caps size=sm padding='3px 8px'"
                )
                self.recorder = ui.button("record", on_click=self.record)
                self.recorder.props("dense no-caps size=sm padding='3px 8px' id=record")
            self.widgets = [self.slider(s) for s in self.live.sliders]
            if self.live.sliders:
                ui.button("values as TOML", on_click=self.save_values).props(
                    "dense no-caps size=sm padding='3px 8px' id=toml"
                )

    def position(self) -> None:
        """Three numbers to type, and the way back to the start."""
        start = self.live.start_pose[9:]
        with ui.row().style("gap:6px;align-items:center;flex-wrap:nowrap"):
            boxes = [
                ui.number(f"{axis} [mm]", value=float(v), format="%.3f", min=-1e3, max=1e3)
                .style("width:76px").props(f"dense id=place-{axis}")
                for axis, v in zip("xyz", start, strict=True)
            ]  # fmt: skip

            def go() -> None:
                typed = [float(box.value) for box in boxes if box.value is not None]
                if len(typed) == 3:
                    self.wall.run_method("place", *typed)

            ui.button("go", on_click=go).props("dense no-caps size=sm padding='3px 8px' id=go")
            ui.button("reset", on_click=self.reset).props(
                "dense no-caps size=sm padding='3px 8px' id=reset"
            )

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
        self.wall.run_method("posed", self.live.start_pose.tolist())

    def clear(self) -> None:
        """Begin the curve anew."""
        self.live.steps.clear()
        self.draw_curve()

    def draw_curve(self) -> None:
        """Force over depth of the last steps that have a force."""
        data = [[f.depth, float((f.force**2).sum() ** 0.5)] for f in self.live.steps[-300:]
                if f.has_force]  # fmt: skip
        self.chart.options["series"][0]["data"] = data
        self.chart.update()

    def save_curve(self) -> None:
        """The steps as CSV."""
        text = io.StringIO()
        rows = csv.writer(text)
        rows.writerow(["x_mm", "y_mm", "z_mm", "depth_mm", "force_x_N", "force_y_N", "force_z_N",
                       "status"])  # fmt: skip
        for f in self.live.steps:
            numbers = [*f.pose[9:], f.depth, *f.force]
            # No force is an empty cell, never a zero.
            cells = [f"{v:.9g}" for v in (numbers if f.has_force else numbers[:3])]
            rows.writerow([*cells, *[""] * (7 - len(cells)), f.status.name])
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

        page = of_frames(live.handled.staged.scene, live.handled.title, frames)
        ui.download.content(page, "play.html", "text/html")

    def lost(self, code: object) -> None:
        """Say why the frames have stopped."""
        self.timer.deactivate()
        self.curve_timer.deactivate()
        why = "this scene is open in another page; reload to go on here"
        if str(code) != "4409":
            why = "the connection is lost; reload, or start jaxtrachea view again"
        self.status.set_text(why)
        self.status.set_visibility(True)
