"""`jaxtrachea view SCENE`; prints a line for each program that XLA compiles."""

import sys

import jax
from compilations import EVENT

from jaxtrachea.cli.main import main


def note(event, *_, **__):
    if event == EVENT:
        print("compiled", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(note)
    sys.argv[1:] = ["view", sys.argv[1], "--no-browser"]
    main()
