"""``muxjax figure``: the MuxArm paper's figures and tables from this model, and the gallery."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import tyro
from rich import box
from rich.table import Table

from muxjax.cli import drawing
from muxjax.cli.drawing import Drawn, Tell
from muxjax.cli.output import choice_of, console, print_json
from muxjax.cli.progress import work_bar
from muxjax.robot import load_robot

Case = Literal[
    "open loop, slip alone",
    "open loop, realistic board",
    "closed loop, slip seen",
    "closed loop, slip not seen",
    "closed loop, no slip",
]
_CASE: Case = "closed loop, slip not seen"  # what the paper says of its arm
_OUT = Path("out/figures")
_RECORDS = Path("out/table2")
_TARGET = 3  # the first that shows what the paper's figure shows; docs/figures.md
_DISPLACEMENTS = (-8.0, 0.0, 8.0, 0.0, -12.0, 0.0, 12.0, 0.0)


def fig6(
    out: Path = _OUT / "fig6.pdf",
    target: int = _TARGET,
    seed: int = 0,
    q_deg: tuple[float, ...] | None = None,
    protocol: str = "table2",
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """M Fig. 6: tendon lengths and bending angles over time, by every planner to one target.

    Example: muxjax figure fig6 --out fig6.pdf

    Example: muxjax figure fig6 --q-deg 70 225 90 45 55 45 --out s_shape.svg

    Args:
        out: File to write: .pdf or .svg (vector), or .png.
        target: Which of the comparison's random targets (muxjax bench table2), from 1.
        seed: Of those targets.
        q_deg: Bending angle (not negative) and azimuth of each segment [degrees] instead.
        protocol: Shipped protocol or path of a YAML file: the planners' settings.
        robot: Shipped robot or path of a YAML file.
        json: Print the figure's numbers as JSON in SI units.
    """
    if target < 1:
        raise ValueError(f"--target: counts from 1, found {target}")
    arm = load_robot(robot)
    return _make(
        out, json, lambda tell: drawing.draw_fig6(arm, protocol, seed, target, q_deg, tell)
    )


def fig7(
    out: Path = _OUT / "fig7.pdf",
    case: Case = _CASE,
    trials: int = 5,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """M Fig. 7d-e: the tool there and back with 3, 2 and 1 servos while clutches slip.

    The first trial is drawn; errors are RMSE over all. Targets and slips have fixed seeds.

    Example: muxjax figure fig7 --out fig7.pdf

    Example: muxjax figure fig7 --case "open loop, slip alone" --trials 2 --out open.svg

    Args:
        out: File to write: .pdf or .svg (vector), or .png.
        case: What slips and who looks (docs/accuracy.md).
        trials: Random targets, as many runs for each number of servos; another number draws
            other targets.
        robot: Shipped robot or path of a YAML file.
        json: Print the figure's numbers as JSON in SI units.
    """
    arm = load_robot(robot)
    return _make(out, json, lambda tell: drawing.draw_fig7(arm, case, trials, tell))


def fig8c(
    out: Path = _OUT / "fig8c.pdf",
    samples: float = 1e8,
    seed: int = 0,
    case: Case = _CASE,
    trials: int = 5,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """M Fig. 8c: dexterity in the workspace, with time to reach and accuracy at sample points.

    Example: muxjax figure fig8c --out fig8c.pdf

    Example: muxjax figure fig8c --samples 1e9 --trials 10 --json

    Args:
        out: File to write: .pdf or .svg (vector, the map as pixels), or .png.
        samples: Configurations of the map; the paper has 1e9.
        seed: Of the map. Slips have fixed seeds.
        case: What slips and who looks (docs/accuracy.md).
        trials: Runs to every sample point.
        robot: Shipped robot or path of a YAML file, of three segments.
        json: Print the figure's numbers as JSON in SI units.
    """
    if samples != int(samples):
        raise ValueError(f"--samples: must be a whole number, found {samples:g}")
    arm = load_robot(robot)
    return _make(
        out, json, lambda tell: drawing.draw_fig8c(arm, int(samples), seed, case, trials, tell)
    )


def table1(out: Path = _OUT / "table1.pdf", robot: str = "muxarm", json: bool = False) -> int:
    """M Table I: driving solutions as published, and what this model says of the robot's.

    Example: muxjax figure table1 --out table1.tex

    Args:
        out: File to write: .pdf, .svg, .png, .tex (booktabs), .md or .csv.
        robot: Shipped robot or path of a YAML file, for the last row.
        json: Print the cells as JSON.
    """
    arm = load_robot(robot)
    return _make(out, json, lambda tell: drawing.draw_table1(arm), texts=True)


def table2(
    out: Path = _OUT / "table2.pdf",
    targets: int = 15,
    seed: int = 0,
    records: Path = _RECORDS,
    protocol: str = "table2",
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """M Table II: planners by number of servos, our rerun beside the published cells.

    Example: muxjax figure table2 --out table2.pdf

    Example: muxjax figure table2 --targets 200 --records out/table2 --out table2.tex

    Args:
        out: File to write: .pdf, .svg, .png, .tex (booktabs), .md or .csv.
        targets: Random targets; the paper has 15.
        seed: Of the targets.
        records: Folder of muxjax bench table2 --out: targets done there are not run again.
        protocol: Shipped protocol or path of a YAML file.
        robot: Shipped robot or path of a YAML file.
        json: Print the cells as JSON.
    """
    arm = load_robot(robot)
    return _make(
        out,
        json,
        lambda tell: drawing.draw_table2(arm, protocol, targets, seed, records, tell),
        texts=True,
    )


def table3(out: Path = _OUT / "table3.pdf", robot: str = "muxarm", json: bool = False) -> int:
    """M Table III: what the drive costs.

    Example: muxjax figure table3 --out table3.pdf

    Args:
        out: File to write: .pdf, .svg, .png, .tex (booktabs), .md or .csv.
        robot: Shipped robot or path of a YAML file with a section "cost".
        json: Print the cells as JSON; muxjax bom --json has the numbers.
    """
    arm = load_robot(robot)
    return _make(out, json, lambda tell: drawing.draw_table3(arm), texts=True)


def statics(
    out: Path = _OUT / "statics.pdf",
    displacements_mm: tuple[float, ...] = _DISPLACEMENTS,
    chain: str = "hyper_redundant",
    payload_kg: float = 0.0,
    json: bool = False,
) -> int:
    """Postures at the same tendon lengths upright, hanging and horizontal, and their tensions.

    Example: muxjax figure statics --displacements-mm -4 0 4 0 -6 0 6 0 --out statics.pdf

    Args:
        out: File to write: .pdf or .svg (vector), or .png.
        displacements_mm: Of every tendon [mm], negative = wound in.
        chain: Shipped chain or path of a YAML file.
        payload_kg: Mass at the tip.
        json: Print tips and tensions as JSON in SI units.
    """
    if not 0 <= payload_kg < float("inf"):
        raise ValueError(f"--payload-kg: must be at least 0, found {payload_kg:g}")
    return _make(out, json, lambda tell: drawing.draw_statics(chain, displacements_mm, payload_kg))


def training(
    out: Path = _OUT / "training.pdf", runs: tuple[Path, ...] = (), json: bool = False
) -> int:
    """Learning curves of policies: gap and unsolved share over environment steps.

    Example: muxjax figure training --out training.pdf

    Example: muxjax figure training --runs out/rl/muxarm_0 out/rl/muxarm_1 --out seeds.svg

    Args:
        out: File to write: .pdf or .svg (vector), or .png.
        runs: Folders of python -m training.train_rl; the shipped policies by default. Names that
            differ only in a number after the last underscore, the seed, share their look.
        json: Print the last evaluations as JSON.
    """
    return _make(out, json, lambda tell: drawing.draw_training(runs))


def gallery(
    out: Path = Path("docs/images"),
    only: tuple[str, ...] = (),
    records: Path = _RECORDS,
    json: bool = False,
) -> int:
    """Draw the pictures of docs/figures.md, small, by the defaults of the other commands.

    Example: muxjax figure gallery --out docs/images

    Example: muxjax figure gallery --only fig6 statics --out out/gallery

    Args:
        out: Folder for gallery_fig6.png and so on.
        only: Names of the pictures to draw; all by default.
        records: Folder of muxjax bench table2 --out: targets done there are not run again.
        json: Print the files' names and sizes as JSON.
    """
    arm = load_robot("muxarm")
    makers: dict[str, Callable[[Tell], Drawn]] = {
        "fig6": lambda tell: drawing.draw_fig6(arm, "table2", 0, _TARGET, None, tell),
        "fig7": lambda tell: drawing.draw_fig7(arm, _CASE, 5, tell),
        "fig8c": lambda tell: drawing.draw_fig8c(arm, 100_000_000, 0, _CASE, 5, tell),
        "table1": lambda tell: drawing.draw_table1(arm),
        "table2": lambda tell: drawing.draw_table2(arm, "table2", 15, 0, records, tell),
        "table3": lambda tell: drawing.draw_table3(arm),
        "statics": lambda tell: drawing.draw_statics("hyper_redundant", _DISPLACEMENTS, 0.0),
        "training": lambda tell: drawing.draw_training(()),
    }
    for name in only:
        if name not in makers:
            raise ValueError(f"--only: must be of {', '.join(makers)}, found {name!r}")
    _need_matplotlib()
    from muxjax.viz.style import save_small
    from muxjax.viz.tables import table_figure

    written = []
    for name in only or makers:
        with _telling(name) as tell:
            picture = makers[name](tell).picture
        figure = table_figure(picture) if name.startswith("table") else picture
        written.append(save_small(figure, out / f"gallery_{name}.png"))
        if not json:
            console.print(f"{written[-1]}, {written[-1].stat().st_size // 1000} kB")
    if json:
        print_json([{"file": str(path), "bytes": path.stat().st_size} for path in written])
    return 0


def _make(out: Path, json: bool, maker: Callable[[Tell], Drawn], *, texts: bool = False) -> int:
    """Draw, save and report; a wrong ending is refused before any work."""
    _need_matplotlib()
    from muxjax.viz.style import check_ending
    from muxjax.viz.tables import TEXTS

    check_ending(out, tuple(TEXTS) if texts else ())
    with _telling(out.stem) as tell:
        drawn = maker(tell)
    drawn.save(out)
    if json:
        print_json({"file": str(out)} | drawn.document)
        return 0
    table = Table(*drawn.header, box=box.SIMPLE_HEAD)
    for row in drawn.rows:
        table.add_row(*row)
    console.print(table)
    console.print(f"written to {out}")
    return 0


@contextmanager
def _telling(name: str) -> Iterator[Tell]:
    """A bar on standard error while something is made."""
    with work_bar() as bar:
        task = bar.add_task(name, total=None)

        def tell(what: str, done: int, total: int) -> None:
            bar.update(task, description=f"{name}: {what}", completed=done, total=total)

        yield tell


def _need_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError("figures need matplotlib: pip install 'muxjax[viz]'")


COMMANDS: dict[str, Any] = {
    "fig6": fig6,
    "fig7": fig7,
    "fig8c": fig8c,
    "gallery": gallery,
    "statics": statics,
    "table1": table1,
    "table2": table2,
    "table3": table3,
    "training": training,
}
_Choice: Any = choice_of(COMMANDS)


def figure(command: tyro.conf.OmitArgPrefixes[_Choice]) -> int:
    """Figures and tables of the MuxArm paper from this model, as PDF, SVG or PNG; the gallery.

    Example: muxjax figure fig6 --out fig6.pdf
    """
    code: int = command
    return code
