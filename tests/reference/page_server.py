"""A page of `jaxtrachea view` in a process of its own."""

import contextlib
import http.client
import os
import re
import signal
import subprocess
import sys
import threading
import time

from websockets.sync.client import connect


class Server:
    """A page in a process of its own; `lines`: what it has printed."""

    def __init__(self, *arguments):
        """Start it, and wait for its address."""
        command = [sys.executable, *map(str, arguments)]
        env = {k: v for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST"}
        self.lines = []
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        end = time.monotonic() + 400
        while not (found := self._address()):
            assert time.monotonic() < end, self.lines
            time.sleep(0.05)
        self.address, self.port, self.token = found.group(0), int(found[1]), found[2]

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait(30)
        self._reader.join()
        self.process.stdout.close()

    def _address(self):
        return re.search(r"http://127\.0\.0\.1:(\d+)/\?token=(\S+)", "".join(self.lines))

    @property
    def compiled(self):
        return self.lines.count("compiled\n")

    def get(self, path, **heads):
        """Status and headers of a request."""
        heads = {"Host": f"127.0.0.1:{self.port}", **heads}
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        link.putrequest("GET", path, skip_host=True)
        for name, value in heads.items():
            if value is not None:
                link.putheader(name.replace("_", "-"), value)
        link.endheaders()
        with contextlib.closing(link), link.getresponse() as answer:
            return answer.status, answer.read(), dict(answer.getheaders())

    def socket(self, path="/frames", origin="own", token=None):
        own = f"http://127.0.0.1:{self.port}"
        mark = "&" if "?" in path else "?"
        token = self.token if token is None else token
        return connect(
            f"ws://127.0.0.1:{self.port}{path}{mark}token={token}", proxy=None,
            origin=own if origin == "own" else origin, compression=None, ping_interval=None,
        )  # fmt: skip
