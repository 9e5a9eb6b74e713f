"""BeamStep in the order of the value network."""

from __future__ import annotations

from dataclasses import replace

import jax

from muxjax.planning.beamstep import beamstep
from muxjax.planning.checkpoint import load_value
from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import Plan
from muxjax.planning.value import LearnedValue, ValueNet, context_of


def learned(
    lattice: Lattice,
    *,
    checkpoint: str | None = None,
    width: int = 16,
    heuristic: str = "count",
    gap: float | None = None,
    deadline_s: float | None = None,
) -> Plan:
    """The layered beam, ordered by a trained value network.

    The network only orders: the result is no worse than the baselines, and its lower bound is the
    admissible one.

    Args:
        lattice: The problem on the robot.
        checkpoint: A shipped one by name, or a file by path; by default the planner preset's, or
            else the one with the robot's name.
        width: Partial plans kept at each length.
        heuristic: Admissible bound that prunes and certifies, as in ``beamstep``; the network's
            order never falls below it.
        gap: As in ``beamstep``.
        deadline_s: As in ``beamstep``.

    Raises:
        CheckpointError: No checkpoint, or one that does not fit the robot.
        ValueError: As in ``beamstep``.
    """
    name = checkpoint or lattice.problem.checkpoint or lattice.robot.config.name
    net, _ = load_value(name, lattice.robot)
    found = beamstep(
        lattice,
        width=width,
        heuristic=heuristic,
        value_fn=learned_value(lattice, net),
        gap=gap,
        deadline_s=deadline_s,
    )
    return replace(found, method="learned")


def learned_value(lattice: Lattice, net: ValueNet) -> LearnedValue:
    """The network as value function of a problem."""
    with jax.enable_x64(True):
        return LearnedValue(net, lattice.robot, jax.device_put(context_of(lattice)))
