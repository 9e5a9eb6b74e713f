"""The value network: what a plan still costs, learned; it orders partial plans and bounds nothing.

    value = admissible count + scale * softplus(network(features))

The count (``arrays.BoundArrays`` without pattern databases) and the scale know the units and the
weights, so the network sees and gives plain numbers: lengths over the tendon radius, costs over the
scale, and the objective as shares of the scale. What the count does not know (overshoot, tension,
closeness to obstacles, your own terms) the network feels through probes: the price of a second's
wait, and whether it is forbidden, on a coarse grid of how far each layer has gone.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.planning.arrays import BoundArrays, LatticeArrays
from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at, bending_angles
from muxjax.planning.problem import ACTION_SETS, PlanningError, Problem
from muxjax.planning.search import States
from muxjax.planning.terms import TERMS, CostTerm, Term, step, transition_cost
from muxjax.precision import matmul, pad_rows
from muxjax.robot import Robot
from muxjax.tendons import bending_from_displacements

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union

FEATURES = 1  # version of what ``features`` computes; checkpoints of another one are refused
_COUNTED = ("travel", "switches", "time", "bending")  # terms that the count knows
_MOST = 3.0  # features beyond are clipped


class ValueNet(eqx.Module):
    """A perceptron with one output; float32."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]

    def __call__(self, features: Float[Array, "N F"]) -> Float[Array, " N"]:
        """Correction in units of the scale, above zero."""
        x = features.astype(jnp.float32)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = jax.nn.relu(matmul(x, weight) + bias)
        return jax.nn.softplus((matmul(x, self.weights[-1]) + self.biases[-1])[:, 0])


def value_net(sizes: tuple[int, ...], key: Array) -> ValueNet:
    """A network of these layer sizes, features first and 1 last, with He's initial weights."""
    keys = jax.random.split(key, len(sizes) - 1)
    weights = [
        jax.random.normal(k, (n, m), jnp.float32) * np.float32(np.sqrt(2.0 / n))
        for k, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]
    # The last layer begins near zero: at first, the order is the count's.
    weights[-1] = weights[-1] * np.float32(0.1)
    return ValueNet(tuple(weights), tuple(jnp.zeros(m, jnp.float32) for m in sizes[1:]))


class Context(NamedTuple):
    """What is the same for all states of a problem."""

    lattice: LatticeArrays
    bound: BoundArrays  # without patterns
    scale: Float[Array, ""]  # a typical cost, the unit of the network's output
    way: Float[Array, " S"]  # of a layer's tendons from the start [m]
    objective: Float[Array, " terms"]  # typical costs by term, over the scale
    servos: Float[Array, " J"]  # 1 where available
    action_set: Float[Array, " sets"]
    step: Float[Array, ""]  # greatest one over the tendon radius
    rates: Float[Array, " probes"]  # price of waiting, over that of the typical one
    blocked: Float[Array, " probes"]  # 1 where waiting is forbidden


class LearnedValue(eqx.Module):
    """A value function for the searches: ``search.ValueFunction``."""

    net: ValueNet
    robot: Robot
    context: Context

    def __call__(self, states: States) -> Float[Array, " N"]:
        """Estimated cost to go; never below the bound that the search knows."""
        count = self.context.bound(self.context.lattice, states.remaining, states.stop)
        inputs = features(self.robot, self.context, states, count)
        value = count + self.context.scale * self.net(inputs)
        arrived = ~jnp.any(states.remaining > 0, axis=-1)
        return jnp.where(arrived, 0.0, jnp.maximum(value, states.bound))


def n_features(robot: Robot) -> int:
    """Length of a feature vector."""
    s, j = robot.n_segments, robot.tendons_per_segment
    return 4 * s * j + 4 * s + 5 * s + 2 * s + 4 + 2 + len(_TYPICAL) + j + len(ACTION_SETS) + 1


