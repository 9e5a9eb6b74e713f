"""From a program to frames on a bus; a board to try it on. docs/protocol.md has the protocol."""

from muxjax.hardware.executor import InstructionRecord, Run, execute
from muxjax.hardware.links import BusLink, Link, LockstepLink, Trajectory
from muxjax.hardware.physics import PhysicsConfig, load_physics
from muxjax.hardware.virtual_board import VirtualBoard

__all__ = [
    "BusLink",
    "InstructionRecord",
    "Link",
    "LockstepLink",
    "PhysicsConfig",
    "Run",
    "Trajectory",
    "VirtualBoard",
    "execute",
    "load_physics",
]
