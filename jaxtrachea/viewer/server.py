"""The server of the page: who may ask, what there is to fetch, and the socket of frames."""

import asyncio
import contextlib
import hmac
import secrets
import socket
from pathlib import Path
from urllib.parse import parse_qs

from fastapi import FastAPI, Response, WebSocket
from starlette.websockets import WebSocketDisconnect

from jaxtrachea.viewer.frame import read_pose
from jaxtrachea.viewer.live import Live

HERE = Path(__file__).parent
#: Codes with which a socket closes: refused, a message that is none, another page took over.
REFUSED, BAD_MESSAGE, TAKEN_OVER = 4403, 4400, 4409


class Guard:
    """Lets requests through that come from the page itself; HTTP and sockets alike (ASGI).

    Host is this server's, Origin (and Sec-Fetch-Site) its own, and the token, from the cookie or
    the address, is compared whole in constant time. A page gets a Content-Security-Policy by which
    it fetches from this server alone and runs no script that this server did not send.
    """

    def __init__(self, app, port: int, token: str):
        """Of a server on 127.0.0.1 at this port."""
        self.app, self.token = app, token.encode()
        self.cookie = f"jaxtrachea-{port}"
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope, receive, send):
        """Answer, or refuse with 403 (a socket: close)."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
        elif not self.allows(scope):
            await _refuse(scope, receive, send)
        elif scope["type"] == "websocket":
            await self.app(scope, receive, send)
        else:
            await self.app(scope, receive, self.sealed(send))

    def allows(self, scope) -> bool:
        """Whether a request comes from the page of this server, or opens it with the token."""
        heads = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        host, origin = heads.get("host"), heads.get("origin")
        if host not in self.hosts:
            return False
        if origin != f"http://{host}" and (origin is not None or scope["type"] == "websocket"):
            return False
        opens = heads.get("sec-fetch-mode") == "navigate" and scope["path"] == "/"
        if not opens and heads.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return False
        query = parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
        parts = (part.strip().partition("=") for part in heads.get("cookie", "").split(";"))
        kept = [value for name, _, value in parts if name == self.cookie]
        return any(hmac.compare_digest(v.encode(), self.token) for v in (*query, *kept))

    def sealed(self, send):
        """`send` with the headers of safety; scripts of a page carry its nonce."""
        nonce, waiting = secrets.token_urlsafe(16), []
        policy = (
            f"default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
            "connect-src 'self'; media-src blob:; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        heads = {
            "set-cookie": f"{self.cookie}={self.token.decode()}; HttpOnly; SameSite=Strict; Path=/",
            "content-security-policy": policy, "referrer-policy": "no-referrer",
            "x-content-type-options": "nosniff", "cross-origin-resource-policy": "same-origin",
        }  # fmt: skip
        added = [(k.encode(), v.encode()) for k, v in heads.items()]

        async def out(message):
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *added]
                if (b"content-type", b"text/html; charset=utf-8") in message["headers"]:
                    waiting.append(message)  # its length changes
                    return
            elif waiting:
                waiting.append(message)
                if message.get("more_body"):
                    return
                body = b"".join(m.get("body", b"") for m in waiting[1:])
                body = body.replace(b"<script", b'<script nonce="%s"' % nonce.encode())
                start, kept = waiting[0], waiting[0]["headers"]
                length = (b"content-length", str(len(body)).encode())
                start["headers"] = [h for h in kept if h[0] != b"content-length"] + [length]
                await send(start)
                message = {"type": "http.response.body", "body": body}
            await send(message)

        return out


async def _refuse(scope, receive, send) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": REFUSED})
        return
    heads = [(b"content-length", b"0")]
    await send({"type": "http.response.start", "status": 403, "headers": heads})
    await send({"type": "http.response.body", "body": b""})


class Frames:
    """The socket of frames: one page at a time, a frame after the page has drawn the last one."""

    def __init__(self, live: Live):
        """Of a scene under a hand; its thread calls `changed`."""
        self.live = live
        self.loop: asyncio.AbstractEventLoop | None = None
        self.event = asyncio.Event()
        self.page: WebSocket | None = None

    def changed(self) -> None:
        """There is a new frame (called by another thread)."""
        if self.loop is not None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                self.loop.call_soon_threadsafe(self.event.set)

    async def serve(self, page: WebSocket) -> None:
        """Poses in, frames out, until the page goes or another one comes."""
        self.loop = asyncio.get_running_loop()
        await page.accept()
        before, self.page = self.page, page
        if before is not None:
            with contextlib.suppress(RuntimeError):  # it had gone by itself
                await before.close(TAKEN_OVER)
        drawn = asyncio.Event()
        drawn.set()
        tasks = [
            asyncio.create_task(self._read(page, drawn)),
            asyncio.create_task(self._write(page, drawn)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self.page = None if self.page is page else self.page

    async def _read(self, page: WebSocket, drawn: asyncio.Event) -> None:
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                try:
                    moved = read_pose(await page.receive_text(), self.live.tools)
                except (ValueError, KeyError, RecursionError):
                    await page.close(BAD_MESSAGE)
                    return
                if moved is None:
                    drawn.set()
                    self.event.set()
                else:
                    tool, pose = moved
                    self.live.move(pose, tool)

    async def _write(self, page: WebSocket, drawn: asyncio.Event) -> None:
        shown = None
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while self.page is page:
                frame = self.live.frame
                if frame is not None and frame is not shown and drawn.is_set():
                    drawn.clear()
                    await page.send_bytes(frame.pack())
                    shown = frame
                    continue
                self.event.clear()
                if self.live.frame is shown or not drawn.is_set():
                    await self.event.wait()


def add_routes(app: FastAPI, live: Live, frames: Frames) -> None:
    """What the page fetches besides itself."""

    @app.get("/core.js")
    def core() -> Response:
        return Response((HERE / "core.js").read_bytes(), media_type="text/javascript")

    @app.get("/scene.bin")
    def scene() -> Response:
        if not live.packet:
            return Response(status_code=503)
        return Response(live.packet, media_type="application/octet-stream")

    app.add_api_websocket_route("/frames", frames.serve)


def free_port(port: int | None) -> int:
    """This port of 127.0.0.1, or without one any that is free.

    Raises:
        OSError: it is taken, or is not for this user.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port or 0))
        return probe.getsockname()[1]
