"""From a program to frames on a bus; a board to try it on. docs/protocol.md has the protocol."""

from muxjax.hardware.executor import Progress, Run, execute, resume, take_stock
from muxjax.hardware.handshake import Check
from muxjax.hardware.journal import Journal, MemoryJournal
from muxjax.hardware.links import BusLink, Link, LockstepLink, Trajectory
from muxjax.hardware.physics import PhysicsConfig, load_physics
from muxjax.hardware.transaction import InstructionRecord
from muxjax.hardware.virtual_board import VirtualBoard

__all__ = [
    "BusLink",
    "Check",
    "InstructionRecord",
    "Journal",
    "Link",
    "LockstepLink",
    "MemoryJournal",
    "PhysicsConfig",
    "Progress",
    "Run",
    "Trajectory",
    "VirtualBoard",
    "execute",
    "load_physics",
    "resume",
    "take_stock",
]
