"""The board's wires, spoken to by hand: what is answered, and what must not hurt."""

from __future__ import annotations

import json
import os
import select
import socket
import time

import numpy as np
import pytest

from muxjax.hardware import BusLink
from muxjax.hardware.links import open_bus
from muxjax.hardware.protocol import Frame
from muxjax.hardware.serving import (
    BACKLOG_BYTES,
    QUIET_S,
    SlcanWire,
    SocketcandWire,
)


@pytest.fixture
def tcp():
    wire = SocketcandWire()
    yield wire
    wire.close()


@pytest.fixture
def line():
    wire = SlcanWire()
    yield wire
    wire.close()


def connect(wire: SocketcandWire) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", wire.port))
    client.settimeout(2.0)
    return client


def serve(wire, times: int = 5) -> list[Frame]:
    return [frame for _ in range(times) for frame in wire.receive(0.01)]


def read(port: int, until: bytes) -> bytes:
    """A pty hands over what was written a moment later."""
    data, end = b"", time.monotonic() + 2.0
    while not data.endswith(until) and time.monotonic() < end:
        if select.select([port], [], [], 0.05)[0]:
            data += os.read(port, 1 << 16)
    return data


def raw(wire: SocketcandWire) -> socket.socket:
    client = connect(wire)
    serve(wire)
    assert client.recv(256) == b"< hi >"
    client.sendall(b"< open can0 >")
    serve(wire)
    assert client.recv(256) == b"< ok >"
    client.sendall(b"< rawmode >")
    serve(wire)
    assert client.recv(256) == b"< ok >"
    return client


def test_socketcand_handshake_and_frames_both_ways(tcp):
    client = raw(tcp)
    tcp.send([Frame(0x21, bytes(8))])  # python-can would take it for the answer to rawmode
    time.sleep(QUIET_S)
    tcp.send([Frame(0x31, bytes(range(8)))])
    text = client.recv(256).decode()
    assert text.startswith("< frame 031 ")
    assert text.endswith(" 0001020304050607 >")
    client.sendall(b"< send 030 8 0 1 2 3 a b c d >< send 008 0 >")
    assert serve(tcp) == [Frame(0x30, bytes([0, 1, 2, 3, 10, 11, 12, 13])), Frame(0x8, b"")]


def test_socketcand_in_pieces_and_several_clients_hear_each_other(tcp):
    one, two = raw(tcp), raw(tcp)
    time.sleep(QUIET_S)
    for piece in (b"< se", b"nd 020 2 0", b"1 f", b"f ><"):
        one.sendall(piece)
        frames = serve(tcp, 2)
    assert frames == [Frame(0x20, b"\x01\xff")]
    assert b"< frame 020 " in two.recv(256)
    one.setblocking(False)
    with pytest.raises(BlockingIOError):
        one.recv(256)


@pytest.mark.parametrize(
    "text",
    [
        b"< send 30000000 1 0 >",  # 29 bits
        b"< send 800 0 >",
        b"< send 030 8 1 2 >",
        b"< send 030 9 0 1 2 3 4 5 6 7 8 >",
        b"< send 030 1 100 >",
        b"< send xyz 0 >",
        b"< send >",
        b">>>><<<< >",
        b"< \xff\xfe >",
        b"< statistics 1 >",
        b"< send 030 1 0< send 020 1 zz >",
    ],
)
def test_socketcand_takes_no_frame_from_nonsense_and_lives(tcp, text):
    client = raw(tcp)
    client.sendall(text)
    assert serve(tcp) == []
    client.sendall(b"< send 020 1 5 >")
    assert serve(tcp) == [Frame(0x20, b"\x05")]


def test_socketcand_takes_frames_only_after_the_handshake(tcp):
    client = connect(tcp)
    client.sendall(b"< send 020 1 5 >")
    assert serve(tcp) == []


