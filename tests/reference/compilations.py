"""Programs that XLA compiles while something runs."""

import contextlib

import jax

EVENT = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def compilations():
    """The programs compiled within, as a list that grows."""
    counted = []

    def listen(event, duration, **_):
        if event == EVENT:
            counted.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield counted
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
