"""`jaxtrachea view SCENE`; prints a line for each program that XLA compiles.

In the place of a browser it prints whether one would find the page.
"""

import socket
import sys
from urllib.parse import urlsplit

import jax
from compilations import EVENT

from jaxtrachea.cli import view
from jaxtrachea.cli.main import main


def note(event, *_, **__):
    if event == EVENT:
        print("compiled", flush=True)


def browse(address):
    try:
        socket.create_connection(("127.0.0.1", urlsplit(address).port), timeout=10).close()
        print("page found", flush=True)
    except OSError as error:
        print(f"no page: {error}", flush=True)
    return True


if __name__ == "__main__":
    view._open = browse
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(note)
    sys.argv[1:] = ["view", sys.argv[1]]
    main()
