"""Learned rewards for other programs: :func:`load_reward` gives a plain function of arrays."""

from __future__ import annotations

import reprlib
from numbers import Real
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from irlcli.store import Store, store_around

if TYPE_CHECKING:
    from gymnasium import Space

    from irlcli.learners.frozen import FrozenReward
    from irlcli.learners.standalone import StandaloneReward


class LearnedReward:
    """A frozen reward: ``reward(obs, act, next_obs, done)`` gives the reward of each step.

    It is what ``irl transfer`` trains policies on, before any normalisation by the algorithm: g
    divided by its standard deviation on training data, not centred.

    Attributes:
        env: name of the environment it was learned in.
        settings: the settings it was learned in.
        method, seed: how it was learned.
        observation_size: D.
        action_size: A, or the number of choices if actions are indices.
        discrete: whether actions are indices.
        choices: number of choices of each of K indices; empty if an action is one index or none.
    """

    def __init__(self, frozen: FrozenReward, description: Any):
        self._frozen = frozen
        self.env: str = description.env
        self.settings: tuple[str, ...] = description.settings
        self.method: str = description.method
        self.seed: int = description.seed
        network = description.network
        self.observation_size: int = network.observation_size
        self.action_size: int = network.action_size
        self.discrete: bool = network.discrete
        self.choices: tuple[int, ...] = network.choices

    def __repr__(self) -> str:
        settings = ", ".join(self.settings)
        return f"<LearnedReward {self.env} {settings}, {self.method}, seed {self.seed}>"

    def __call__(
        self,
        obs: np.ndarray,
        act: np.ndarray,
        next_obs: np.ndarray,
        done: np.ndarray,
    ) -> np.ndarray:
        """The reward [B] float32 of B steps.

        Args:
            obs, next_obs: [B, D]. After a step that ends an episode, ``next_obs`` is that episode's
                last observation, not the first one of the next.
            act: [B, A] vectors, or [B] or [B, K] indices, counted from 0 also where the environment's
                actions begin at another number.
            done: [B] bool, whether the step terminated the episode. A time limit does not
                terminate: pass False for it.

        Raises:
            ValueError: arrays of other shapes, indices of no action, or a ``done`` that is neither
                true nor false.
        """
        from irlcli.trajectories import ActionSpace

        none = np.empty(0)
        space = ActionSpace(self.discrete, self.action_size, none, none, self.choices)
        kind = np.int64 if self.discrete else np.float32
        # Torch warns of arrays that it must not write to, as pyarrow's are.
        observations = np.require(obs, np.float32, ["C", "W"])
        if observations.ndim != 2:
            raise ValueError(
                f"obs is {list(observations.shape)}, not [B, {self.observation_size}]: one transition "
                "is a batch of 1, obs[None]"
            )
        size = len(observations)
        actions = np.require(act, kind, ["C", "W"])
        steps = {
            "obs": (observations, (size, self.observation_size)),
            "act": (actions, (size, *space.shape)),
            "next_obs": (
                np.require(next_obs, np.float32, ["C", "W"]),
                (size, self.observation_size),
            ),
            "done": (np.require(done, bool, ["C", "W"]), (size,)),
        }
        for name, (array, shape) in steps.items():
            if array.shape != shape:
                raise ValueError(f"{name} is {list(array.shape)}, not {list(shape)}")
        if self.discrete:
            truncated = np.asarray(act) != actions
            if (truncated | space.outside(actions)).any():
                last = ", ".join(map(str, np.ravel(space.last)))
                raise ValueError(f"act must hold indices from 0 to {last}")
        if not np.isin(done, (0, 1)).all():
            raise ValueError("done must hold true or false")
        return self._frozen.of_steps(*(array for array, _ in steps.values()))

    def check_spaces(self, observation_space: Space, action_space: Space) -> None:
        """Refuse an environment of other observations or actions, before its first step.

        Raises:
            ValueError: spaces of another kind or size; names both.
        """
        from gymnasium.spaces import Box, Discrete, MultiDiscrete
        from gymnasium.spaces.utils import flatdim

        from irlcli.learners.frozen import actions_in_words

        if not isinstance(observation_space, Box) or not isinstance(
            action_space, Box | Discrete | MultiDiscrete
        ):
            raise ValueError(
                f"the environment has observations in {observation_space} and actions in {action_space}, "
                "the reward takes vectors (Box), and actions in Box, Discrete or MultiDiscrete"
            )
        choices: tuple[int, ...] = ()
        if isinstance(action_space, MultiDiscrete):
            choices = tuple(action_space.nvec.ravel().tolist())
        discrete = isinstance(action_space, Discrete | MultiDiscrete)
        observed, theirs = flatdim(observation_space), (discrete, flatdim(action_space), choices)
        ours = (self.discrete, self.action_size, self.choices)
        if (observed, theirs) != (self.observation_size, ours):
            raise ValueError(
                f"the environment has observations of size {observed} and {actions_in_words(*theirs)}, "
                f"the reward takes {self.observation_size} and {actions_in_words(*ours)}"
            )

    def module(self) -> StandaloneReward:
        """The same function of tensors, as a :class:`torch.nn.Module`."""
        return self._frozen.module

    def about(self) -> dict[str, Any]:
        """Where the reward comes from and what it takes, for a file that leaves the store."""
        return {
            "env": self.env,
            "settings": list(self.settings),
            "method": self.method,
            "seed": self.seed,
            "obs": self.observation_size,
            "act": self.action_size,
            "discrete": self.discrete,
            "choices": list(self.choices),
        }


