"""Rates of the page: frames a second, lag, bytes, server time, and the step alone beside them.

    PYTHONPATH=tests/reference python tests/bench/viewer.py [VERTICES ...]

Chromium draws by software here (SwiftShader) unless the flags of `browser` are changed: its rates
are a lower bound. The server and the browser share the processor.
"""

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from browser import Browser
from websockets.sync.client import connect

SCENE = """title = "rates"
[trachea]
around = {around}
along = {along}
[material]
EI_L = "1.862 N mm^2"
EA_L = "3.9 N"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
[tool]
shape = "sphere"
radius = "5 mm"
[[path]]
start = ["60 mm", "18 mm", "0 mm"]
end = ["60 mm", "16 mm", "0 mm"]
"""
SIZES = {3430: (35, 97), 100_000: (250, 399)}
#: Poses as fast as a screen asks for them; what was drawn of them, and the lag of single ones.
RATE = """(async () => {
  const s = trachea.stats, a = { ...s }, t = performance.now();
  await new Promise((done) => {
    const k = setInterval(() => {
      const now = performance.now() - t;
      trachea.place(60 + 5 * Math.sin(now / 300), 16, 0);
      if (now > 4000) { clearInterval(k); done(); }
    }, 16);
  });
  const seconds = (performance.now() - t) / 1000, lags = [];
  const rates = [(s.frames - a.frames) / seconds, (s.drawn - a.drawn) / seconds];
  await new Promise((r) => setTimeout(r, 500));
  for (let i = 0; i < 20; i++) {
    const n = s.frames, begin = performance.now();
    trachea.place(60, 15.5 + 0.5 * (i % 2), 0);
    while (s.frames === n) await new Promise((r) => setTimeout(r, 1));
    await new Promise((r) => requestAnimationFrame(r));
    lags.push(performance.now() - begin);
  }
  return { rates, lag: lags.sort((x, y) => x - y)[10], bytes: s.bytes };
})()"""


def measure(vertices):
    """One row: all rates of a tube of so many vertices (lids included)."""
    around, along = SIZES[vertices]
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Browser()) as window:
        scene = Path(folder) / "rates.toml"
        scene.write_text(SCENE.format(around=around, along=along))
        command = [sys.executable, "-m", "jaxtrachea", "view", str(scene), "--no-browser"]
        begin = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as server:
            try:
                address = re.search(r"http\S+", server.stdout.readline())[0]
                row = {"address": time.perf_counter() - begin}
                return row | with_browser(window, address, begin) | without(address)
            finally:
                server.terminate()


def with_browser(window, address, begin):
    window.go(address)
    window.wait("document.querySelector('#status')?.innerText")
    up = time.perf_counter() - begin
    window.wait("window.trachea?.last", 900)
    found = window.run(RATE)
    return {"page up": up, "scene": time.perf_counter() - begin,
            "frames / s": found["rates"][0], "drawn / s": found["rates"][1],
            "lag ms": found["lag"], "bytes": found["bytes"]}  # fmt: skip


def without(address):
    """Server time a frame, from pose to the last byte, and the step in it, ms."""
    port, token = re.search(r":(\d+)/\?token=(\S+)", address).groups()
    own = f"http://127.0.0.1:{port}"
    whole, steps = [], []
    with connect(f"ws://127.0.0.1:{port}/frames?token={token}", origin=own, proxy=None,
                 max_size=None, compression=None) as link:  # fmt: skip
        link.recv()
        for i in range(200):
            pose = [1, 0, 0, 0, 1, 0, 0, 0, 1, 60, 15.5 + 0.01 * (i % 2), 0]
            begin = time.perf_counter()
            link.send('"drawn"')
            link.send(json.dumps({"tool": 0, "pose": pose}))
            head = np.frombuffer(link.recv()[:40], np.float32)
            whole.append(1e3 * (time.perf_counter() - begin))
            steps.append(float(head[1]))
    return {"server ms": float(np.median(whole)), "step ms": float(np.median(steps))}


if __name__ == "__main__":
    for vertices in map(int, sys.argv[1:] or SIZES):
        print(vertices, json.dumps({k: round(v, 3) for k, v in measure(vertices).items()}))
