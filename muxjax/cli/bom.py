"""``muxjax bom``: the parts of a robot's drive and what they cost."""

from __future__ import annotations

from rich import box
from rich.table import Column, Table

from muxjax.bom import CostSheet, cost_sheet
from muxjax.cli.output import console, print_json
from muxjax.config import CostConfig, Sourced
from muxjax.robot import load_robot


def bom(robot: str = "muxarm", json: bool = False) -> int:
    """Parts and cost of a drive, beside one actuator for every tendon.

    Example: muxjax bom

    Example: muxjax bom --robot my_arm.yaml --json

    Args:
        robot: Shipped robot or path of a YAML file with a section "cost".
        json: Print JSON; shares from 0 to 1.
    """
    arm = load_robot(robot)
    sheet = cost_sheet(arm)
    stated = arm.config.cost
    assert stated is not None  # else cost_sheet has raised
    if json:
        print_json(_document(arm.config.name, sheet, stated))
    else:
        _print(arm.config.name, sheet, stated)
    return 0


def _document(robot: str, sheet: CostSheet, stated: CostConfig) -> dict[str, object]:
    single = stated.single_actuator
    return {
        "robot": robot,
        "parts": [part.model_dump(mode="json") for part in sheet.parts],
        "single_actuator": single.model_dump(mode="json") | {"count": sheet.single_count},
        "derived": {
            "total_usd": round(sheet.total, 2),
            "motors": sheet.motors,
            "motors_usd": round(sheet.motors_total, 2),
            "single_actuators_usd": round(sheet.single_total, 2),
            "saving": sheet.saving,
            "motors_saving": sheet.motors_saving,
            "fewer_motors": sheet.fewer_motors,
        },
        "stated": {
            name: None if value is None else value.model_dump(mode="json")
            for name, value in _claims(stated).items()
        },
    }


def _claims(stated: CostConfig) -> dict[str, Sourced[float] | None]:
    names = ("total_usd", "saving_percent", "fewer_motors_percent")
    return {name: getattr(stated, name) for name in names}


def _print(robot: str, sheet: CostSheet, stated: CostConfig) -> None:
    table = Table(
        "kind",
        "part",
        Column("count", justify="right"),
        Column("price [USD]", justify="right"),
        "source",
        box=box.SIMPLE_HEAD,
        title=f"Drive of {robot}; prices of all pieces of a line together",
        title_justify="left",
    )
    for part in sheet.parts:
        count = "" if part.count is None else str(part.count)
        source = f"{part.source}, {part.why}"
        table.add_row(part.kind, part.name, count, f"{part.price_usd:.2f}", source)
    table.add_section()
    table.add_row("", "sum", "", f"{sheet.total:.2f}", "derived, of the lines")
    console.print(table)
    single = stated.single_actuator
    against = Table(
        f"beside {sheet.single_count} {sheet.single_name}",
        Column("this drive", justify="right"),
        Column("single", justify="right"),
        Column("less, derived", justify="right"),
        "less, as stated",
        box=box.SIMPLE_HEAD,
    )
    against.add_row(
        "motors",
        str(sheet.motors),
        str(sheet.single_count),
        f"{100 * sheet.fewer_motors:.1f} %",
        _percent(stated.fewer_motors_percent),
    )
    against.add_row(
        "all parts against actuators alone [USD]",
        f"{sheet.total:.2f}",
        f"{sheet.single_total:.2f}",
        f"{100 * sheet.saving:.1f} %",
        _percent(stated.saving_percent),
    )
    against.add_row(
        "motors against actuators [USD]",
        f"{sheet.motors_total:.2f}",
        f"{sheet.single_total:.2f}",
        f"{100 * sheet.motors_saving:.1f} %",
    )
    console.print(against)
    if stated.total_usd is not None:
        console.print(
            f"total as stated: {stated.total_usd.value:.2f} USD "
            f"({stated.total_usd.source}, {stated.total_usd.why})"
        )
    console.print(
        f"one {single.name}: {single.price_usd.value:.2f} USD "
        f"({single.price_usd.source}, {single.price_usd.why})"
    )


def _percent(stated: Sourced[float] | None) -> str:
    return "" if stated is None else f"{stated.value:g} % ({stated.source})"
