"""The fitted chain as a YAML file that loads again."""

from __future__ import annotations

from pathlib import Path

import yaml

from muxjax.statics.calibration.fit import Calibration
from muxjax.statics.calibration.parameters import as_document


def save_chain(found: Calibration, path: str | Path) -> Path:
    """Write the fitted values into the chain's file, marked derived, and say how they came about.

    Values that were not fitted, or that the data left alone, stay as they were, with their source;
    of the others the leading comment tells how well they are known.
    Zero offsets belong to the readings, not to the arm: they stand in that comment.

    Raises:
        ValueError: A path that does not end in .yaml or .yml.
    """
    path = Path(path)
    if path.suffix not in {".yaml", ".yml"}:
        raise ValueError(f"out: must end in .yaml or .yml, found {path.name!r}")
    why = f"calibrated from {found.source}, {found.rows} rows, {_rms_text(found)}"
    document = as_document(found.config, found.values(), why)
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_comment(found) + text, encoding="utf-8")
    return path


def _rms_text(found: Calibration) -> str:
    units = {
        "position": (1e3, "mm"),
        "orientation": (57.29577951308232, "deg"),
        "tension": (1, "N"),
    }
    parts = [
        f"{kind} rms {units[kind][0] * after:.3g} {units[kind][1]}"
        for kind, (_, after) in found.rms.items()
    ]
    return ", ".join(parts)


def _comment(found: Calibration) -> str:
    """What was fitted, with its 95 % intervals."""
    state = "" if found.converged else f"# NOT CONVERGED: {found.reason}\n"
    lines = [f"# Fitted to {found.source} ({found.rows} rows): value and 95 % interval.\n{state}"]
    for e in found.estimates:
        if e.identifiable:
            text = f"{e.value:.6g} {e.unit} ({e.low:.6g} to {e.high:.6g})"
        else:
            text = f"{e.value:.6g} {e.unit}, {e.remark}"
        lines.append(f"#   {e.name}: {text}\n")
    if any(e.name.startswith("offset_") for e in found.estimates):
        lines.append(
            "# A reading less its offset is the true value; offsets are not in the chain.\n"
        )
    return "".join(lines)
