"""A virtual board in real time, at the other end of a bus of its own process.

Stock python-can clients connect to both wires: ``socketcand`` over TCP on this machine, and
``slcan`` over a pseudo-terminal, as over the paper's USB serial. What is delayed, lost or refused
on a real bus between the two is not modelled here; TCP and a pty lose nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Protocol

from muxjax.hardware.codec import layouts
from muxjax.hardware.links import receive_frames, send_frames
from muxjax.hardware.pauses import no_long_pauses
from muxjax.hardware.protocol import DLC, Frame
from muxjax.hardware.virtual_board import VirtualBoard

if TYPE_CHECKING:
    import can

LOOPBACK = "127.0.0.1"
QUIET_S = 0.1  # after "rawmode": python-can takes whatever follows the "ok" for a wrong answer
BACKLOG_BYTES = 1 << 20  # a client that reads nothing for so long is let go
LINE_BYTES = 256  # no command of either protocol is longer
LOOK_S = 0.01  # how often ``until`` is asked


class Wire(Protocol):
    """The board's end of a bus."""

    def receive(self, timeout: float) -> list[Frame]:
        """Frames as soon as some arrive; none after ``timeout`` [s]."""

    def send(self, frames: Iterable[Frame]) -> None:
        """Put frames on the bus."""

    def close(self) -> None:
        """Leave the bus."""


def serve(board: VirtualBoard, wire: Wire, until: Callable[[], bool]) -> None:
    """Be the board at the end of a wire, in real time, until ``until()`` says so."""
    layouts()  # reading the DBC takes a moment, for which no host should have to wait
    begin = time.monotonic()
    with no_long_pauses():
        while not until():
            now = time.monotonic() - begin
            frames = wire.receive(max(0.0, min(board.next_time - now, LOOK_S)))
            wire.send(board.step(time.monotonic() - begin, frames))


class BusWire:
    """Any python-can bus; the caller closes it."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def receive(self, timeout: float) -> list[Frame]:
        """As ``Wire.receive``."""
        return receive_frames(self._bus, timeout)

    def send(self, frames: Iterable[Frame]) -> None:
        """As ``Wire.send``."""
        send_frames(self._bus, frames)

    def close(self) -> None:
        """The bus is the caller's."""


