"""Many episodes side by side, stepped by one compiled call; NumPy in and out, no gymnasium.

Both vector adapters stand on this. An ended lane starts a new episode in the same step; the last
observation of the old one is kept in ``Stepped.final``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.tdma import EnvState, Outcome, Tdma, servo_bits
from muxjax.planning.problem import check_ends
from muxjax.planning.world import clearance_of
from muxjax.precision import host_array

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union

OPTIONS = ("target", "start", "axial", "servos")
_LARGEST_SEED = 2**32


class Running(NamedTuple):
    """Episodes under way, and what they have brought."""

    states: EnvState  # a row a lane
    total: Float[Array, " lanes"]  # undiscounted return so far


class Stepped(NamedTuple):
    """What a step of all lanes brought; a row a lane."""

    observation: Float[np.ndarray, "lanes F"]  # to act on next
    final: Float[np.ndarray, "lanes F"]  # at the end of the step, before any new episode
    outcome: Outcome
    total: Float[np.ndarray, " lanes"]  # undiscounted return of the episode with this step
    steps: Int[np.ndarray, " lanes"]  # of the episode with this step
    masks: Bool[np.ndarray, "lanes G"] | None  # of what is possible next; discrete actions only

    @property
    def ended(self) -> Bool[np.ndarray, " lanes"]:
        """Lanes whose episode ended."""
        done: Bool[np.ndarray, " lanes"] = self.outcome.terminated | self.outcome.truncated
        return done


class Lanes:
    """Episodes side by side.

    Args:
        env: The environment.
        count: Lanes.

    Attributes:
        total_steps: Of all lanes together, on which the schedule of difficulty depends.
        masks: Possible actions of each lane, or None where actions are continuous.
    """

    def __init__(self, env: Tdma, count: int) -> None:
        if count < 1:
            raise ValueError(f"lanes: must be at least 1, found {count}")
        self.env, self.count, self.total_steps = env, count, 0
        self.running: Running | None = None
        self.masks: Bool[np.ndarray, "lanes G"] | None = None

    @property
    def level(self) -> float:
        """Share of the targets' range that is drawn from now."""
        difficulty = self.env.config.difficulty
        return 1.0 if difficulty is None else difficulty.level(self.total_steps)

    def reset(
        self, seeds: Sequence[int | None], options: Mapping[str, Any] | None = None
    ) -> Float[np.ndarray, "lanes F"]:
        """New episodes in all lanes.

        Args:
            seeds: Of each lane; None goes on with what it would have drawn next. Where every lane
                has one, the schedule of difficulty begins anew.
            options: See ``checked_options``; one for all lanes, or a row a lane.
        """
        given = checked_options(self.env, options or {})
        for name, value in given.items():
            rows = () if name in ("axial", "servos") else (self.env.robot.n_tendons,)
            given[name] = np.broadcast_to(value, (self.count, *rows))
        if None not in seeds:
            self.total_steps = 0
        kept = None if self.running is None else self.running.states.key
        return self.begin([_key(seed, kept, k) for k, seed in enumerate(seeds)], given)

    def begin(
        self, keys: Sequence[Array], given: Mapping[str, Array]
    ) -> Float[np.ndarray, "lanes F"]:
        """New episodes by keys, and by what is given of ``Tdma.reset``, a row a lane."""
        running, observation, masks = _reset_lanes(
            self.env, jnp.stack(keys), self.level, dict(given)
        )
        self.running, self.masks = running, None if masks is None else np.array(masks)
        return np.array(observation)

    def step(self, actions: np.ndarray) -> Stepped:
        """One step of every lane, and new episodes where it was the last.

        Raises:
            ValueError: Actions of another shape or kind, or that do not exist.
        """
        if self.running is None:
            raise ValueError("step: reset comes first")
        actions = checked_actions(self.env, actions, (self.count,))
        self.running, *stepped = _step_lanes(self.env, self.running, actions, self.level)
        self.total_steps += self.count
        found = Stepped(*jax.tree.map(np.array, stepped))
        self.masks = found.masks
        return found


def _key(seed: int | None, kept: Array | None, lane: int) -> Array:
    if seed is not None:
        return jax.random.key(seed % _LARGEST_SEED)
    if kept is None:
        return jax.random.key(int(np.random.default_rng().integers(_LARGEST_SEED)))
    return jax.random.split(kept[lane])[0]


