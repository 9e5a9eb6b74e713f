"""The planning problem as a reinforcement-learning environment: the functional core, pure JAX.

Every function is of one episode, for ``jax.vmap`` over many and ``jax.jit`` around. A step is the
planners' own (``terms.step``), and its reward is minus its cost (``terms.transition_cost``): the
undiscounted return of an episode that reaches its target is minus the cost of the plan with the
same steps. Computed in float32, or in float64 where JAX's x64 switch is on. docs/envs.md has the
conventions.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.config import TdmaConfig
from muxjax.collision import load_world
from muxjax.config import ConfigError, RobotConfig
from muxjax.planning.problem import Problem, check_problem
from muxjax.planning.terms import Term, step, transition_cost
from muxjax.planning.world import clearance_at, clearance_of
from muxjax.robot import Robot, load_robot, robot_from_config
from muxjax.tendons import (
    bending_from_displacements,
    displacement_range,
    displacements_from_bending,
)

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union

OBSERVED = 5.0  # observations beyond are clipped
_MOST_SERVOS = 8  # there are 2^J - 1 discrete actions at an axial position
_DRAWN = 64  # targets drawn to see whether a world leaves room for any


class EnvState(NamedTuple):
    """An episode."""

    displacements: Float[Array, " SJ"]  # [m]
    target: Float[Array, " SJ"]  # [m]
    goal: Float[Array, "S 2"]  # bending vectors of the target [rad]
    axial: Int[Array, ""]  # axial position, from 1; 0: not known
    servos: Int[Array, ""]  # bit s is set where servo s + 1 is available
    steps: Int[Array, ""]
    key: Array  # of what is still to be drawn


class Outcome(NamedTuple):
    """What a step brought."""

    reward: Float[Array, ""]  # minus the cost, and minus the penalty if the episode ends unsolved
    cost: Float[Array, ""]  # the planners' cost of the step; 0 of a forbidden one
    terminated: Bool[Array, ""]  # solved or forbidden
    truncated: Bool[Array, ""]  # out of time
    solved: Bool[Array, ""]
    forbidden: Bool[Array, ""]  # by a collision or an undefined state: the arm has not moved
    useful: Bool[Array, ""]  # some tendon was to move


class Part(NamedTuple):
    """Of the observation."""

    name: str
    size: int
    low: float
    high: float
    unit: str


class Tdma:
    """An environment: the configuration on its robot, with the tables that a step looks up.

    Args:
        config: The task.
        terms: Your own cost terms by name, as in ``Problem.terms``; each needs a weight.
        robot: Instead of the one that the configuration names.

    Raises:
        ConfigError: A configuration that the robot or the world cannot satisfy.
    """

    def __init__(
        self,
        config: TdmaConfig,
        terms: Mapping[str, Term] | None = None,
        robot: Robot | None = None,
    ) -> None:
        self.config, self.terms = config, dict(terms or {})
        self.robot = load_robot(config.robot) if robot is None else robot
        self.n_axial, self.n_servos = self.robot.axial_map.shape
        self.n_subsets = 2**self.n_servos - 1
        self.n_actions = self.n_axial * self.n_subsets
        if self.n_servos > _MOST_SERVOS:
            raise ConfigError(
                f"robot: {self.n_servos} servos have {self.n_actions} discrete actions; "
                f"at most {_MOST_SERVOS} servos are possible"
            )
        self.start = np.zeros(self.robot.n_tendons)
        if config.start_mm is not None:
            self.start = 1e-3 * np.array(config.start_mm)
        self.problem = self._checked_problem()
        self._compiled_terms = self.problem.compiled_terms()
        self._cheap_terms = self.problem.compiled_terms(expensive=False)
        self._servo_sets = np.array([servo_bits(servos) for servos in self._sets], np.int32)
        self._servo_of, self._stop = _servo_table(self.robot), _stop_table(self.robot)
        self._check_reach()
        self._range = displacement_range(self.robot)
        self._scale = np.abs(self._range).max(axis=1)
        if self.problem.max_step is not None:
            self._scale = np.full(self.robot.n_tendons, self.problem.max_step)
        self._check_room()

    def __reduce__(self) -> tuple[Any, ...]:
        """Built anew from what it was built from, in another process too."""
        document = self.robot.config.model_dump_json(by_alias=True)
        return _rebuilt, (self.config, self.terms, document, jax.tree.leaves(self.robot))

    @property
    def _sets(self) -> tuple[tuple[int, ...], ...]:
        every = range(1, self.n_servos + 1)
        chosen = (c for size in every for c in combinations(every, size))
        return self.config.servo_sets or tuple(
            c for c in chosen if self.robot.reach(c).any(axis=0).all()
        )

    def _checked_problem(self) -> Problem:
        """The problem whose terms and limits are the environment's; its target is the start."""
        config = self.config
        axial = config.axial if isinstance(config.axial, int) else None
        try:
            problem = Problem(
                self.start,
                self.start,
                servos=tuple({s for servos in self._sets for s in servos}),
                max_step=None if config.max_step_mm is None else 1e-3 * config.max_step_mm,
                tolerance=1e-3 * config.tolerance_mm,
                preset=config.preset,
                weights=config.weights,
                terms=self.terms,
                axial=axial,
                world=None if config.world is None else load_world(config.world),
            )
            check_problem(self.robot, problem)
        except ValueError as error:
            raise ConfigError(f"environment: {error}") from None
        return problem

    def _check_reach(self) -> None:
        """Every tendon must be reached by the servos that an episode may be left with."""
        sets = self._sets
        if self.config.servo_failure > 0:
            sets = tuple((servo,) for servo in self.problem.servos)
        for servos in sets:
            missed = ~self.robot.reach(servos).any(axis=0)
            if missed.any():
                raise ConfigError(
                    f"servo_sets: servos {servos} do not reach tendon {int(np.argmax(missed)) + 1}"
                )

    def _check_room(self) -> None:
        """Targets are drawn until one is clear, so some must be."""
        world = self.problem.world
        if world is None:
            return
        drawn = jax.vmap(self._drawn, (0, None))(jax.random.split(jax.random.key(0), _DRAWN), 1.0)
        if all(not clearance_of(self.robot, np.asarray(at), world) >= 0 for at in drawn):
            raise ConfigError(f"theta_rad: no target of {_DRAWN} is clear of {self.config.world}")

    @property
    def parts(self) -> tuple[Part, ...]:
        """What an observation consists of, in order."""
        s, sj = self.robot.n_segments, self.robot.n_tendons
        far = OBSERVED
        prices = (Part("prices", sj, 0.0, far, "cost"),) if self.config.lookahead else ()
        return (
            Part("residual", sj, -far, far, "tendon radii"),
            Part("unfinished", sj, 0.0, 1.0, "-"),
            Part("bending", 2 * s, -far, far, "rad"),
            Part("goal_bending", 2 * s, -far, far, "rad"),
            Part("bent_beyond_goal", s, -far, far, "rad"),
            Part("axial", self.n_axial, 0.0, 1.0, "-"),
            Part("servos", self.n_servos, 0.0, 1.0, "-"),
            Part("time_left", 1, 0.0, 1.0, "-"),
            *prices,
        )

    @property
    def n_observed(self) -> int:
        """Length of an observation."""
        return sum(part.size for part in self.parts)

    def reset(
        self,
        key: Array,
        level: Array | float = 1.0,
        *,
        start: Float[Array, " SJ"] | None = None,
        target: Float[Array, " SJ"] | None = None,
        axial: Int[Array, ""] | int | None = None,
        servos: Int[Array, ""] | int | None = None,
    ) -> EnvState:
        """A new episode; what is not given is drawn as the configuration says.

        Args:
            key: Of all that is drawn, now and later.
            level: Share of the targets' range to draw from: see ``Difficulty``.
            start: Displacements [m].
            target: Displacements [m].
            axial: Axial position, from 1; 0: not known.
            servos: Bit s is set where servo s + 1 is available.
        """
        config, dtype = self.config, jnp.result_type(float)
        key, for_target, for_start, for_rest = jax.random.split(key, 4)
        chance = jax.random.uniform(for_rest, (3,))
        if target is None:
            target = self._clear(for_target, level)
        if start is None:
            start = jnp.asarray(self.start)
            if config.bent > 0:
                start = jnp.where(chance[0] < config.bent, self._clear(for_start, level), start)
        if axial is None:
            axial = self.problem.axial or 0
            if config.axial == "random":
                axial = _one_of(chance[1], np.arange(1, self.n_axial + 1))
        if servos is None:
            servos = _one_of(chance[2], self._servo_sets)
        target = jnp.asarray(target, dtype)
        return EnvState(
            displacements=jnp.asarray(start, dtype),
            target=target,
            goal=bending_from_displacements(_in_precision(self.robot), target),
            axial=jnp.asarray(axial, jnp.int32),
            servos=jnp.asarray(servos, jnp.int32),
            steps=jnp.zeros((), jnp.int32),
            key=key,
        )

    def _drawn(self, key: Array, level: Array | float) -> Float[Array, " SJ"]:
        low, high = self.config.theta_rad
        chance = jax.random.uniform(key, (2, self.robot.n_segments))
        theta = jnp.minimum(low + level * (high - low) * chance[0], self.robot.theta_max)
        phi = 2 * np.pi * chance[1]
        b = theta[:, None] * jnp.stack([jnp.cos(phi), jnp.sin(phi)], axis=-1)
        return displacements_from_bending(_in_precision(self.robot), b)

    def _clear(self, key: Array, level: Array | float) -> Float[Array, " SJ"]:
        """Displacements drawn, and drawn anew until the arm touches nothing there."""
        if self.problem.world is None:
            return self._drawn(key, level)
        robot, world = _in_precision((self.robot, self.problem.world))

        def again(tried: tuple[Array, Array]) -> tuple[Array, Array]:
            key, sub = jax.random.split(tried[0])
            return key, self._drawn(sub, level)

        def touches(tried: tuple[Array, Array]) -> Array:
            return ~(clearance_at(robot, tried[1], world) >= 0.0)

        return jax.lax.while_loop(touches, again, again((key, key)))[1]

    def step(self, state: EnvState, action: Array) -> tuple[EnvState, Outcome]:
        """One step. An action that moves nothing still turns the drum, and costs that.

        Args:
            state: Before it.
            action: A number below ``n_actions``, or A preferences and J displacements in [-1, 1].

        Raises:
            ValueError: An action of another shape or kind of number.
        """
        config = self.config
        robot, (terms, weights) = _in_precision((self.robot, self._compiled_terms))
        axial, move, valid = self._command(state, action)
        repositions = axial != state.axial
        engages = ~repositions & (state.steps == 0)
        dtype = state.displacements.dtype
        moved = step(
            robot,
            state.displacements,
            move,
            repositions.astype(dtype),
            engages.astype(dtype),
            _angles(state.goal),
        )
        cost = transition_cost(robot, terms, weights, moved)
        forbidden = ~(jnp.all(jnp.isfinite(moved.theta_after)) & jnp.isfinite(cost))
        cost = jnp.where(forbidden, 0.0, cost)
        after = jnp.where(forbidden, state.displacements, moved.after)
        steps = state.steps + 1
        solved = ~jnp.any(self._unfinished(after, state.target))
        terminated = solved | forbidden
        truncated = ~terminated & (steps >= config.time_limit)
        penalty = jnp.where(forbidden | truncated, config.unsolved_penalty, 0.0)
        key, servos = state.key, state.servos
        if config.servo_failure > 0:
            key, sub = jax.random.split(key)
            servos = self._after_a_failure(servos, jax.random.uniform(sub, (2,)))
        next_state = state._replace(
            displacements=after,
            axial=jnp.where(forbidden, state.axial, axial).astype(jnp.int32),
            servos=servos,
            steps=steps,
            key=key,
        )
        return next_state, Outcome(
            reward=-(cost + penalty).astype(dtype),
            cost=cost.astype(dtype),
            terminated=terminated,
            truncated=truncated,
            solved=solved,
            forbidden=forbidden,
            useful=valid & jnp.any(move != 0.0),
        )

    def _unfinished(self, displacements: Array, target: Array) -> Bool[Array, " SJ"]:
        return jnp.abs(target - displacements) > self.problem.tolerance

    def _command(self, state: EnvState, action: Array) -> tuple[Array, Array, Array]:
        """Axial position, displacement of every tendon [m], and whether the action exists."""
        action = jnp.asarray(action)
        discrete = self.config.actions == "discrete"
        kind = jnp.integer if discrete else jnp.floating
        shape = () if discrete else (self.n_axial + self.n_servos,)
        if action.shape != shape or not jnp.issubdtype(action.dtype, kind):
            wanted = "whole number" if discrete else f"float array of shape {shape}"
            raise ValueError(
                f"action: must be a {wanted}, found {action.dtype} of shape {action.shape}"
            )
        return (self._subset if discrete else self._signed)(state, action)

    def _subset(self, state: EnvState, action: Array) -> tuple[Array, Array, Array]:
        """The planners' clipped moves of the unfinished tendons that the subset meets."""
        valid = (action >= 0) & (action < self.n_actions)
        place = jnp.clip(action // self.n_subsets, 0, self.n_axial - 1)
        servos = (action % self.n_subsets + 1) & state.servos
        chosen = (servos >> jnp.asarray(self._servo_of)[place]) & 1
        moves = valid & (chosen == 1) & self._unfinished(state.displacements, state.target)
        move = jnp.where(moves, self._clipped(state), 0.0)
        return jnp.where(valid, place + 1, state.axial), move, valid

    def _clipped(self, state: EnvState) -> Float[Array, " SJ"]:
        residual = state.target - state.displacements
        if self.problem.max_step is None:
            return residual
        return jnp.clip(residual, -self.problem.max_step, self.problem.max_step)

    def _signed(self, state: EnvState, action: Array) -> tuple[Array, Array, Array]:
        """Displacements of either sign, within the tendons' ranges."""
        valid = jnp.all(jnp.isfinite(action))
        place = jnp.argmax(action[: self.n_axial])
        servo = jnp.asarray(self._servo_of)[place]
        met = (state.servos >> servo) & 1 == 1
        share = jnp.clip(jnp.append(action[self.n_axial :], 0.0), -1.0, 1.0)
        wanted = share[jnp.minimum(servo, self.n_servos)] * self._scale
        residual = state.target - state.displacements
        wanted = jnp.where(
            jnp.abs(wanted - residual) <= 1e-3 * self.config.snap_mm, residual, wanted
        )
        if self.problem.max_step is not None:
            wanted = jnp.clip(wanted, -self.problem.max_step, self.problem.max_step)
        low, high = self._range.T
        within = jnp.clip(wanted, low - state.displacements, high - state.displacements)
        return jnp.where(valid, place + 1, state.axial), jnp.where(valid & met, within, 0.0), valid

    def _after_a_failure(self, servos: Array, chance: Array) -> Array:
        """Available servos, less a random one with the configured probability."""
        bits = 1 << np.arange(self.n_servos)
        there = (servos & bits) != 0
        count = jnp.sum(there)
        which = jnp.floor(chance[1] * count).astype(jnp.int32)
        lost = jnp.sum(jnp.where(there & (jnp.cumsum(there) - 1 == which), bits, 0))
        fails = (chance[0] < self.config.servo_failure) & (count > 1)
        return jnp.where(fails, servos & ~lost, servos).astype(jnp.int32)

    def action_mask(self, state: EnvState) -> Bool[Array, " actions"]:
        """Discrete actions of which every servo is available and meets an unfinished tendon.

        Of axial positions at which the available servos meet the same tendons one is allowed: the
        present one, or the lowest. Nothing is allowed once the target is reached.
        """
        unfinished = self._unfinished(state.displacements, state.target)
        bits = 1 << np.arange(self.n_servos)
        meets = jnp.sum(jnp.where(unfinished[self.robot.axial_map], bits, 0), axis=-1)
        stop = jnp.asarray(self._stop)[state.servos]
        places = np.arange(self.n_axial)
        present = state.axial - 1
        stays = (present >= 0) & (stop == stop[jnp.maximum(present, 0)])
        allowed = jnp.where(stays, places == present, places == stop)
        subsets = np.arange(1, self.n_subsets + 1)
        fits = (subsets & ~(meets & state.servos)[:, None]) == 0
        return (fits & allowed[:, None]).reshape(-1)

    def observe(self, state: EnvState) -> Float[Array, " observed"]:
        """What an agent sees: ``parts``, in float32."""
        residual = state.target - state.displacements
        b = bending_from_displacements(_in_precision(self.robot), state.displacements)
        places, servos = np.arange(1, self.n_axial + 1), np.arange(self.n_servos)
        prices = [self._prices(state)] if self.config.lookahead else []
        seen = jnp.concatenate(
            [
                residual / self.robot.tendon_radius,
                self._unfinished(state.displacements, state.target),
                b.reshape(-1),
                state.goal.reshape(-1),
                _angles(b) - _angles(state.goal),
                places == state.axial,
                (state.servos >> servos) & 1,
                (self.config.time_limit - state.steps[None]) / self.config.time_limit,
                *prices,
            ],
            dtype=jnp.float32,
        )
        return jnp.clip(seen, -OBSERVED, OBSERVED)

    def _prices(self, state: EnvState) -> Float[Array, " SJ"]:
        """Cost of every tendon's clipped move alone, without the expensive terms and the drum."""
        robot, (terms, weights) = _in_precision((self.robot, self._cheap_terms))
        unfinished = self._unfinished(state.displacements, state.target)
        moves = jnp.diag(jnp.where(unfinished, self._clipped(state), 0.0))
        still = jnp.zeros(len(moves), moves.dtype)
        moved = step(robot, state.displacements, moves, still, still, _angles(state.goal))
        cost = transition_cost(robot, terms, weights, moved)
        cost = jnp.where(jnp.isfinite(cost), cost, OBSERVED)
        return jnp.where(unfinished, cost, 0.0)

    def autoreset(self, state: EnvState, outcome: Outcome, level: Array | float = 1.0) -> EnvState:
        """The state to go on from after a step: a new episode where this one has ended.

        The last state of the episode is the argument, so its observation is not lost.
        """
        key, sub = jax.random.split(state.key)
        fresh = self.reset(sub, level)._replace(key=key)
        done = outcome.terminated | outcome.truncated
        return jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, state)


