"""How programs perform, one by one and over many targets."""

from muxjax.metrics.program import (
    Metrics,
    evaluate,
    least_time,
    program_cost,
    timeline,
    tip_deviation,
)
from muxjax.metrics.tension import TensionProfile, tension_along

__all__ = [
    "Metrics",
    "TensionProfile",
    "evaluate",
    "least_time",
    "program_cost",
    "tension_along",
    "timeline",
    "tip_deviation",
]
