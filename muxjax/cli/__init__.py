"""The command line: ``muxjax bench | board | bom | config | conformance | demo | ...``.

A person types and reads millimetres and degrees; ``--json`` prints SI units for a machine. The exit
code is 0 on success, 1 where a pose was not reached or a run did not complete, 2 on bad input.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import tyro

from muxjax.cli.bench import bench
from muxjax.cli.board import board
from muxjax.cli.bom import bom
from muxjax.cli.config import config
from muxjax.cli.demo import demo
from muxjax.cli.export import export
from muxjax.cli.hardware import conformance, firmware
from muxjax.cli.plans import plan
from muxjax.cli.poses import fk, ik
from muxjax.cli.runs import resume, run
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the ``muxjax`` command."""
    _keep_compilations()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # results appear as they come, in a pipe too
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="muxjax", args=arguments, description=__doc__
        )
    except IkError as error:
        print(f"muxjax: {error}", file=sys.stderr)
        code = 1
    except BrokenPipeError:
        # The reader has seen enough; Python must not complain about it at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except OSError as error:
        text = error if error.filename is None else f"{error.filename}: {error.strerror}"
        print(f"muxjax: {text}", file=sys.stderr)
        code = 2
    except (ValueError, PlanningError) as error:
        print(f"muxjax: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("muxjax: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)


def _keep_compilations() -> None:
    """Compiled functions are kept between calls of the command, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "muxjax"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
