"""The built site: what the extensions in docs/extensions add, and that it fetches nothing."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        check=True,
    )
    return out


def test_nothing_is_fetched(site):
    for page in site.rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)[^>]*(?:src|href)=\"?([^\"\s>]+)", page.read_text()
        )
        assert loaded
        assert [link for link in loaded if re.match(r"(https?:)?//", link)] == [], page


def test_every_equation_is_drawn(site):
    source = (ROOT / "docs" / "guide.md").read_text()
    written = re.findall(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", source)
    page = (site / "guide.html").read_text()
    drawn = re.findall(r'<svg class="equation" role="img" aria-label="(.*?)"', page)
    assert [" ".join(html.unescape(d).split()) for d in drawn] == [
        " ".join((block or inline).split()) for block, inline in written
    ]
    assert "arithmatex" not in page.replace("arithmatex.css", "")


def test_linked_files_of_the_repository_come_along(site):
    page = (site / "guide.html").read_text()
    place = "repository/configs/robots/muxarm.yaml"
    assert f'href="{place}"' in page
    copied, kept = site / place, ROOT / "configs" / "robots" / "muxarm.yaml"
    assert copied.read_bytes() == kept.read_bytes()
    assert (
        '="../repository/configs/robots/muxarm.yaml"'
        in (site / "tutorials" / "own_robot.html").read_text()
    )


def test_comments_beside_fields_are_in_the_reference(site):
    def text(page: str) -> str:
        found = (site / "api" / f"{page}.html").read_text()
        return " ".join(html.unescape(re.sub(r"<[^>]+>", "", found)).split())

    assert "(theta_1, phi_1, ...) [rad], within the limits" in text("ik")  # IkResult.q
    assert "until the tendons move [s]: t_sw, or the engagement alone for a first step" in text(
        "planning"
    )  # Transition.wait, whose comment takes two lines
