"""The environment as a vectorised one of Stable-Baselines3: one compiled step for all lanes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from envs.config import TdmaConfig
from envs.gymnasium_adapter import action_space, made, observation_space, pictures
from envs.lanes import Lanes
from muxjax.planning.terms import Term
from muxjax.robot import Robot


class TdmaVecEnv(VecEnv):
    """Many episodes in float32; an ended one is followed by a new one in the same step.

    Its last observation is ``info["terminal_observation"]``, whether only time ran out
    ``info["TimeLimit.truncated"]``, and ``info["episode"]`` what ``VecMonitor`` would say.

    Args:
        config: Configuration, or a shipped one by name, or a YAML file by path.
        num_envs: Episodes side by side.
        seed: Lane k begins with seed + k.
        terms: Your own cost terms by name, each with a weight in the configuration.
        robot: Instead of the one that the configuration names.
        render_mode: "rgb_array" or None.
    """

    def __init__(
        self,
        config: str | TdmaConfig = "muxarm",
        num_envs: int = 512,
        seed: int | None = None,
        terms: Mapping[str, Term] | None = None,
        robot: Robot | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: must be rgb_array or None, found {render_mode!r}")
        self.render_mode = render_mode
        self.lanes = Lanes(made(config, terms, robot), num_envs)
        self._actions: np.ndarray | None = None
        self.num_envs = num_envs
        super().__init__(num_envs, observation_space(self.lanes.env), action_space(self.lanes.env))
        if seed is not None:
            self.seed(seed)

    def reset(self) -> np.ndarray:
        """New episodes, by what ``seed`` and ``set_options`` have said."""
        options = self._shared_options()
        self._reset_options()
        seeds = list(self._seeds)
        self._reset_seeds()
        return self.lanes.reset(seeds, options)

    def _shared_options(self) -> dict[str, Any]:
        """Options of all lanes, stacked."""
        names = {frozenset(own) for own in self._options}
        if len(names) > 1:
            raise ValueError("options: must name the same things in every lane")
        found: dict[str, Any] = {}
        for name in next(iter(names)):
            values = [own[name] for own in self._options]
            alike = name in ("axial", "servos")
            if alike and any(value != values[0] for value in values):
                raise ValueError(f"options[{name!r}]: must be the same in every lane")
            found[name] = values[0] if alike else np.array(values)
        return found

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One step of every lane."""
        found = self.lanes.step(np.asarray(self._actions))
        ended, outcome = found.ended, found.outcome
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(ended):
            infos[k] = {
                "terminal_observation": found.final[k],
                "TimeLimit.truncated": bool(outcome.truncated[k]),
                "is_success": bool(outcome.solved[k]),
                "forbidden": bool(outcome.forbidden[k]),
                "episode": {"r": float(found.total[k]), "l": int(found.steps[k])},
            }
        return found.observation, outcome.reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """Nothing is held."""

    def action_masks(self) -> np.ndarray:
        """Which discrete actions are possible in each lane."""
        if self.lanes.masks is None:
            raise AttributeError("action_masks: continuous actions have none")
        return self.lanes.masks

    def get_images(self) -> list[np.ndarray | None]:
        """A picture of every lane."""
        return [] if self.render_mode is None else [*pictures(self.lanes)]

    def has_attr(self, attr_name: str) -> bool:
        """Whether lanes have an attribute; masks are one of discrete actions."""
        if attr_name == "action_masks":
            return self.lanes.env.config.actions == "discrete"
        return hasattr(self, attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute, which lanes share."""
        return [getattr(self, attr_name) for _ in self._rows(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all lanes together.

        Raises:
            ValueError: For some lanes only.
        """
        if len(self._rows(indices)) < self.num_envs:
            raise ValueError(f"set_attr: {attr_name} is shared by all lanes")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """What each lane answers; sb3-contrib asks for "action_masks" in this way."""
        if method_name != "action_masks":
            raise AttributeError(f"env_method: lanes have only action_masks, not {method_name!r}")
        masks = self.action_masks()
        return [masks[k] for k in self._rows(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Lanes report their episodes as a Monitor does."""
        return [issubclass(wrapper_class, Monitor) for _ in self._rows(indices)]

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        if indices is None:
            return list(range(self.num_envs))
        return list(indices) if isinstance(indices, Iterable) else [indices]
