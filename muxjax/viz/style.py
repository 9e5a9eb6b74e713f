"""What all figures have in common: a look that survives print in grey, and how they are saved."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from muxjax.config import replacing

ENDINGS = (".pdf", ".svg", ".png")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
INK, GREY = "#1f2933", "0.55"
# Okabe-Ito colours by segment, distinguishable without colour vision; in grey print the markers
# tell segments apart, and the line styles their tendons.
SEGMENT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TENDON_STYLES = ("-", "--", ":", "-.")

# Sizes of a printed column; text stays text in vector files, for editors and for search. The salt
# and the missing date make the same figure the same file.
STYLE: Any = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "muxjax",
}
_DATELESS = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def check_ending(path: str | Path, more: tuple[str, ...] = ()) -> Path:
    """The path of a figure, refused before any work if its ending is not a format.

    Args:
        path: Where the figure is to go.
        more: Endings beside .pdf, .svg and .png.

    Raises:
        ValueError: Another ending.
    """
    path = Path(path)
    if path.suffix not in (*ENDINGS, *more):
        raise ValueError(f"{path}: the ending must be one of {', '.join((*ENDINGS, *more))}")
    return path


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 200) -> Path:
    """Write a figure in the format that the path's ending names; folders are made.

    Args:
        figure: The figure.
        path: File to write, ending in .pdf, .svg (both vector) or .png.
        dpi: Of a .png, and of parts of a vector file that are pixels.

    Raises:
        ValueError: Another ending.
    """
    path = check_ending(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE), replacing(path) as part:
        figure.savefig(part, dpi=dpi, format=path.suffix[1:], metadata=_DATELESS.get(path.suffix))
    return path


def save_small(figure: Figure, path: str | Path, *, width: int = 1000, shades: int = 96) -> Path:
    """Write a figure as a small .png, for a web page.

    Args:
        figure: The figure.
        path: File to write.
        width: In pixels.
        shades: Colours of its palette.
    """
    from PIL import Image

    path = Path(path)
    whole = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(whole, dpi=width / figure.get_size_inches()[0], format="png")
    picture = Image.open(whole).convert("RGB").quantize(shades, dither=Image.Dither.NONE)
    with replacing(path) as part:
        picture.save(part, format="PNG", optimize=True)
    return path
