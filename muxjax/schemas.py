"""Every kind of YAML file: its JSON schema, and the check of a file by its ``schema:`` line.

Kinds are imported when they are asked for, and by name: those of the trainings lie in a room above
this one, and some need an optional dependency.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from muxjax.config import ConfigError, Strict, load_yaml

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_ENTRY = re.compile(r"^(\w+): (.*)")


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        about: What such a file states.
        module: Where its type is.
        model: Name of the pydantic type.
        load: Function of that module which checks a path further than the type does, if any.
        extra: The optional dependencies that the module needs, if any.
        folder: Below configs, where shipped files of the kind lie; "" where there are none.
    """

    about: str
    module: str
    model: str
    load: str = ""
    extra: str = ""
    folder: str = ""


KINDS: dict[str, Kind] = {
    "robot": Kind("an arm", "muxjax.robot", "RobotConfig", "load_robot", folder="robots"),
    "world": Kind(
        "obstacles", "muxjax.collision.world", "WorldConfig", "load_world", folder="worlds"
    ),
    "task": Kind("tool poses to reach", "muxjax.config", "TaskConfig", folder="tasks"),
    "mission": Kind(
        "a task among obstacles, step by step",
        "muxjax.pipeline.missions.files",
        "MissionConfig",
        folder="missions",
    ),
    "planner": Kind(
        "weights of the plan's cost",
        "muxjax.planning.problem",
        "PlannerConfig",
        folder="planners",
    ),
    "hardware": Kind(
        "physics and faults of a virtual board",
        "muxjax.hardware.physics",
        "PhysicsConfig",
        folder="hardware",
    ),
    "mapping": Kind(
        "a lab's own DBC", "muxjax.hardware.mapping", "MappingConfig", "Translation", "hardware"
    ),
    "encoders": Kind("measured encoder errors", "muxjax.hardware.encoders", "EncoderCalibration"),
    "chain": Kind(
        "an elastic joint chain",
        "muxjax.statics.files",
        "ChainConfig",
        "load_chain",
        folder="chains",
    ),
    "bench": Kind(
        "a comparison of planners with the paper's",
        "muxjax.metrics.protocol",
        "Protocol",
        folder="bench",
    ),
    "env": Kind("a reinforcement-learning environment", "envs.config", "TdmaConfig", folder="envs"),
    "training": Kind(
        "the training of a value network", "training.config", "TrainingConfig", folder="training"
    ),
    "rl": Kind("the training of a policy", "training.config", "RlConfig", folder="training"),
    "compare": Kind(
        "a comparison of guides and baselines",
        "training.compare",
        "CompareConfig",
        extra="train",
        folder="training",
    ),
}


def model_of(kind: str) -> type[Strict]:
    """The pydantic type of a kind of file.

    Raises:
        ConfigError: No such kind, or it needs what is not installed.
    """
    if kind not in KINDS:
        raise ConfigError(f"kind: must be one of {', '.join(KINDS)}, found {kind!r}")
    model: type[Strict] = getattr(_module(kind), KINDS[kind].model)
    return model


def schema_line(kind: str) -> str:
    """What the ``schema:`` line of a kind of file says, such as ``muxjax/robot/1``.

    Raises:
        ConfigError: See ``model_of``.
    """
    line: str = json_schema(kind)["properties"]["schema"]["const"]
    return line


