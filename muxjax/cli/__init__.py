"""The command line: ``muxjax bench | board | bom | config | conformance | demo | ...``.

A person types and reads millimetres and degrees; ``--json`` prints SI units for a machine. The exit
code is 0 on success, 1 where a pose was not reached or a run did not complete, 2 on bad input.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import tyro

from muxjax.cli.bench import bench
from muxjax.cli.board import board
from muxjax.cli.bom import bom
from muxjax.cli.config import COMMANDS as CONFIG_COMMANDS
from muxjax.cli.config import config
from muxjax.cli.demo import demo
from muxjax.cli.export import export
from muxjax.cli.figure import COMMANDS as FIGURE_COMMANDS
from muxjax.cli.figure import figure
from muxjax.cli.hardware import conformance, firmware
from muxjax.cli.output import complain
from muxjax.cli.plans import plan
from muxjax.cli.poses import fk, ik
from muxjax.cli.runs import resume, run
from muxjax.cli.statics import COMMANDS as STATICS_COMMANDS
from muxjax.cli.statics import statics
from muxjax.cli.sweep import sweep
from muxjax.cli.task import task
from muxjax.cli.urdf import urdf
from muxjax.cli.view import view
from muxjax.ik import IkError
from muxjax.planning import PlanningError

COMMANDS: dict[str, Callable[..., Any]] = {
    "bench": bench,
    "board": board,
    "bom": bom,
    "config": config,
    "conformance": conformance,
    "demo": demo,
    "export": export,
    "figure": figure,
    "firmware": firmware,
    "fk": fk,
    "ik": ik,
    "plan": plan,
    "resume": resume,
    "run": run,
    "sweep": sweep,
    "statics": statics,
    "task": task,
    "urdf": urdf,
    "view": view,
}


# Commands of commands, by their name.
GROUPS: dict[str, Mapping[str, Callable[..., Any]]] = {
    "config": CONFIG_COMMANDS,
    "figure": FIGURE_COMMANDS,
    "statics": STATICS_COMMANDS,
}

_ABOUT = """Time-multiplexed tendon-driven arms, from a pose to CAN frames.

A person types and reads millimetres and degrees; --json prints SI units for a machine. The exit
code is 0 on success, 1 where a pose was not reached or a run did not complete, 2 on bad input.

Example: muxjax plan --q-deg 60 0 75 180 40 0 --servos 1 2 --out program.json

Example: muxjax run program.json

Example: muxjax plan --help
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the ``muxjax`` command."""
    _keep_compilations()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # results appear as they come, in a pipe too
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="muxjax", args=arguments, description=_ABOUT
        )
    except IkError as error:
        complain(error)
        code = 1
    except BrokenPipeError:
        # The reader has seen enough; Python must not complain about it at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except OSError as error:
        text = error if error.filename is None else f"{error.filename}: {error.strerror}"
        complain(text, _advice(arguments))
        code = 2
    except (ValueError, PlanningError) as error:
        complain(error, _advice(arguments))
        code = 2
    except KeyboardInterrupt:
        complain("interrupted")
        code = 130
    sys.exit(code)


def leaves() -> dict[tuple[str, ...], Callable[..., Any]]:
    """Every command that has options, by its words, such as ("statics", "posture")."""
    found: dict[tuple[str, ...], Callable[..., Any]] = {}
    for name, call in COMMANDS.items():
        inner = GROUPS.get(name)
        if inner is None:
            found[(name,)] = call
        else:
            found |= {(name, word): one for word, one in inner.items()}
    return found


def _advice(arguments: Sequence[str] | None) -> str:
    """Where the examples of the command are that was asked for."""
    asked = tuple(sys.argv[1:] if arguments is None else arguments)
    words = max((w for w in leaves() if asked[: len(w)] == w), key=len, default=())
    return f"muxjax {' '.join((*words, '--help'))} has examples"


def _keep_compilations() -> None:
    """Compiled functions are kept between calls of the command, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "muxjax"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