def checked_actions(env: Tdma, actions: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
    """Actions as the environment takes them.

    Raises:
        ValueError: Of another shape or kind of number, not finite, or that do not exist.
    """
    found = np.asarray(actions)
    discrete = env.config.actions == "discrete"
    shape = batch if discrete else (*batch, env.n_axial + env.n_servos)
    kinds = "iu" if discrete else "f"
    if found.shape != shape or found.dtype.kind not in kinds:
        wanted = "whole numbers" if discrete else "floats"
        raise ValueError(
            f"action: must be {wanted} of shape {shape}, found {found.dtype} of shape {found.shape}"
        )
    if discrete and ((found < 0) | (found >= env.n_actions)).any():
        raise ValueError(f"action: must be 0 to {env.n_actions - 1}, found {found}")
    if not np.isfinite(found).all():
        raise ValueError(f"action: must be finite, found {found}")
    return found.astype(np.int32 if discrete else np.float32)


def checked_options(env: Tdma, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a reset as ``Tdma.reset`` takes them.

    Args:
        env: The environment.
        options: "target" and "start": displacements [m], one or a row a lane; "axial": a position
            from 1; "servos": available servos from 1.

    Raises:
        ValueError: Another option, or one that the robot or the world cannot satisfy.
    """
    unknown = set(options) - set(OPTIONS)
    if unknown:
        raise ValueError(f"options: must be of {', '.join(OPTIONS)}; found {sorted(unknown)}")
    names = {name: f"options[{name!r}]" for name in OPTIONS}
    given: dict[str, Any] = {
        name: host_array(names[name], options[name], env.robot.n_tendons)
        for name in ("start", "target")
        if options.get(name) is not None
    }
    start = given.get("start", env.start)
    target = given.get("target", start)
    check_ends(env.robot, names["start"], start, names["target"], target)
    if "target" in given and (np.abs(target - start).max(axis=-1) <= env.problem.tolerance).any():
        raise ValueError(f"{names['target']}: is the start")
    for name, world in ((n, env.problem.world) for n in given):
        rows = given[name].reshape(-1, env.robot.n_tendons)
        if world is not None and not all(clearance_of(env.robot, at, world) >= 0 for at in rows):
            raise ValueError(f"{names[name]}: the arm is in an obstacle or itself")
    if options.get("axial") is not None:
        given["axial"] = _checked_axial(env, options["axial"])
    if options.get("servos") is not None:
        given["servos"] = _checked_servos(env, options["servos"])
    return given


def _checked_axial(env: Tdma, axial: Any) -> int:
    if not isinstance(axial, (int, np.integer)) or not 1 <= axial <= env.n_axial:
        raise ValueError(f"options['axial']: must be 1 to {env.n_axial}, found {axial!r}")
    return int(axial)


def _checked_servos(env: Tdma, servos: Any) -> int:
    chosen = tuple(int(s) for s in servos)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(env.problem.servos):
        raise ValueError(
            f"options['servos']: must be a non-empty set of {env.problem.servos}, found {servos!r}"
        )
    missed = ~env.robot.reach(chosen).any(axis=0)
    if missed.any():
        raise ValueError(f"options['servos']: no one reaches tendon {int(np.argmax(missed)) + 1}")
    return servo_bits(chosen)


def _masks(env: Tdma, states: EnvState) -> Bool[Array, "lanes G"] | None:
    return jax.vmap(env.action_mask)(states) if env.config.actions == "discrete" else None


@partial(jax.jit, static_argnums=0)
def _reset_lanes(
    env: Tdma, keys: Array, level: Float[Array, ""], given: dict[str, Array]
) -> tuple[Running, Array, Array | None]:
    states = jax.vmap(lambda key, own: env.reset(key, level, **own))(keys, given)
    running = Running(states, jnp.zeros_like(states.displacements[:, 0]))
    return running, jax.vmap(env.observe)(states), _masks(env, states)


@partial(jax.jit, static_argnums=0)
def _step_lanes(
    env: Tdma, running: Running, actions: Array, level: Float[Array, ""]
) -> tuple[Running, Array, Array, Outcome, Array, Array, Array | None]:
    after, outcome = jax.vmap(env.step)(running.states, actions)
    states = jax.vmap(env.autoreset, (0, 0, None))(after, outcome, level)
    total = running.total + outcome.reward
    done = outcome.terminated | outcome.truncated
    observe = jax.vmap(env.observe)
    return (
        Running(states, jnp.where(done, 0.0, total)),
        observe(states),
        observe(after),
        outcome,
        total,
        after.steps,
        _masks(env, states),
    )