def _rebuilt(
    config: TdmaConfig, terms: dict[str, Term], document: str, leaves: list[Array]
) -> Tdma:
    robot = robot_from_config(RobotConfig.model_validate_json(document))
    return Tdma(config, terms, jax.tree.unflatten(jax.tree.structure(robot), leaves))


def servo_bits(servos: tuple[int, ...]) -> int:
    """Servos, from 1, as the bits of ``EnvState.servos``."""
    return sum(1 << (servo - 1) for servo in servos)


def _in_precision(tree: Any) -> Any:
    """Arrays in the precision that is traced now, for a compiled function to close over.

    JAX keeps constants by the array that they came from: one that is closed over in float32 would
    be handed to the planners' float64 code too.
    """

    def cast(leaf: Any) -> Any:
        if isinstance(leaf, (np.ndarray, jax.Array)) and leaf.dtype.kind == "f":
            return jnp.asarray(np.asarray(leaf, dtype=jnp.result_type(float)))
        return leaf

    return jax.tree.map(cast, tree)


def _angles(b: Float[Array, "S 2"]) -> Float[Array, " S"]:
    """Bending angles [rad], as ``motion.bending_angles``."""
    return jnp.sqrt(jnp.sum(b * b, axis=-1))


def _one_of(chance: Float[Array, ""], choices: Int[np.ndarray, " n"]) -> Int[Array, ""]:
    return jnp.asarray(choices)[jnp.floor(chance * len(choices)).astype(jnp.int32)]


def _servo_table(robot: Robot) -> Int[np.ndarray, "A SJ"]:
    """Servo, from 0, that meets each tendon at each axial position; J where none does."""
    table = np.full((len(robot.axial_map), robot.n_tendons), robot.tendons_per_segment, np.int32)
    servos = np.broadcast_to(np.arange(robot.tendons_per_segment), robot.axial_map.shape)
    np.put_along_axis(table, robot.axial_map, servos.astype(np.int32), axis=1)
    return table


def _stop_table(robot: Robot) -> Int[np.ndarray, "sets A"]:
    """By available servos, the lowest axial position, from 0, where they meet the same tendons."""
    count = robot.tendons_per_segment
    rows = []
    for bits in range(2**count):
        reach = robot.reach(tuple(s + 1 for s in range(count) if bits >> s & 1))
        rows.append(np.argmax((reach[:, None] == reach[None]).all(axis=-1), axis=1))
    return np.array(rows, np.int32)
