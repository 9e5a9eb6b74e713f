"""How programs perform, one by one and over many targets."""

from muxjax.metrics.program import (
    Metrics,
    Timeline,
    evaluate,
    least_time,
    program_cost,
    timeline,
    tip_deviation,
)

__all__ = [
    "Metrics",
    "Timeline",
    "evaluate",
    "least_time",
    "program_cost",
    "timeline",
    "tip_deviation",
]
