"""The picture of a mission: nothing in it lies on something else."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from muxjax.collision import load_world
from muxjax.viz.missions import Bar, Snapshot, draw_mission

LONG = "a step with a long name"


@pytest.mark.parametrize(
    "stages",
    [
        {"drive to the mouth": 1, "insertion": 30, "grasp": 1, "out": 30, "carry": 1, LONG: 1},
        {"out": 90, "carry": 1, "release": 1, LONG: 1, "depart": 1},
        {LONG: 1},
    ],
    ids=["between runs", "at the end", "alone"],
)
def test_no_writing_lies_on_other_writing(muxarm, monkeypatch, tmp_path, stages):
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    snapshot = Snapshot("insertion", muxarm, np.zeros(9), load_world("s_pipe"))
    bars = [Bar(step, "tendons", 0.03) for step, n in stages.items() for _ in range(n)]
    draw_mission([snapshot] * 5, bars, 0.002, "pipe", tmp_path / "pipe.png", views=((0, 2),))
    canvas = FigureCanvasAgg(drawn[0])
    canvas.draw()
    # Numbers are left out: an axis also keeps those of ticks beyond its ends, which it never draws.
    texts = [t for t in drawn[0].findobj(Text) if any(c.isalpha() for c in t.get_text())]
    assert {t.get_text() for t in texts} >= {*stages, "margin", "least clearance [mm]"}
    boxes = [(t.get_text(), t.get_window_extent(canvas.get_renderer())) for t in texts]
    page = drawn[0].bbox
    for name, box in boxes:
        assert page.x0 <= box.x0 < box.x1 <= page.x1, name
        assert page.y0 <= box.y0 < box.y1 <= page.y1, name
    for (one, a), (other, b) in combinations(boxes, 2):
        apart = a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0
        assert apart, (one, other)
