"""Python's garbage collector must not keep a host or a board from its heartbeat."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_long_pauses() -> Iterator[None]:
    """Leave what is in memory now out of the collector's rounds until the end.

    With JAX loaded a full round takes 130 ms and more, about as long as the watchdog waits.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