def features(
    robot: Robot, context: Context, states: States, count: Float[Array, " N"]
) -> Float[Array, "N F"]:
    """What the network sees; docs/learned.md lists it."""
    lattice = context.lattice
    rows, s = states.remaining.shape[0], robot.n_segments
    radius = robot.tendon_radius
    way = lattice.way[jnp.arange(robot.n_tendons), states.remaining]
    steps = jnp.log1p(states.remaining) / np.log(32.0)
    known = states.stop >= 0
    reach = context.bound.reach[states.stop].astype(way.dtype)
    b = bending_from_displacements(robot, states.displacements)
    goal = bending_from_displacements(robot, lattice.target)
    theta, theta_goal = jnp.linalg.norm(b, axis=-1), jnp.linalg.norm(goal, axis=-1)
    needs = context.bound.needs(lattice, states.remaining, states.stop, jnp)
    left = jnp.stack(needs.way, axis=-1)
    gone = jnp.where(context.way > 0, 1.0 - left / jnp.maximum(context.way, 1e-12), 1.0)
    same = jnp.concatenate(
        [context.objective, context.servos, context.action_set, context.step[None]]
    )
    columns = [
        -way / radius,
        steps,
        (states.remaining > 0).astype(way.dtype),
        reach,
        b.reshape(rows, -1),
        jnp.broadcast_to(goal.reshape(-1), (rows, 2 * s)),
        theta,
        theta - theta_goal,
        left / radius,
        jnp.stack(needs.shortest, axis=-1) / radius,
        jnp.stack(needs.visits, axis=-1).astype(way.dtype),
        *_probed(context, gone),
        known.astype(way.dtype)[:, None],
        (count / context.scale)[:, None],
        jnp.broadcast_to(same, (rows, len(same))),
    ]
    return jnp.clip(jnp.concatenate(columns, axis=-1), -_MOST, _MOST)


# Typical costs whose shares tell the network the objective.
_TYPICAL = ("travel", "bending", "switches", "time", "overshoot", "overshoot_peak", "others")


def _points(n_segments: int) -> int:
    """Probes along a layer's way; on the grid of all layers they are a power."""
    return 5 if n_segments <= 3 else 3 if n_segments <= 5 else 2


def _probed(context: Context, gone: Float[Array, "N S"]) -> list[Float[Array, "N _"]]:
    """Rates and blocks at the nearest probe, and where one more layer has arrived."""
    s = gone.shape[1]
    points = _points(s)
    power = points ** np.arange(s)[::-1]
    at = jnp.clip(jnp.round(gone * (points - 1)), 0, points - 1).astype(jnp.int32)
    here = at @ jnp.asarray(power, jnp.int32)
    places = [here, *(here + (points - 1 - at[:, i]) * int(power[i]) for i in range(s))]
    place = jnp.stack(places, axis=-1)
    goal = jnp.broadcast_to(context.rates[-1], (len(gone), 1))
    barred = jnp.broadcast_to(context.blocked[-1], (len(gone), 1))
    return [context.rates[place], goal, context.blocked[place], barred]


def context_of(lattice: Lattice) -> Context:
    """Context of a problem, on the host in float64.

    Raises:
        PlanningError: A robot whose servos meet several layers at an axial position.
    """
    if not lattice.one_layer_a_step:
        raise PlanningError("learned: needs a robot whose servos meet one layer at a time")
    robot, problem = lattice.robot, lattice.problem
    ways = np.abs(problem.target - problem.start).reshape(robot.n_segments, -1)
    ways = np.where(lattice.steps.reshape(ways.shape) > 0, ways, 0.0)
    bound = bound_of(lattice)
    rates, blocked = _probes(lattice)
    seconds, typical = _typical(lattice, ways, float(np.mean(rates)))
    scale = max(float(typical.sum()), 1e-12)
    return Context(
        lattice=bound.lattice_arrays,
        bound=bound.arrays("count"),
        scale=np.asarray(scale),
        way=ways.sum(axis=1),
        objective=typical / scale,
        servos=np.isin(np.arange(1, robot.tendons_per_segment + 1), problem.servos).astype(float),
        action_set=np.array([float(problem.action_set == name) for name in ACTION_SETS]),
        step=np.asarray(min(lattice.max_step / float(robot.tendon_radius), _MOST)),
        rates=np.minimum(rates * seconds / scale, _MOST),
        blocked=blocked,
    )


