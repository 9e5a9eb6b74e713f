"""viser's server: started where a person asked for it, and without its own words."""

from __future__ import annotations

import io
import socket
from contextlib import redirect_stdout

import viser


def start_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Serve at this very port, or at any free one for 0.

    Args:
        host: Address.
        port: viser alone would take the next one if it was taken.
        label: Title of the page.

    Raises:
        ValueError: Another program has the port, or it cannot be had.
    """
    found = _free_port(host, port)
    with redirect_stdout(io.StringIO()):  # standard output is the caller's
        return viser.ViserServer(host, found, label=label, verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Close a server."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _free_port(host: str, port: int) -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            raise ValueError(
                f"port: {host}:{port} cannot be had ({why}); is another viewer open? Close it or "
                "give another --port"
            ) from None
        return int(probe.getsockname()[1])
