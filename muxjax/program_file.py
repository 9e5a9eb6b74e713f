"""Programs as JSON files, versioned and checked on the way in."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from muxjax.config import ConfigError, Strict, load_json, save_json
from muxjax.scheduler import Program


class ProgramFile(Strict):
    """The envelope of a program."""

    file_schema: Literal["muxjax/program/1"] = Field(alias="schema")
    program: Program


def save_program(program: Program, path: str | Path) -> None:
    """Write a program as JSON; a file of that name is replaced whole or not at all."""
    save_json(ProgramFile(file_schema="muxjax/program/1", program=program), path)


def load_program(path: str | Path) -> Program:
    """Read a program.

    Raises:
        ConfigError: No such file, not JSON, another schema or a wrong field; each named.
    """
    try:
        return load_json(ProgramFile, path).program
    except ConfigError as error:
        raise ConfigError(f"{error}; muxjax plan --out writes programs") from error