class _Client:
    """One connection to a socketcand server."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.heard = b""
        self.to_send = b"< hi >"
        self.raw_from: float | None = None  # when it may be sent frames; None: not yet asked


class SocketcandWire:
    """A socketcand server on the loopback address, for any number of clients.

    Every client hears the board and the other clients, as on one bus.

    Args:
        port: TCP port; 0 for any free one.

    Attributes:
        port: The port that is served.
    """

    def __init__(self, port: int = 0) -> None:
        self._server = socket.create_server((LOOPBACK, port))
        self._server.setblocking(False)
        self.port: int = self._server.getsockname()[1]
        self._clients: list[_Client] = []
        self._begin = time.monotonic()

    def receive(self, timeout: float) -> list[Frame]:
        """As ``Wire.receive``; serves the connections on the way."""
        sockets = [self._server, *(c.connection for c in self._clients)]
        waiting = [c.connection for c in self._clients if c.to_send]
        readable, writable, _ = select.select(sockets, waiting, [], timeout)
        if self._server in readable:
            connection, _ = self._server.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients.append(_Client(connection))
        frames = []
        for client in list(self._clients):
            if client.connection in readable:
                heard = self._hear(client)
                frames += heard
                self._tell(heard, [c for c in self._clients if c is not client])
            if client.connection in writable:
                self._flush(client)
        return frames

    def send(self, frames: Iterable[Frame]) -> None:
        """As ``Wire.send``."""
        self._tell(frames, self._clients)

    def close(self) -> None:
        """Hang up on everybody."""
        for client in self._clients:
            client.connection.close()
        self._server.close()

    def _tell(self, frames: Iterable[Frame], clients: Iterable[_Client]) -> None:
        now = time.monotonic()
        lines = [
            f"< frame {frame.id:03X} {now - self._begin:.6f} {frame.data.hex().upper()} >"
            for frame in frames
        ]
        if not lines:
            return
        text = "".join(lines).encode()
        for client in list(clients):
            if client.raw_from is not None and now >= client.raw_from:
                client.to_send += text
                self._flush(client)

    def _flush(self, client: _Client) -> None:
        try:
            sent = client.connection.send(client.to_send)
            client.to_send = client.to_send[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        if len(client.to_send) > BACKLOG_BYTES:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        client.connection.close()
        if client in self._clients:
            self._clients.remove(client)

    def _hear(self, client: _Client) -> list[Frame]:
        try:
            data = client.connection.recv(4096)
            if hasattr(socket, "TCP_QUICKACK"):  # else a client may hold its next frame for 40 ms
                client.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return []
        *lines, client.heard = (client.heard + data).split(b">")
        if len(client.heard) > LINE_BYTES:
            self._drop(client)
            return []
        frames = []
        for line in lines:
            words = line.rpartition(b"<")[2].decode("ascii", "replace").split()
            frame = _sent_frame(words) if words[:1] == ["send"] else None
            if frame is not None and client.raw_from is not None:
                frames.append(frame)
            else:
                client.to_send += self._answer(client, words)
        self._flush(client)
        return frames

    def _answer(self, client: _Client, words: list[str]) -> bytes:
        if words[:1] == ["open"] and len(words) == 2:
            return b"< ok >"
        if words == ["rawmode"]:
            client.raw_from = time.monotonic() + QUIET_S
            return b"< ok >"
        if words == ["echo"]:
            return b"< echo >"
        return b"" if words[:1] == ["send"] else b"< error unknown command >"


def _sent_frame(words: list[str]) -> Frame | None:
    """Frame of ``send ID LEN b b ...``; None if it is none that this protocol uses."""
    try:
        frame_id, length, *data = (int(word, 16) for word in words[1:])
        payload = bytes(data)
    except ValueError:
        return None
    if len(words[1]) != 3 or frame_id > 0x7FF or not len(payload) == length <= DLC:
        return None
    return Frame(frame_id, payload)


class SlcanWire:
    """An slcan adapter at a pseudo-terminal, for one client at a time.

    Attributes:
        path: Where a client opens it as a serial port.
    """

    def __init__(self) -> None:
        import tty

        self._master, self._slave = os.openpty()  # held open: a client may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._heard = b""
        self._open = False

    def receive(self, timeout: float) -> list[Frame]:
        """As ``Wire.receive``; answers the adapter's own commands on the way."""
        if not select.select([self._master], [], [], timeout)[0]:
            return []
        *lines, self._heard = (self._heard + os.read(self._master, 4096)).split(b"\r")
        if len(self._heard) > LINE_BYTES:
            self._heard = b""
        frames = []
        for line in lines:
            if line[:1] == b"t":
                frame = _slcan_frame(line)
                self._write(b"\a" if frame is None else b"\r")
                if frame is not None and self._open:
                    frames.append(frame)
            else:
                self._obey(line)
        return frames

    def send(self, frames: Iterable[Frame]) -> None:
        """As ``Wire.send``; what a client does not read in time is lost, as on a serial line."""
        if self._open:
            lines = (
                f"t{frame.id:03X}{len(frame.data)}{frame.data.hex().upper()}\r" for frame in frames
            )
            for line in lines:
                self._write(line.encode())

    def close(self) -> None:
        """Unplug the adapter."""
        os.close(self._master)
        os.close(self._slave)

    def _obey(self, line: bytes) -> None:
        import termios

        if line[:1] in (b"O", b"L", b"C"):
            self._open = line[:1] != b"C"
            termios.tcflush(self._slave, termios.TCIFLUSH)  # not for whoever was there before
        known = line[:1] in b"OLCSsYV" or line == b""
        self._write(b"V1013\r" if line == b"V" else b"\r" if known else b"\a")

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)


def _slcan_frame(line: bytes) -> Frame | None:
    """Frame of ``tIIILDD...``; None if it is not one."""
    try:
        text = line.decode("ascii")
        frame_id, length, data = int(text[1:4], 16), int(text[4:5]), bytes.fromhex(text[5:])
    except ValueError:
        return None
    return Frame(frame_id, data) if frame_id <= 0x7FF and len(data) == length <= DLC else None
