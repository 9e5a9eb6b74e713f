"""What the pages say exists: the commands they print parse, the files they link to are there.

`make docs` checks links between pages, anchors and docstrings; this file what MkDocs does not see.
"""

from __future__ import annotations

import functools
import re
import shlex
from pathlib import Path

import pytest
import tyro

import muxjax
from muxjax.cli import leaves

ROOT = Path(__file__).resolve().parent.parent
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS]
API = "\n".join(page.read_text() for page in DOCS if page.parent.name == "api")

PRINTED = re.compile(r"^\s*(?:\$ )?(muxjax [^\n]*)$", re.MULTILINE)  # lines of code blocks
QUOTED = re.compile(r"`(muxjax [a-z]+ [^`]+)`")  # in a sentence


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def commands_of(text: str) -> list[str]:
    """The commands of a page, without comments and what "..." stands for."""
    blocks = re.findall(r"^```[^\n]*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    blocks += re.findall(r"(?:^    [^\n]*\n)+", text, re.MULTILINE)
    found = [line for block in blocks for line in PRINTED.findall(block)]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return found + [command for command in QUOTED.findall(prose) if "..." not in command]


def parses(command: str) -> bool:
    """Whether the command's own parser takes the words; the command itself is not run."""
    words = shlex.split(command, comments=True)[1:]
    if words[0].startswith("--tyro"):  # completion: what tyro itself takes
        return True
    known = next((k for k in leaves() if tuple(words[: len(k)]) == k), None)
    if known is None:
        return False
    call = leaves()[known]
    heard = functools.wraps(call)(lambda **_: 0)
    try:
        return tyro.cli(heard, args=words[len(known) :]) == 0
    except SystemExit:
        return False


def test_what_parses(capsys):
    assert parses("muxjax fk 60 0  75 180  40 0   # a comment")
    assert parses("muxjax config check my_arm.yaml")
    for wrong in ["fk 60 --colour red", "paint", "config paint", "export", "plan --servos two"]:
        assert not parses(f"muxjax {wrong}"), wrong
    text = "Say `muxjax bom --json`:\n\n```\n$ muxjax fk 1 2\nno\n```\n\n    muxjax bom  # so\n"
    assert commands_of(text) == ["muxjax fk 1 2", "muxjax bom  # so", "muxjax bom --json"]


@pytest.mark.parametrize("page", [p for p in PAGES if commands_of(p.read_text())], ids=named)
def test_commands_parse(page, capsys):
    wrong = [command for command in commands_of(page.read_text()) if not parses(command)]
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_to_files_lead_somewhere(page):
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", prose)
    files = [link for link in links if not re.match(r"[a-z]+:", link)]
    missing = [link for link in files if not (page.parent / link).exists()]
    assert missing == []


def test_files_named_in_the_readme_exist():
    """`configs/robots` and the like, where they are named without a link."""
    text = (ROOT / "README.md").read_text()
    names = re.findall(r"`((?:muxjax|envs|training|configs|checkpoints|docs)/[\w./-]+)`", text)
    assert names
    assert [name for name in names if not (ROOT / name).exists()] == []


def test_the_reference_has_every_public_name():
    """Its index names each, and a page shows the module that it comes from."""
    index = (ROOT / "docs" / "api" / "index.md").read_text()
    assert {name for name in muxjax.__all__ if f"`{name}`" not in index} == set()
    rooms = set(re.findall(r"^::: ([\w.]+)$", API, re.MULTILINE))
    for name in muxjax.__all__:
        parts = getattr(muxjax, name).__module__.split(".")
        shown = [room for room in rooms if parts[: len(room.split("."))] == room.split(".")]
        assert shown, name
