"""A lab's own DBC instead of ours: a mapping file says where each of our signals lives in theirs.

``MappedLink`` puts a translation between the executor, which speaks our protocol, and a link whose
other end speaks the lab's. The meaning stays ours: opcodes, answers, states and units' zero; what
may differ is ids, layout, byte order, names, scales, numbers of enumerations, and whether a frame
carries our CRC and counter.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from muxjax.config import ConfigError, Strict, load_yaml
from muxjax.hardware.codec import DLC, Layout, layouts
from muxjax.hardware.links import Link
from muxjax.hardware.protocol import ESTOP_ID, Frame, frame_crc
from muxjax.robot import Robot
from muxjax.scheduler import Trajectory

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

E2E = frozenset({"Crc", "Counter"})  # written by us, not mapped
E2E_BITS = frozenset(range(12))  # byte 0 and the low nibble of byte 1


class SignalMapping(Strict):
    """Where one of our signals lives: theirs = scale * ours + offset."""

    signal: str
    scale: Annotated[float, Field(description="not 0")] = 1.0
    offset: float = 0.0
    values: dict[int, int] | None = Field(None, description="ours: theirs, of an enumeration")


class MessageMapping(Strict):
    """Where one of our messages lives."""

    message: str
    crc: bool = Field(description="their frames carry our CRC and counter, over their id")
    signals: dict[str, str | SignalMapping] = Field(description="our signal: theirs")
    constant: dict[str, float] = Field({}, description="ours that theirs has not: its value")
    fill: dict[str, float] = Field({}, description="theirs that ours has not: its value")


class MappingConfig(Strict):
    """A mapping file."""

    file_schema: Literal["muxjax/mapping/1"] = Field(alias="schema")
    dbc: str = Field(description="the lab's DBC; its path from the mapping file")
    messages: dict[str, MessageMapping] = Field(description="our message: theirs")
    absent: tuple[str, ...] = Field((), description="our messages that the lab's board never sends")


class _Entry:
    """One message, both ways."""

    def __init__(self, where: str, ours: Layout, theirs: Message, config: MessageMapping) -> None:
        self.ours, self.theirs, self.config = ours, theirs, config
        self.signals = {
            name: SignalMapping(signal=to) if isinstance(to, str) else to
            for name, to in config.signals.items()
        }
        self._back = {
            name: {b: a for a, b in m.values.items()} if m.values else None
            for name, m in self.signals.items()
        }
        self._counter = -1
        self._check(where)

    def _check(self, where: str) -> None:
        ours = self.ours.names - E2E
        given = self.signals.keys() | self.config.constant.keys()
        if unknown := sorted(given - ours):
            raise ConfigError(f"{where}: our {self.ours.name} has no signal {unknown[0]!r}")
        if missing := sorted(ours - given):
            raise ConfigError(f"{where}.signals: our {missing[0]!r} is missing; map it, or give it "
                              "under constant")  # fmt: skip
        if twice := sorted(self.signals.keys() & self.config.constant.keys()):
            raise ConfigError(f"{where}: {twice[0]!r} is both mapped and constant")
        names = {signal.name: signal for signal in self.theirs.signals}
        targets = [m.signal for m in self.signals.values()]
        for target in (*targets, *self.config.fill):
            if target not in names:
                raise ConfigError(f"{where}: their {self.theirs.name} has no signal {target!r}")
        if len(set(targets)) != len(targets):
            raise ConfigError(f"{where}.signals: two of ours go to one of theirs")
        for name, mapped in self.signals.items():
            if mapped.scale == 0:
                raise ConfigError(f"{where}.signals.{name}.scale: must not be 0")
            if mapped.values and len(set(mapped.values.values())) != len(mapped.values):
                raise ConfigError(f"{where}.signals.{name}.values: two of ours are one of theirs")
        if self.theirs.is_multiplexed() or self.theirs.is_container:
            raise ConfigError(f"{where}: their {self.theirs.name} is multiplexed")
        if self.theirs.is_extended_frame or self.theirs.length > DLC:
            raise ConfigError(f"{where}: their {self.theirs.name} is no classic frame of 11 bits")
        if self.config.crc:
            self._check_crc_has_room(where, targets)

    def _check_crc_has_room(self, where: str, targets: Iterable[str]) -> None:
        if self.theirs.length < 2:
            raise ConfigError(f"{where}.crc: {self.theirs.name} has no room for a CRC")
        for target in (*targets, *self.config.fill):
            bits = set(_bits(self.theirs, target))
            if bits & E2E_BITS:
                raise ConfigError(f"{where}.crc: their {target!r} lies in byte 0 or the low "
                                  "nibble of byte 1")  # fmt: skip

    def out(self, data: bytes) -> Frame:
        """Their frame of our message's bytes."""
        values = self.ours.decode(data)
        theirs = {signal.name: 0.0 for signal in self.theirs.signals} | self.config.fill
        for name, mapped in self.signals.items():
            value = values[name]
            if mapped.values is not None:
                value = mapped.values.get(int(value), value)
            theirs[mapped.signal] = mapped.scale * value + mapped.offset
        coded = bytearray(self.theirs.encode(theirs, strict=False))
        if self.config.crc:
            coded[1] = coded[1] & 0xF0 | int(values["Counter"])
            coded[0] = frame_crc(self.theirs.frame_id, coded)
        return Frame(self.theirs.frame_id, bytes(coded))

    def back(self, data: bytes) -> Frame | None:
        """Our frame of theirs; None for one that is broken."""
        is_estop = self.ours.id == ESTOP_ID
        if len(data) != self.theirs.length:
            return Frame(ESTOP_ID, b"") if is_estop else None
        if self.config.crc and not is_estop and data[0] != frame_crc(self.theirs.frame_id, data):
            return None
        theirs = self.theirs.decode_simple(data, decode_choices=False)
        values = dict(self.config.constant)
        for name, mapped in self.signals.items():
            value = (float(theirs[mapped.signal]) - mapped.offset) / mapped.scale  # type: ignore[arg-type]
            back = self._back[name]
            values[name] = value if back is None else back.get(round(value), value)
        # Without a counter of theirs a repeated frame cannot be told from a new one.
        self._counter = data[1] & 0xF if self.config.crc else (self._counter + 1) & 0xF
        try:
            coded = bytearray(self.ours.encode({**values, "Counter": self._counter}))
        except ValueError:  # a value that our field cannot carry
            return None
        coded[0] = frame_crc(self.ours.id, coded)
        return Frame(self.ours.id, bytes(coded))


