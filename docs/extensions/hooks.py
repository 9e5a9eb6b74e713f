r"""What the build does beyond MkDocs: equations as drawings, links to files of the repository.

Pages are read in the repository too, so they say ``[robots](../configs/robots/muxarm.yaml)`` and
``$\theta$``. The site shows the same without fetching anything.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from matplotlib.font_manager import FontProperties
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextToPath
from mkdocs.structure.files import File

# A link out of docs: "](../configs/x.yaml)" in docs/page.md, "](../../configs/x.yaml)" one deeper.
LINK = re.compile(r"\]\(((?:\.\./)+[^)#\s]+)\)")
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
EM = TextToPath.FONT_SCALE / 1.08  # a drawing's units to the em; the letters are a little small
LETTERS = {
    Outline.MOVETO: ("M", 1),
    Outline.LINETO: ("L", 1),
    Outline.CURVE3: ("Q", 2),
    Outline.CURVE4: ("C", 3),
    Outline.CLOSEPOLY: ("Z", 1),
}


def on_files(files: Any, config: Any) -> Any:
    """Files of the repository that a page links to become part of the site."""
    docs = Path(config.docs_dir)
    for page in files.documentation_pages():
        for link in LINK.findall(page.content_string):
            place = _in_repository(page.src_uri, link, docs)
            if place and files.get_file_from_path(place) is None:
                source = docs.parent / place.removeprefix("repository/")
                files.append(File.generated(config, place, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links out of docs lead to the site's copy; others are left for MkDocs to complain of."""
    up = "../" * page.file.src_uri.count("/")

    def rewritten(match: re.Match[str]) -> str:
        place = _in_repository(page.file.src_uri, match[1], Path(config.docs_dir))
        return f"]({up}{place})" if place else match[0]

    return LINK.sub(rewritten, markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Equations, marked by arithmatex, are drawn."""
    return EQUATION.sub(lambda m: _drawn(html.unescape(m[2]), display=m[1] == "div"), content)


def _in_repository(page: str, link: str, docs: Path) -> str | None:
    """Where the site has a file that lies outside docs, if it is one."""
    target = (docs / page).parent.joinpath(link).resolve()
    if not target.is_file() or docs in target.parents or docs.parent not in target.parents:
        return None
    return f"repository/{target.relative_to(docs.parent).as_posix()}"


def _drawn(formula: str, *, display: bool) -> str:
    """A formula as inline SVG in the text's colour and size, by matplotlib's mathtext."""
    font = FontProperties(math_fontfamily="cm")
    points, codes = TextToPath().get_text_path(font, f"${' '.join(formula.split())}$", ismath=True)
    box = Outline(points, codes).get_extents().padded(EM / 25)
    strokes: list[str] = []
    i = 0
    while i < len(codes):
        letter, n = LETTERS[codes[i]]
        corners = (f"{x:.1f} {-y:.1f}" for x, y in points[i : i + n] if letter != "Z")
        strokes.append(letter + " ".join(corners))
        i += n
    size = f"width:{box.width / EM:.3f}em;height:{box.height / EM:.3f}em"
    place = "" if display else f";vertical-align:{box.y0 / EM:.3f}em"
    view = f"{box.x0:.1f} {-box.y1:.1f} {box.width:.1f} {box.height:.1f}"
    svg = (
        f'<svg class="equation" role="img" aria-label="{html.escape(formula)}" '
        f'style="{size}{place}" viewBox="{view}">'
        f'<path fill="currentColor" d="{"".join(strokes)}"/></svg>'
    )
    return f'<div class="equation">{svg}</div>' if display else svg
