"""The environment in Gymnasium's API.

Importing this file registers ``muxjax/TDMA-v0`` (discrete actions) and
``muxjax/TDMA-Continuous-v0`` (one Box). Gymnasium 1.x loads no plugins, so either import this file,
or let Gymnasium do so: ``gymnasium.make("envs.gymnasium_adapter:muxjax/TDMA-v0")``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from envs.config import TdmaConfig, load_env_config
from envs.lanes import Lanes, checked_actions, checked_options
from envs.tdma import EnvState, Outcome, Tdma
from muxjax.planning.terms import Term
from muxjax.robot import Robot

DISCRETE, CONTINUOUS = "muxjax/TDMA-v0", "muxjax/TDMA-Continuous-v0"
_FRAMES_A_SECOND = 2
_RENDER_MODES = ("human", "rgb_array")
_LARGEST_SEED = 2**31


def made(
    config: str | TdmaConfig, terms: Mapping[str, Term] | None = None, robot: Robot | None = None
) -> Tdma:
    """The core of a configuration, or of one named by a shipped name or a path."""
    return Tdma(load_env_config(config) if isinstance(config, str) else config, terms, robot)


def observation_space(env: Tdma) -> gymnasium.spaces.Box:
    """Box of an observation: ``Tdma.parts``."""
    low = np.concatenate([np.full(part.size, part.low, np.float32) for part in env.parts])
    high = np.concatenate([np.full(part.size, part.high, np.float32) for part in env.parts])
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def action_space(env: Tdma) -> gymnasium.spaces.Discrete | gymnasium.spaces.Box:
    """Space of an action."""
    if env.config.actions == "discrete":
        return gymnasium.spaces.Discrete(env.n_actions)
    return gymnasium.spaces.Box(-1.0, 1.0, (env.n_axial + env.n_servos,), np.float32)


class TdmaEnv(gymnasium.Env[np.ndarray, Any]):
    """One episode at a time, in float64: NumPy in, NumPy out.

    Args:
        config: Configuration, or a shipped one by name, or a YAML file by path.
        terms: Your own cost terms by name, each with a weight in the configuration.
        robot: Instead of the one that the configuration names.
        render_mode: "rgb_array", "human" or None.

    Raises:
        ConfigError: A configuration that cannot be used.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - so the base class declares it
        "render_modes": list(_RENDER_MODES),
        "render_fps": _FRAMES_A_SECOND,
    }

    def __init__(
        self,
        config: str | TdmaConfig = "muxarm",
        terms: Mapping[str, Term] | None = None,
        robot: Robot | None = None,
        render_mode: str | None = None,
    ) -> None:
        _check_render_mode(render_mode)
        self.core = made(config, terms, robot)
        self.observation_space = observation_space(self.core)
        self.action_space = action_space(self.core)
        self.render_mode = render_mode
        self.total_steps = 0
        self._state: EnvState | None = None
        self._ended = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode.

        Args:
            seed: Of all that is drawn from now on; the schedule of difficulty begins anew too.
            options: Any of "target", "start", "axial", "servos": see ``lanes.checked_options``.
        """
        super().reset(seed=seed)
        given = checked_options(self.core, options or {})
        if any(np.ndim(given.get(name, [0.0])) != 1 for name in ("start", "target")):
            raise ValueError("options: target and start must be vectors")
        number = int(self.np_random.integers(_LARGEST_SEED)) if seed is None else seed
        if seed is not None:
            self.total_steps = 0
        difficulty = self.core.config.difficulty
        level = 1.0 if difficulty is None else difficulty.level(self.total_steps)
        with jax.enable_x64(True):
            self._state = _on_host(_reset(self.core, jax.random.key(number), level, given))
            observation = np.array(_observe(self.core, self._state))
        self._ended = False
        if self.render_mode == "human":
            self.render()
        return observation, {**_where(self._state), "target": np.array(self._state.target)}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step; docs/envs.md lists the info keys.

        Raises:
            ValueError: An action that does not exist, of another shape or kind of number.
            ResetNeeded: The episode has ended, or none has begun.
        """
        checked = checked_actions(self.core, action)
        state = self._running()
        if self._ended:
            raise ResetNeeded("the episode has ended: reset comes first")
        with jax.enable_x64(True):
            after, found = _step(self.core, state, checked)
            self._state = _on_host(after)
            observation = np.array(_observe(self.core, self._state))
        self.total_steps += 1
        terminated, truncated = bool(found.terminated), bool(found.truncated)
        self._ended = terminated or truncated
        if self.render_mode == "human":
            self.render()
        info = {**_where(self._state), **{k: v.item() for k, v in _informed(found).items()}}
        return observation, float(found.reward), terminated, truncated, info

    def action_masks(self) -> Bool[np.ndarray, " actions"]:
        """Which discrete actions are possible, as sb3-contrib asks for them.

        Raises:
            ValueError: Continuous actions have no mask.
        """
        _check_masked(self.core)
        with jax.enable_x64(True):
            return np.array(_mask(self.core, self._running()))

    def render(self) -> Any:
        """The arm, and pale where it is to go: an RGB picture, or a window."""
        if self.render_mode is None:
            gymnasium.logger.warn("render_mode is None: name one in gymnasium.make")
            return None
        state = self._running()
        picture = _picture(self.core, np.array(state.displacements), np.array(state.target), state)
        if self.render_mode == "rgb_array":
            return picture
        _show(picture)
        return None

    def close(self) -> None:
        """Close the window, if any."""
        if self.render_mode == "human":
            _close()

    def _running(self) -> EnvState:
        if self._state is None:
            raise ResetNeeded("no episode has begun: reset comes first")
        return self._state


class TdmaVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many episodes, stepped by one compiled call in float32.

    An ended episode is followed by a new one in the same step (``AutoresetMode.SAME_STEP``): its
    last observation is ``infos["final_obs"]``, its last info ``infos["final_info"]``.

    Args:
        num_envs: Episodes side by side.
        config: As of ``TdmaEnv``.
        terms: As of ``TdmaEnv``.
        robot: As of ``TdmaEnv``.
        render_mode: "rgb_array" or None.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - so the base class declares it
        "render_modes": ["rgb_array"],
        "render_fps": _FRAMES_A_SECOND,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        config: str | TdmaConfig = "muxarm",
        terms: Mapping[str, Term] | None = None,
        robot: Robot | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: must be rgb_array or None, found {render_mode!r}")
        self.core = made(config, terms, robot)
        self.lanes = Lanes(self.core, num_envs)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = observation_space(self.core)
        self.single_action_space = action_space(self.core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes: lane k gets seed + k, or the k-th of several seeds."""
        if seed is None or isinstance(seed, (int, np.integer)):
            super().reset(seed=seed)
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed: {self.num_envs} are needed, found {len(seeds)}")
        return self.lanes.reset(seeds, options), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every lane."""
        found = self.lanes.step(actions)
        everywhere = np.ones(self.num_envs, bool)
        infos: dict[str, Any] = {}
        for name, value in _informed(found.outcome).items():
            infos[name], infos[f"_{name}"] = value, everywhere
        if found.ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            for k in np.flatnonzero(found.ended):
                last[k] = found.final[k]
            infos["final_obs"], infos["_final_obs"] = last, found.ended
            infos["final_info"] = {}
            for name, value in _informed(found.outcome).items():
                infos["final_info"][name] = np.where(found.ended, value, np.zeros_like(value))
                infos["final_info"][f"_{name}"] = found.ended
            infos["_final_info"] = found.ended
        rewards = found.outcome.reward.astype(np.float64)
        return found.observation, rewards, found.outcome.terminated, found.outcome.truncated, infos

    def action_masks(self) -> Bool[np.ndarray, "lanes actions"]:
        """Which discrete actions are possible in each lane.

        Raises:
            ValueError: Continuous actions have no mask.
        """
        _check_masked(self.core)
        if self.lanes.masks is None:
            raise ResetNeeded("no episode has begun: reset comes first")
        return self.lanes.masks

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every lane."""
        return None if self.render_mode is None else tuple(pictures(self.lanes))


def pictures(lanes: Lanes) -> list[np.ndarray]:
    """A picture of every lane."""
    if lanes.running is None:
        raise ResetNeeded("no episode has begun: reset comes first")
    states = lanes.running.states
    rows = [jax.tree.map(lambda x, k=k: x[k], states) for k in range(lanes.count)]
    return [_picture(lanes.env, np.array(s.displacements), np.array(s.target), s) for s in rows]


def _check_render_mode(mode: str | None) -> None:
    if mode not in (None, *_RENDER_MODES):
        raise ValueError(f"render_mode: must be {', '.join(_RENDER_MODES)} or None, found {mode!r}")


def _check_masked(env: Tdma) -> None:
    if env.config.actions != "discrete":
        raise ValueError("action_masks: continuous actions have none")


def _where(state: EnvState) -> dict[str, Any]:
    """Where the arm and its drive stand; axial positions and servos count from 1."""
    servos = int(state.servos)
    return {
        "displacements": np.array(state.displacements),
        "axial": int(state.axial),
        "servos": tuple(s + 1 for s in range(servos.bit_length()) if servos >> s & 1),
    }


def _on_host(state: EnvState) -> EnvState:
    """In NumPy's float64, which a pickle keeps; a JAX array would be read back in float32."""
    arrays = {name: np.array(x) for name, x in state._asdict().items() if name != "key"}
    return state._replace(**arrays)


def _informed(outcome: Outcome) -> dict[str, np.ndarray]:
    return {
        "cost": np.asarray(outcome.cost),
        "is_success": np.asarray(outcome.solved),
        "forbidden": np.asarray(outcome.forbidden),
        "useful": np.asarray(outcome.useful),
    }


def _picture(
    env: Tdma, displacements: Float[np.ndarray, " SJ"], target: np.ndarray, state: EnvState
) -> np.ndarray:
    from muxjax.viz import arm_picture  # matplotlib is loaded only by those who look

    axial = int(state.axial) or "unknown"
    title = f"step {int(state.steps)}, axial position {axial}, servos {_where(state)['servos']}"
    return arm_picture(env.robot, displacements, target, title)


def _show(picture: np.ndarray) -> None:
    import matplotlib.pyplot as plt

    figure = plt.figure("muxjax/TDMA", figsize=(5, 5))
    figure.clear()
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(picture)
    axes.axis("off")
    figure.canvas.draw_idle()
    figure.canvas.flush_events()
    time.sleep(1 / _FRAMES_A_SECOND)


def _close() -> None:
    import matplotlib.pyplot as plt

    plt.close("muxjax/TDMA")


@partial(jax.jit, static_argnums=0)
def _reset(env: Tdma, key: Any, level: float, given: dict[str, Any]) -> EnvState:
    return env.reset(key, level, **given)


@partial(jax.jit, static_argnums=0)
def _step(env: Tdma, state: EnvState, action: Any) -> tuple[EnvState, Outcome]:
    return env.step(state, action)


@partial(jax.jit, static_argnums=0)
def _observe(env: Tdma, state: EnvState) -> Any:
    return env.observe(state)


@partial(jax.jit, static_argnums=0)
def _mask(env: Tdma, state: EnvState) -> Any:
    return env.action_mask(state)


def register() -> None:
    """Make both environments known to Gymnasium."""
    for name, config in ((DISCRETE, "muxarm"), (CONTINUOUS, "muxarm_continuous")):
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point="envs.gymnasium_adapter:TdmaEnv",
                vector_entry_point="envs.gymnasium_adapter:TdmaVectorEnv",
                kwargs={"config": config},
            )


register()
