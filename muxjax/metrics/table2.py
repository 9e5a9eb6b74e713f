"""Every setting of a protocol on the same random targets, and what follows (M Table II)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import TypeAdapter

from muxjax.metrics.program import evaluate, least_time, tip_deviation
from muxjax.metrics.protocol import Protocol, Setting
from muxjax.metrics.statistics import (
    Interval,
    Spread,
    dominated_by,
    median_interval,
    paired_difference,
    spread,
)
from muxjax.planning import plan
from muxjax.robot import Robot
from muxjax.scheduler import schedule

_PAIRED = ("time_s", "stages", "overshoot_duration", "overshoot_peak", "tip_deviation_mm")


@dataclass(frozen=True)
class Record:
    """One setting on one target with one servo set.

    Attributes:
        servos: How many are available.
        setting: Name of the setting.
        time_s: T [s].
        least_time_s: What no program between the same ends can fall below [s].
        stages: Instructions.
        overshoot_duration: Share of T by segment [%].
        overshoot_peak: Relative to the final bending, by segment [%].
        tip_deviation_mm: From the straight line between the tool's first and last position [mm].
        status: Of the plan.
        gap: Certified, of the plan's own cost.
        cpu_s: Of planning [s].
    """

    servos: int
    setting: str
    time_s: float
    least_time_s: float
    stages: int
    overshoot_duration: tuple[float, ...]
    overshoot_peak: tuple[float, ...]
    tip_deviation_mm: float
    status: str
    gap: float
    cpu_s: float


_RECORDS = TypeAdapter(list[Record])


def run_table(
    robot: Robot,
    protocol: Protocol,
    *,
    targets: int,
    seed: int = 0,
    kept: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[list[Record]]:
    """Records of every target, each with all servo sets and settings.

    Args:
        robot: The arm.
        protocol: What is compared.
        targets: How many.
        seed: Of the targets.
        kept: File with a line a target. Targets that it holds already, of the same protocol,
            robot and seed, are not run again; an interrupted run goes on where it was.
        progress: Called after each target with how many are done, of how many.

    Raises:
        ValueError: Fewer than two targets, or ``kept`` holds results of another protocol.
    """
    if targets < 2:
        raise ValueError(f"targets: must be at least 2, found {targets}")
    key = protocol.key(robot, seed)
    records = [] if kept is None else list(_read(kept, key))[:targets]
    for number in range(len(records) + 1, targets + 1):
        goal = protocol.target(robot, seed, number)
        records.append(list(_all_settings(robot, protocol, goal)))
        if kept is not None:
            line = {"key": key, "target": number, "records": [asdict(r) for r in records[-1]]}
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        progress(number, targets)
    return records


def _all_settings(
    robot: Robot, protocol: Protocol, goal: Float[np.ndarray, " SJ"]
) -> Iterator[Record]:
    for servos in protocol.servo_sets:
        for setting in protocol.settings:
            yield _record(robot, protocol, goal, servos, setting)


def _record(
    robot: Robot,
    protocol: Protocol,
    goal: Float[np.ndarray, " SJ"],
    servos: tuple[int, ...],
    setting: Setting,
) -> Record:
    began = time.process_time()
    found = plan(robot, protocol.problem(goal, servos, setting), setting.method)
    spent = time.process_time() - began
    program = schedule(robot, found)
    figures = evaluate(robot, program)
    return Record(
        servos=len(servos),
        setting=setting.name,
        time_s=figures.time_s,
        least_time_s=least_time(robot, program),
        stages=figures.stages,
        overshoot_duration=tuple(100 * x for x in figures.overshoot_duration),
        overshoot_peak=tuple(100 * x for x in figures.overshoot_peak),
        tip_deviation_mm=1e3 * tip_deviation(robot, program),
        status=found.status,
        gap=found.gap,
        cpu_s=spent,
    )


def _read(kept: Path, key: str) -> Iterator[list[Record]]:
    """Records of the targets in a file; a line torn by an interruption is cut off."""
    if not kept.exists():
        return
    text = kept.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        kept.write_text(whole, encoding="utf-8")
    for number, line in enumerate(whole.splitlines(), start=1):
        document = json.loads(line)
        if document["key"] != key or document["target"] != number:
            raise ValueError(
                f"{kept}: line {number} is of another protocol, robot or seed; remove the file or "
                "name another folder"
            )
        yield _RECORDS.validate_python(document["records"])


@dataclass(frozen=True)
class Row:
    """A setting with a servo set, over all targets."""

    servos: int
    setting: str
    time_s: Spread
    stages: Spread
    overshoot_duration: tuple[Spread, ...]  # by segment [%]
    overshoot_peak: tuple[Spread, ...]  # by segment [%]
    tip_deviation_mm: Spread
    over_least_time: Spread  # T over what no program can fall below, minus one [%]
    none_at_all: float  # share of targets without overshoot on any segment [%]
    certified: float  # share of targets with a certified optimum of the setting's cost [%]
    cpu_s: Spread
    dominated_by: list[str]  # settings of theirs that are nowhere worse in ``point``, once better

    @property
    def point(self) -> tuple[float, ...]:
        """What the Pareto comparison weighs, to the table's one decimal.

        Medians of T, and of overshoot duration and peak on every segment.
        """
        medians = (self.time_s, *self.overshoot_duration, *self.overshoot_peak)
        return tuple(round(s.median, 1) for s in medians)


@dataclass(frozen=True)
class Difference:
    """A setting of ours minus one of theirs, paired by target: median and 95 % interval."""

    servos: int
    ours: str
    theirs: str
    time_s: Interval
    stages: Interval
    overshoot_duration: tuple[Interval, ...]
    overshoot_peak: tuple[Interval, ...]
    tip_deviation_mm: Interval


@dataclass(frozen=True)
class SpeedUp:
    """How many times faster more servos are, T over T on the same target."""

    setting: str
    fewer: int
    more: int
    factor: Interval


@dataclass(frozen=True)
class SwitchWeight:
    """BeamStep without its switch penalty, as its distance to the greedy rule (M VI-A4).

    Paired differences to greedy: those of BeamStep with the penalty, and of a variant without.
    """

    servos: int
    variant: str
    time_with: Interval
    time_without: Interval
    stages_with: Interval
    stages_without: Interval


@dataclass(frozen=True)
class Table:
    """All that the comparison says."""

    targets: int
    seed: int
    rows: list[Row]
    differences: list[Difference]
    speed_ups: list[SpeedUp]
    switch_weight: list[SwitchWeight]


class _Columns:
    """Values over targets by servo set and setting."""

    def __init__(self, records: Sequence[Sequence[Record]]) -> None:
        self._by: dict[tuple[int, str], list[Record]] = {}
        for of_target in records:
            for record in of_target:
                self._by.setdefault((record.servos, record.setting), []).append(record)

    def of(self, servos: int, setting: str, field: str) -> np.ndarray:
        """A row a target; by segment where the field is."""
        values = np.array([getattr(r, field) for r in self._by[servos, setting]])
        return values.astype(float) if values.dtype.kind == "i" else values

    def difference(self, servos: int, ours: str, theirs: str, field: str) -> Any:
        """Paired interval, or one a segment."""
        left, right = (self.of(servos, name, field) for name in (ours, theirs))
        if left.ndim == 1:
            return paired_difference(left, right)
        return tuple(paired_difference(a, b) for a, b in zip(left.T, right.T, strict=True))


def summarise(protocol: Protocol, records: Sequence[Sequence[Record]], seed: int) -> Table:
    """Medians, paired intervals and side claims of a run."""
    columns = _Columns(records)
    counts = [len(servos) for servos in protocol.servo_sets]
    rows = [
        _row(columns, n, name)
        for n in counts
        for name in protocol.names("theirs", "ours", "variants")
    ]
    differences = [
        Difference(n, ours, theirs, *(columns.difference(n, ours, theirs, f) for f in _PAIRED))
        for n in counts
        for ours in protocol.names("ours")
        for theirs in protocol.names("theirs")
    ]
    speed_ups = [
        SpeedUp(name, fewer, more, _ratio(columns, name, fewer, more))
        for name in protocol.names("theirs", "ours")
        for fewer, more in pairwise(sorted(set(counts)))
    ]
    return Table(
        targets=len(records),
        seed=seed,
        rows=_with_dominators(rows, protocol.names("theirs")),
        differences=differences,
        speed_ups=speed_ups,
        switch_weight=[
            _switch_weight(protocol, columns, n, variant)
            for n in counts
            for variant in protocol.names("variants")
        ],
    )


def _row(columns: _Columns, servos: int, setting: str) -> Row:
    def of(field: str) -> np.ndarray:
        return columns.of(servos, setting, field)

    over = 100 * (of("time_s") / of("least_time_s") - 1)
    return Row(
        servos=servos,
        setting=setting,
        time_s=spread(of("time_s")),
        stages=spread(of("stages")),
        overshoot_duration=tuple(spread(x) for x in of("overshoot_duration").T),
        overshoot_peak=tuple(spread(x) for x in of("overshoot_peak").T),
        tip_deviation_mm=spread(of("tip_deviation_mm")),
        over_least_time=spread(over),
        none_at_all=100 * float(np.mean((of("overshoot_duration") == 0).all(axis=1))),
        certified=100 * float(np.mean(of("status") == "optimal")),
        cpu_s=spread(of("cpu_s")),
        dominated_by=[],
    )


def _with_dominators(rows: list[Row], theirs: list[str]) -> list[Row]:
    """Rows that name the reruns of the paper's methods by which they are dominated."""
    named = []
    for row in rows:
        rivals = [r for r in rows if r.servos == row.servos and r.setting in theirs]
        points = {r.setting: r.point for r in [*rivals, row]}
        named.append(replace(row, dominated_by=dominated_by(row.setting, points)))
    return named


def _ratio(columns: _Columns, setting: str, fewer: int, more: int) -> Interval:
    slow, fast = (columns.of(n, setting, "time_s") for n in (fewer, more))
    return median_interval(slow / fast)


def _switch_weight(
    protocol: Protocol, columns: _Columns, servos: int, variant: str
) -> SwitchWeight:
    def to_greedy(name: str, field: str) -> Interval:
        difference: Interval = columns.difference(servos, name, protocol.greedy, field)
        return difference

    return SwitchWeight(
        servos=servos,
        variant=variant,
        time_with=to_greedy(protocol.beamstep, "time_s"),
        time_without=to_greedy(variant, "time_s"),
        stages_with=to_greedy(protocol.beamstep, "stages"),
        stages_without=to_greedy(variant, "stages"),
    )
