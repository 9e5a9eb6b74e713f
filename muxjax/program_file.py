"""Programs as JSON files, versioned and checked on the way in."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from muxjax.config import ConfigError, Strict, explain
from muxjax.scheduler import Program


class ProgramFile(Strict):
    """The envelope of a program."""

    file_schema: Literal["muxjax/program/1"] = Field(alias="schema")
    program: Program


def save_program(program: Program, path: str | Path) -> None:
    """Write a program as JSON; a file of that name is replaced whole or not at all."""
    envelope = ProgramFile(file_schema="muxjax/program/1", program=program)
    text = envelope.model_dump_json(by_alias=True, indent=2)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    torn = path.with_name(path.name + ".part")
    torn.write_text(text + "\n", encoding="utf-8")
    torn.replace(path)


def load_program(path: str | Path) -> Program:
    """Read a program.

    Raises:
        ConfigError: No such file, not JSON, another schema or a wrong field; each named.
    """
    try:
        return ProgramFile.model_validate_json(Path(path).read_bytes()).program
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error)}") from error