class Translation:
    """Our frames to a lab's and back.

    Args:
        path: A mapping file.

    Raises:
        ConfigError: The file, or the DBC that it names, is wrong; the message names the field.
    """

    def __init__(self, path: str | Path) -> None:
        self.config = load_yaml(MappingConfig, Path(path))
        database = _load_dbc(Path(path).parent / self.config.dbc)
        self._out: dict[int, _Entry] = {}
        self._back: dict[int, _Entry] = {}
        by_name = layouts()[0]
        for name, config in self.config.messages.items():
            where = f"{path}: messages.{name}"
            if name not in by_name:
                raise ConfigError(f"{where}: the protocol has no message {name!r}")
            entry = _Entry(where, by_name[name], _message(where, database, config.message), config)
            if entry.theirs.frame_id in self._back:
                raise ConfigError(f"{where}: two of our messages are their {config.message}")
            self._out[entry.ours.id] = self._back[entry.theirs.frame_id] = entry
        missing = sorted(by_name.keys() - self.config.messages.keys() - set(self.config.absent))
        if missing:
            raise ConfigError(
                f"{path}: messages: our {missing[0]} is missing; map it, or list it as absent"
            )
        if unknown := sorted(set(self.config.absent) - by_name.keys()):
            raise ConfigError(f"{path}: absent: the protocol has no message {unknown[0]!r}")

    def out(self, frames: Iterable[Frame]) -> list[Frame]:
        """Their frames of ours; of messages that are absent there are none."""
        return [self._out[f.id].out(f.data) for f in frames if f.id in self._out]

    def back(self, frames: Iterable[Frame]) -> list[Frame]:
        """Our frames of theirs, with our CRC and counter; foreign and broken ones are dropped."""
        known = (self._back[f.id].back(f.data) for f in frames if f.id in self._back)
        return [frame for frame in known if frame is not None]


class MappedLink:
    """A link whose other end speaks a lab's DBC.

    Args:
        link: Carries the lab's frames.
        translation: Between theirs and ours.
    """

    def __init__(self, link: Link, translation: Translation) -> None:
        self.robot: Robot = link.robot
        self.stream_divider: int = link.stream_divider
        self._link, self._translation = link, translation

    @property
    def now(self) -> float:
        """Clock of the link [s]."""
        return self._link.now

    def new_session(self) -> int:
        """As the link's."""
        return self._link.new_session()

    def send(self, frames: Iterable[Frame]) -> None:
        """Put frames on the bus, translated."""
        self._link.send(self._translation.out(frames))

    def wait(self, until: float) -> list[Frame]:
        """Translated frames as soon as some arrive; none by ``until`` [s] or of foreign ones."""
        return self._translation.back(self._link.wait(until))

    def trajectory(self, since: float) -> Trajectory | None:
        """As the link's."""
        return self._link.trajectory(since)


def _load_dbc(path: Path) -> Database:
    import cantools

    try:
        loaded = cantools.database.load_file(str(path))
    except (OSError, cantools.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"dbc: {path} is not readable: {error}") from error
    if not isinstance(loaded, cantools.database.can.Database):
        raise ConfigError(f"dbc: {path} is not a CAN database")
    return loaded


def _message(where: str, database: Database, name: str) -> Message:
    try:
        return database.get_message_by_name(name)
    except KeyError:
        raise ConfigError(f"{where}: the lab's DBC has no message {name!r}") from None


def _bits(message: Message, name: str) -> Iterable[int]:
    """Bits of a signal in the frame, bit 0 the lowest of byte 0."""
    signal = message.get_signal_by_name(name)
    if signal.byte_order == "little_endian":
        return range(signal.start, signal.start + signal.length)
    # Big-endian: from the start downwards in each byte, then on to the next byte's top.
    places: list[int] = []
    at = signal.start
    for _ in range(signal.length):
        places.append(at)
        at = at - 1 if at % 8 else at + 15
    return places
