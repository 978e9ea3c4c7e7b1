"""A page on 127.0.0.1: its server, and the line that says where its work stands."""

import secrets
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from nicegui import app, ui
from nicegui.server import Server

from jaxtrachea.viewer.server import Guard
from jaxtrachea.viewer.worker import Worker

#: Properties of a small button.
SMALL = "dense no-caps size=sm padding='3px 8px'"


class Page(ABC):
    """One page, and the work that it shows; `ready` builds what there is once that is prepared."""

    def __init__(self, worker: Any):
        """Nothing is built yet."""
        self.worker = worker
        self.phase = ""

    def build(self) -> None:
        """The page as it is now; it follows the work by a timer."""
        ui.run_javascript("history.replaceState(null, '', '/')")
        ui.query(".nicegui-content").style("padding:8px")
        self.status = ui.label().style("font-size:16px").mark("status").props("id=status")
        self.body = ui.row().style("width:100%;flex-wrap:nowrap;gap:12px")
        self.timer = ui.timer(0.1, self.follow)
        self.slow_timer = ui.timer(0.4, self.follow_slowly)
        self.follow()

    def follow(self) -> None:
        """Show the phase, and what is wrong."""
        state = self.worker.state
        text = state.text
        if state.phase == "ready":
            text = self.worker.fault
        elif not text.startswith(state.phase):
            text = f"{state.phase}: {text}"
        self.status.set_text(text)
        self.status.set_visibility(bool(text))
        if state.phase == "ready" and self.phase != "ready":
            with self.body:
                self.ready()
        self.phase = state.phase

    def follow_slowly(self) -> None:
        """Draw what would slow the page if it were drawn as often."""
        if self.phase == "ready":
            self.draw()

    @abstractmethod
    def ready(self) -> None:
        """What there is once the work is prepared."""

    @abstractmethod
    def draw(self) -> None:
        """Charts as they are now."""


def serve(
    title: str, page: type[Page], worker: Worker, port: int, opened: Callable[[str], None]
) -> None:
    """Serve a page until Ctrl-C.

    Args:
        title: of its window.
        page: made anew whenever it is opened.
        worker: that it shows; begun with the server.
        port: that is free.
        opened: called with the address when the page can be opened.
    """
    token = secrets.token_urlsafe(24)
    app.add_middleware(Guard, port=port, token=token)
    ui.page("/", title=f"{title} - jaxtrachea")(lambda: page(worker).build())

    def tell() -> None:
        while not Server.instance.started:
            time.sleep(0.01)
        opened(f"http://127.0.0.1:{port}/?token={token}")

    def started() -> None:  # the server listens only after it
        threading.Thread(target=tell, name="address", daemon=True).start()
        worker.start()

    app.on_startup(started)
    app.on_shutdown(worker.end)
    ui.run(
        host="127.0.0.1", port=port, show=False, reload=False, tailwind=False, favicon="🫁",
        show_welcome_message=False, gzip_middleware_factory=None, ws_max_size=2**16,
        reconnect_timeout=30,  # a page that draws slowly is not a page that has gone
    )  # fmt: skip
