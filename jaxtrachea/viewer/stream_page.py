"""The page of an experiment: estimates and their intervals over the samples, the next place."""

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import ui

from jaxtrachea.viewer.serve import SMALL, Page, serve
from jaxtrachea.viewer.stream import Experiment, Stream

__all__ = ["serve_stream"]

#: Points of a line at most.
MOST_POINTS = 400
#: Ratio of the ends of an axis from which on it is logarithmic, and labels of ends that are uneven.
WIDE, NO_ENDS = 30, {"showMinLabel": False, "showMaxLabel": False}
#: Samples a second.
SPEEDS = {1: "1 a second", 10: "10 a second", 100: "100 a second", 1e6: "as fast as it goes"}
ORDERS = {False: "as recorded", True: "as proposed"}
LINES = "Dark: estimate; orange: ends of the 95 % interval; dotted: a new press, and its place."
COLUMNS = ("parameter", "estimate", "95 % interval", "verdict")


def serve_stream(
    name: str,
    make: Callable[[Callable[[str], None]], Experiment],
    port: int,
    opened: Callable[[str], None],
) -> None:
    """Serve the page of an experiment until Ctrl-C."""
    serve(name, StreamPage, Stream(name, make), port, opened)


class StreamPage(Page):
    """The widgets of one page, and the experiment that they show."""

    def __init__(self, stream: Stream):
        """Nothing is built yet."""
        super().__init__(stream)
        self.stream = stream
        self.shown = -1

    def ready(self) -> None:
        """Buttons, the table, and a chart for each unknown."""
        stream = self.stream
        with ui.column().style("width:100%;gap:8px"):
            with ui.row().style("gap:8px;align-items:center"):
                self.button = ui.button("play", on_click=self.toggle).props(f"{SMALL} id=play")
                ui.button("one sample", on_click=stream.step).props(f"{SMALL} id=step")
                self.choice("samples", SPEEDS, stream.speed, stream.pace).props("id=speed")
                self.choice("presses", ORDERS, stream.proposed, stream.choose).props("id=order")
            self.where = ui.label().props("id=where")
            self.message = ui.label().style("color:#a04000").props("id=message")
            columns = [{"name": c, "label": c, "field": c, "align": "left"} for c in COLUMNS]
            self.table = ui.table(columns=columns, rows=[]).props("dense id=estimates")
            ui.label(LINES).style("font-size:12px;color:#555")
            with ui.row().style("gap:12px"):
                self.charts = [self.chart(label) for label in self.labels()]
        self.draw()

    def labels(self) -> list[str]:
        """Name and unit of every unknown."""
        experiment = self.stream.experiment
        assert experiment is not None
        names = experiment.online.state.names
        return [f"{n} [{experiment.units[n]}]" if experiment.units[n] else n for n in names]

    def chart(self, label: str) -> ui.echart:
        """Of one unknown: estimate and both ends of its interval."""
        colours = {"estimate": "#1d3557", "low": "#d9782d", "high": "#d9782d"}
        lines = [
            {"name": name, "type": "line", "showSymbol": False, "data": [], "color": colour,
             "lineStyle": {"width": 2 if name == "estimate" else 1}}
            for name, colour in colours.items()
        ]  # fmt: skip
        mark = {"formatter": "{b}", "fontSize": 10, "distance": 8}
        lines[0]["markLine"] = {"symbol": "none", "silent": True, "data": [], "label": mark,
                                "lineStyle": {"color": "#999", "type": "dotted"}}  # fmt: skip
        return ui.echart({
            "animation": False, "title": {"text": label, "textStyle": {"fontSize": 13}},
            "grid": {"left": 64, "right": 16, "top": 52, "bottom": 40},
            "xAxis": {"type": "value", "name": "samples", "nameLocation": "middle", "nameGap": 24},
            "yAxis": {"type": "value"}, "series": lines,
        }).style("height:230px;width:400px")  # fmt: skip

    def toggle(self) -> None:
        """Play, or pause."""
        self.stream.play(not self.stream.playing)

    def choice(self, label: str, words: dict, value: Any, act: Callable[[Any], None]) -> ui.select:
        """One of several, which counts at once."""
        box = ui.select(words, label=label, value=value, on_change=lambda e: act(e.value))
        return box.props("dense").style("width:150px")

    def draw(self) -> None:
        """What the samples so far tell, where there is a new one."""
        stream, count = self.stream, len(self.stream.states)
        self.button.set_text("pause" if stream.playing else "play")
        self.button.set_enabled(not stream.done)
        if count == self.shown:
            return
        self.shown = count
        experiment = stream.experiment
        assert experiment is not None
        self.say(experiment)
        state = stream.states[-1] if count else experiment.online.state
        self.message.set_text(state.message)
        self.table.rows = [self.row(experiment.units, state, i) for i in range(len(state.names))]
        self.table.update()
        if count:
            for i, chart in enumerate(self.charts):
                self.draw_lines(chart, stream.states[:count], i)

    def say(self, experiment: Experiment) -> None:
        """Where the experiment stands, and where to press next."""
        stream, state = self.stream, experiment.online.state
        text = f"{state.samples} samples, {state.status.name}; "
        if stream.done:
            text += "all are taken, and the estimate has settled"
        elif stream.presses:
            curve, number = stream.presses[-1][1], len(stream.presses)
            text += f"press {number} of {len(experiment.curves)}: {curve.trial} at {curve.s_c:g} mm"
        else:
            text += f"{len(experiment.curves)} presses are there to be taken"
        self.where.set_text(f"{text}. Most telling next press: s = {state.next_point:.4g} mm")

    def row(self, units: Any, state: Any, i: int) -> dict[str, str]:
        """One unknown of the table."""
        low, value, high = (f"{v[i]:.4g}" for v in (state.low, state.value, state.high))
        unit = units[state.names[i]]
        known = np.isfinite(state.low[i]) and np.isfinite(state.high[i])
        cells = (state.names[i], f"{value} {unit}", f"{low} to {high}" if known else "none",
                 state.verdict[i])  # fmt: skip
        return dict(zip(COLUMNS, cells, strict=True))

    def draw_lines(self, chart: ui.echart, states: list[Any], i: int) -> None:
        """Lines of an unknown; the axis is that of the later half, where the interval is short."""
        rows = np.unique(np.linspace(0, len(states) - 1, min(len(states), MOST_POINTS)).astype(int))
        kept = [states[r] for r in rows]
        lines = np.array([[s.value[i], s.low[i], s.high[i]] for s in kept]).T
        known = np.array([np.isfinite(s.standard_error[i]) for s in kept])
        lines[1:, ~known] = np.nan
        late = lines[:, len(rows) // 2 :]
        low, high = np.nanmin(late), np.nanmax(late)
        kind = "log" if low > 0 and high > WIDE * low else "value"
        if kind == "log":
            low, high = 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high))
        ends = {"min": float(low), "max": float(high)} if high > low else {}
        # Points far outside lie just beyond the ends, above 0 on an axis of logarithms.
        room = (low / 10, high * 10) if kind == "log" else (2 * low - high, 2 * high - low)
        lines = np.clip(lines, *room) if ends else lines
        chart.options["yAxis"] = {"type": kind, "scale": True, "axisLabel": NO_ENDS, **ends}
        for series, line in zip(chart.options["series"], lines, strict=True):
            series["data"] = [[s.samples, float(v) if np.isfinite(v) else None]
                              for s, v in zip(kept, line, strict=True)]  # fmt: skip
        marks = [{"xAxis": n, "name": f"{c.s_c:g} mm"} for n, c in self.stream.presses]
        chart.options["series"][0]["markLine"]["data"] = marks
        chart.update()