def load_reward(
    ref: str | PathLike[str],
    store: str | Path = "runs",
    *,
    env: str | None = None,
    setting: str | None = None,
    gamma: float | None = None,
    ceiling: float | None = None,
) -> LearnedReward:
    """The learned reward that ``ref`` names.

    Args:
        ref: name, id or id prefix of an artefact of ``irl train-airl``, what ``Lab.train_airl``
            returned, or a path to a ``reward.pt``.
        store: where names and ids are looked up. A path is read in the store that it lies in.
        env: TOML file of the environment, for a ``reward.pt`` outside a store that was learned in
            an environment of one's own.
        setting: the setting it is to be used in, e.g. ``friction=1.5:0.1:0.1``; by default the
            first one it was learned in. A goal or a cue in it changes an observation's size.
        gamma: discount of the policy that is trained on it, for the value of an absorbing state
            (a reward learned with ``airl.fixed_horizon``): from 0 to less than 1. By default
            ``airl.ppo.gamma`` of its config.
        ceiling: bound of g as a quantile of g on the demonstrations, as ``transfer.ceiling``; None:
            unbounded.

    Raises:
        IrlError: ``ref`` names no reward, the reward is damaged, or it does not fit the setting.
    """
    from irlcli.envs.registry import apart, resolve
    from irlcli.errors import IrlError, UsageError
    from irlcli.requests.in_python import in_python

    if not isinstance(ref, str | PathLike):
        raise UsageError(f"ref {reprlib.repr(ref)} is not text or a path", "give a name or an id")
    for name, value in (("gamma", gamma), ("ceiling", ceiling)):
        if not isinstance(value, Real | None):
            raise UsageError(f"{name} {value!r} is not a number", "give a number")
    if gamma is not None and not 0.0 <= gamma < 1.0:
        raise UsageError(
            f"gamma = {gamma:g} is not a discount factor",
            "give a number from 0 up to, but not including, 1",
        )
    if ceiling is not None and not 0.0 <= ceiling <= 1.0:
        raise UsageError(f"ceiling = {ceiling:g} is not a quantile", "give a number from 0 to 1")
    place = fspath(ref)
    try:
        with apart():
            if env is not None:
                resolve(env)
            home = Store(store_around(Path(place)) or Path(store))
            return reward_in(home, place, setting, gamma, ceiling)
    except IrlError as error:
        error.message, error.hint = in_python(error.message), in_python(error.hint)
        raise


def reward_in(
    store: Store,
    ref: str,
    setting: str | None = None,
    gamma: float | None = None,
    ceiling: float | None = None,
) -> LearnedReward:
    """As :func:`load_reward`, in an environment that is known already or described by ``ref``."""
    from irlcli.data.tensors import load_reward_file
    from irlcli.experiments.inputs import checked
    from irlcli.experiments.references import tensor_file
    from irlcli.stages.base import environment_key
    from irlcli.stages.running import frozen_reward

    source, _ = tensor_file(store, ref, "reward")
    model, description = load_reward_file(checked(store, source))
    where = environment_key(description.env)
    frozen = frozen_reward(
        where, setting or description.settings[0], model, description, ceiling, gamma
    )
    return LearnedReward(frozen, description)
