"""What a person looks at: figures and animations with matplotlib, and the viewer in the browser.

Millimetres and degrees, as for a person's eye. ``programs`` draws arms and what programs do over
time, ``statics`` postures under load; ``viewer`` needs viser, and is not loaded with the others.
"""

from muxjax.viz.programs import (
    animate,
    arm_picture,
    compare_programs,
    draw_arm,
    programs_figure,
)

__all__ = [
    "animate",
    "arm_picture",
    "compare_programs",
    "draw_arm",
    "programs_figure",
]