def test_socketcand_outlives_noise_and_clients_that_vanish_or_do_not_read(tcp):
    noisy, gone, lazy, good = (raw(tcp) for _ in range(4))
    noisy.sendall(np.random.default_rng(1).bytes(4000).replace(b">", b""))
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    gone.close()
    serve(tcp)
    time.sleep(QUIET_S)
    frames = [Frame(0x31, bytes(8))] * 1000
    for _ in range(20 * BACKLOG_BYTES // (1000 * 40)):
        tcp.send(frames)
        while select.select([good], [], [], 0)[0]:
            good.recv(1 << 20)
        tcp.receive(0.0)
    good.sendall(b"< send 020 1 5 >")
    assert serve(tcp) == [Frame(0x20, b"\x05")]
    lazy.sendall(b"< send 020 1 6 >")
    assert serve(tcp) == []


def test_slcan_commands_and_frames(line):
    port = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    answers = {b"C\r": b"\r", b"S8\r": b"\r", b"V\r": b"V1013\r", b"Q\r": b"\a"}
    for command, answer in answers.items():
        os.write(port, command)
        serve(line)
        assert read(port, answer) == answer
    line.send([Frame(0x21, bytes(8))])
    os.write(port, b"t0301AB\r")
    assert serve(line) == []  # not open yet
    os.write(port, b"O\r")
    serve(line)
    line.send([Frame(0x21, bytes([1, 255]))])
    assert read(port, b"t021201FF\r") in (b"\rt021201FF\r", b"\r\rt021201FF\r")
    os.write(port, b"t0301AB\rt008")
    assert serve(line) == [Frame(0x30, b"\xab")]
    os.write(port, b"0\r")
    assert serve(line) == [Frame(0x8, b"")]
    os.close(port)


@pytest.mark.parametrize(
    "text",
    [b"t\r", b"t0302AB\r", b"t030xAB\r", b"tFFF0\r", b"t0309" + b"00" * 9 + b"\r", b"\xff\r"],
)
def test_slcan_takes_no_frame_from_nonsense_and_lives(line, text):
    port = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"O\r" + text)
    assert serve(line) == []
    os.write(port, b"z" * 1000)
    serve(line)
    os.write(port, b"\rt0201FF\r")
    assert serve(line) == [Frame(0x20, b"\xff")]
    os.close(port)


def test_slcan_with_nobody_at_the_port_does_not_block(line):
    line._open = True
    begin = time.monotonic()
    for _ in range(50):
        line.send([Frame(0x21, bytes(8))] * 100)
    assert time.monotonic() - begin < 5.0
    port = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"O\r")
    serve(line)
    assert read(port, b"\r") == b"\r"  # nothing of what was meant for nobody
    os.close(port)


def test_a_corrupt_slcan_line_is_a_lost_frame(line, muxarm):
    pytest.importorskip("serial")
    spec = {"interface": "slcan", "channel": line.path, "sleep_after_open": 0}
    with open_bus(json.dumps(spec)) as bus:
        link = BusLink(bus, muxarm)
        serve(line)
        for text in (b"tZZZ8\r", b"t02\r", b"t0218\xff\r", b"t0212"):
            os.write(line._master, text)
        os.write(line._master, b"xy\r")
        frames, end = [], time.monotonic() + 2.0
        while not frames and time.monotonic() < end:
            line.send([Frame(0x21, bytes([7]))])
            frames += [f for f in link.wait(link.now + 0.02) if f.data == b"\x07"]
        assert frames[0] == Frame(0x21, b"\x07")
        assert link.errors == {"ValueError": 1, "IndexError": 1, "CanOperationError": 1}


def test_a_bus_that_cannot_be_opened_is_named():
    pytest.importorskip("can")
    wrong = (
        "{",
        "no such section",
        '{"interface": "no such"}',
        '{"interface": "socketcan", "channel": "can99"}',
        '{"interface": "virtual", "channel": 1, "x"}',
    )
    for spec in wrong:
        with pytest.raises(ValueError, match=r"^bus: .* cannot be opened"), open_bus(spec):
            pass