def json_schema(kind: str) -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a kind of file, with what the docstrings say.

    It states types, limits of single values, and names. What holds between fields (a map that
    reaches every tendon, parts that add up) is left to ``check_file``.

    Raises:
        ConfigError: See ``model_of``.
    """
    found = model_of(kind).model_json_schema(by_alias=True, schema_generator=_Described)
    return {"$schema": DIALECT, **_with_short_names(found)}


def check_file(path: str | Path) -> str:
    """Check a YAML file by the kind that its ``schema:`` line names; the kind.

    Files that it names are read too where a loader does so (grids of a world, the DBC of a
    mapping); robots, worlds and presets that it names are looked up when it is used.

    Raises:
        ConfigError: The message names the file, every wrong field, what was found and the limit;
            or the schema line is missing or unknown; or the kind needs what is not installed.
    """
    path = Path(path)
    kind = _kind_of(path)
    try:
        load = KINDS[kind].load
        if load:
            checked: Callable[[Path], Any] = getattr(_module(kind), load)
            checked(path)
        else:
            load_yaml(model_of(kind), path)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{path}: {_needs(kind, error)}") from None
    except ValueError as error:
        text = str(error)
        raise ConfigError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    return kind


def _kind_of(path: Path) -> str:
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: not readable as YAML: {error}") from error
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected a mapping at the top, found {type(raw).__name__}")
    line = raw.get("schema")
    if line is None:
        raise ConfigError(
            f"{path}: schema: missing; the first line of a robot's file is schema: muxjax/robot/1, "
            f"other kinds are {', '.join(k for k in KINDS if k != 'robot')}"
        )
    parts = str(line).split("/")
    if len(parts) != 3 or parts[0] != "muxjax" or parts[1] not in KINDS:
        raise ConfigError(
            f"{path}: schema: must be muxjax/KIND/VERSION with a kind of {', '.join(KINDS)}, "
            f"found {line!r}"
        )
    return parts[1]


def _module(kind: str) -> Any:
    try:
        return importlib.import_module(KINDS[kind].module)
    except ModuleNotFoundError as error:
        raise ConfigError(_needs(kind, error)) from None


def _needs(kind: str, error: ModuleNotFoundError) -> str:
    room = KINDS[kind].module.partition(".")[0]
    if (error.name or "").partition(".")[0] == room:
        return f"kind {kind!r} lies in the folder {room} of a checkout, which is not installed here"
    extra = KINDS[kind].extra
    how = f"pip install 'muxjax[{extra}]'" if extra else f"pip install {error.name}"
    return f"kind {kind!r} needs {error.name}: {how}"


class _Described(GenerateJsonSchema):
    """pydantic's schema, with the docstrings' sections "Attributes" beside the fields."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Never: "Xyz M" says less than the name xyz_m itself."""
        return False

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """A type with its text, and its fields with theirs."""
        found = super().model_schema(schema)
        model = schema["cls"]
        about, fields = _docstring(model)
        found["description"] = about
        if model.__pydantic_generic_metadata__["origin"] is not None:
            found.pop("title", None)  # Sourced[Annotated[...]] is no name for a person
        for name, item in found.get("properties", {}).items():
            if name in fields:
                item.setdefault("description", fields[name])
            elif name == "schema" and "const" in item:
                item.setdefault("description", "kind and version of this file")
        return found


def _docstring(model: type) -> tuple[str, dict[str, str]]:
    """What a type's docstring says of it, and of each field under "Attributes"."""
    origin = getattr(model, "__pydantic_generic_metadata__", {}).get("origin") or model
    about, _, rest = inspect.cleandoc(origin.__doc__ or "").partition("\nAttributes:\n")
    fields: dict[str, str] = {}
    name = ""
    for line in textwrap.dedent(rest).splitlines():
        entry = _ENTRY.match(line)
        if entry is not None:
            name, fields[entry[1]] = entry[1], entry[2]
        elif name and line.strip():
            fields[name] += " " + line.strip()
    return about.strip(), fields


def _with_short_names(schema: dict[str, Any]) -> dict[str, Any]:
    """Definitions of generic types under short names; pydantic's own are their whole type."""
    definitions = schema.get("$defs", {})
    long = [name for name in definitions if name.startswith("Sourced_")]
    short = {name: f"Sourced{number}" for number, name in enumerate(long, start=1)}

    def renamed(tree: Any) -> Any:
        if isinstance(tree, dict):
            return {
                key: f"#/$defs/{short.get(str(item)[8:], str(item)[8:])}"
                if key == "$ref"
                else renamed(item)
                for key, item in tree.items()
            }
        return [renamed(item) for item in tree] if isinstance(tree, list) else tree

    found: dict[str, Any] = renamed({k: v for k, v in schema.items() if k != "$defs"})
    if definitions:
        found["$defs"] = {short.get(k, k): renamed(v) for k, v in definitions.items()}
    return found