def _typical(
    lattice: Lattice, ways: Float[np.ndarray, "S J"], rate: float
) -> tuple[float, Float[np.ndarray, " terms"]]:
    """About how long a plan takes [s], and about what it costs by each kind of term."""
    robot, problem = lattice.robot, lattice.problem
    servos = int(lattice.reach.sum(axis=1).max())

    def together(of_tendon: np.ndarray) -> float:
        by_layer = of_tendon.reshape(robot.n_segments, -1)
        return float(np.maximum(by_layer.max(axis=1), by_layer.sum(axis=1) / servos).sum())

    visits = float(np.ceil((ways > 0).sum(axis=1) / servos).sum())
    seconds = visits * float(robot.switch_time) + together(ways) / float(robot.tendon_speed)
    ends = angles_at(robot, np.stack([problem.start, problem.target]))
    amount = {
        "travel": float(ways.sum()),
        "bending": together(lattice.steps) * float(np.mean(np.sum(ends**2, axis=1))),
        "switches": visits,
        "time": seconds,
        "overshoot": 0.05 * seconds,
        "overshoot_peak": 0.2,
    }
    weights = {name: problem.cost_weights[name] for name, _ in _shipped(problem)}
    known = [weights.get(name, 0.0) * amount[name] for name in _TYPICAL[:-1]]
    return seconds, np.array([*known, rate * seconds])


def _shipped(problem: Problem) -> list[tuple[str, Term]]:
    """Terms whose meaning is known: a term of a user's may have the name of a shipped one."""
    return [(name, term) for name, term in problem.weighted_terms if term is TERMS.get(name)]


def _probes(lattice: Lattice) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Price of a second's wait by the terms that the count does not know, and where it is barred.

    On the grid of how far each layer has gone, the last layer the fastest.
    """
    robot, problem = lattice.robot, lattice.problem
    counted = {name for name, _ in _shipped(problem)} & set(_COUNTED)
    terms, weights = problem.compiled_terms(without=counted)
    points = _points(robot.n_segments)
    if not terms:
        nothing = np.zeros(points**robot.n_segments)
        return nothing, nothing
    share = np.array(list(product(np.linspace(0, 1, points), repeat=robot.n_segments)))
    gone = np.repeat(share, robot.tendons_per_segment, axis=1)
    at = problem.start + gone * (problem.target - problem.start)
    with jax.enable_x64(True):
        price = _waiting_price(robot, terms, weights, pad_rows(at), problem.target)
        rates = np.asarray(price)[: len(at)] / max(float(robot.switch_time), 1e-3)
    free = np.isfinite(rates)
    return np.where(free, rates, 0.0), (~free).astype(float)


@jax.jit
def _waiting_price(
    robot: Robot,
    terms: tuple[CostTerm, ...],
    weights: Float[Array, " T"],
    displacements: Float[Array, "P SJ"],
    target: Float[Array, " SJ"],
) -> Float[Array, " P"]:
    """Of a repositioning after which nothing moves."""
    turns = jnp.ones(len(displacements))
    goal = bending_angles(robot, target)
    waits = step(robot, displacements, 0 * displacements, turns, 0 * turns, goal)
    return transition_cost(robot, terms, weights, waits)


def turn_by_a_tendon(robot: Robot) -> Float[np.ndarray, "F F"]:
    """Matrix that turns features about the arm's axis until each tendon stands where the next did.

    Where tendons run straight and evenly, a problem turned so, with its servos, costs the same (C3
    for J = 3). Obstacles, and gravity across the axis, break the symmetry.
    """
    s, j = robot.n_segments, robot.tendons_per_segment
    angle = 2 * np.pi / j
    rotate = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = np.roll(np.eye(j), 1, axis=0)
    rest = n_features(robot) - 4 * s * j - 4 * s - j - len(ACTION_SETS) - 1
    blocks = [*[shift] * (4 * s), *[rotate] * (2 * s), np.eye(rest), shift]
    return np.asarray(scipy.linalg.block_diag(*blocks, np.eye(len(ACTION_SETS) + 1)))
