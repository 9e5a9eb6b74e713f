"""Figures and animations with matplotlib. Millimetres and degrees, as for a person's eye.

``programs`` draws arms and what programs do over time, ``statics`` postures under load.
"""

from muxjax.viz.programs import (
    SEGMENT_COLOURS,
    animate,
    arm_picture,
    colour,
    compare_programs,
    draw_arm,
    programs_figure,
    style,
)

__all__ = [
    "SEGMENT_COLOURS",
    "animate",
    "arm_picture",
    "colour",
    "compare_programs",
    "draw_arm",
    "programs_figure",
    "style",
]
