"""Poses and tendon lengths of millions of configurations, in float32."""

from muxjax.batched.chunks import (
    CHUNK,
    length_quads,
    numbers,
    pose_quads,
    poses,
    tendon_lengths,
)
from muxjax.batched.formulas import (
    SERIES_ERROR,
    WIDE_VECTORS,
    Chain,
    Output,
    Series,
    Vector,
    chain,
    length_values,
    pose_values,
    series,
)

__all__ = [
    "CHUNK",
    "SERIES_ERROR",
    "WIDE_VECTORS",
    "Chain",
    "Output",
    "Series",
    "Vector",
    "chain",
    "length_quads",
    "length_values",
    "numbers",
    "pose_quads",
    "pose_values",
    "poses",
    "series",
    "tendon_lengths",
]
