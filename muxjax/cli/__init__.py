"""The command line: ``muxjax demo | fk | ik | plan | run``.

A person types and reads millimetres and degrees; ``--json`` prints SI units for a machine. The exit
code is 0 on success, 1 where a pose was not reached or a run did not complete, 2 on bad input.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import tyro

from muxjax.cli.demo import demo
from muxjax.cli.plans import plan, run
from muxjax.cli.poses import fk, ik
from muxjax.planning import PlanningError

COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "fk": fk,
    "ik": ik,
    "plan": plan,
    "run": run,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the ``muxjax`` command."""
    _keep_compilations()
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="muxjax", args=arguments, description=__doc__
        )
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
