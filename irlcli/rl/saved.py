"""Experts that stable-baselines3 saved: ``model.save("expert.zip")``, ``venv.save("statistics.pkl")``.

SB3 unpickles what such files hold, and a pickle can run any code. Nothing here is called unless the
user said that the files are trusted.
"""

from __future__ import annotations

import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from contextlib import closing
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from irlcli.envs.adapted import Adapted
from irlcli.envs.registration import make
from irlcli.errors import IntegrityError, UsageError, described
from irlcli.interventions import Setting
from irlcli.rl.policy import Policy

# Hyperparameters that only one of the algorithms has. They are JSON in the file.
_MARKS: dict[str, type[BaseAlgorithm]] = {
    "clip_range_vf": PPO,
    "target_entropy": SAC,
    "policy_delay": TD3,
    "exploration_fraction": DQN,
}
# Not null in a file whose PPO was trained under VecNormalize. The others set it in any case.
_NORMALISED = "_last_original_obs"
_MAX_JSON_BYTES = 64 << 20
_STATISTICS = "name the file that VecNormalize.save wrote for this expert"


class SavedPolicy(Policy):
    """The policy of a saved model, in the environment that it was trained in.

    PPO's and SAC's are sampled; TD3's and DQN's have no distribution, so they act greedily.

    Args:
        model: what was saved.
        normaliser: the statistics that its observations are normalised by; None: as they are.
    """

    def __init__(self, model: BaseAlgorithm, normaliser: VecNormalize | None):
        self._model = model
        self._normaliser = normaliser
        space = model.observation_space
        assert isinstance(space, Box)
        self._shape, self._dtype = space.shape, space.dtype
        self.network = model.policy  # type: ignore[assignment]
        self._greedy = isinstance(model, TD3 | DQN)

    def act(self, observations: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """Actions [N], [N, K] or [N, A] for flat observations [N, D]; samples as :class:`Policy`."""
        shaped = observations.reshape(-1, *self._shape).astype(self._dtype)
        if self._normaliser is not None:
            normalised = self._normaliser.normalize_obs(shaped)
            assert isinstance(normalised, np.ndarray)
            shaped = normalised
        if isinstance(self.network, ActorCriticPolicy):
            # SB3's predict clips the samples. Demonstrations hold them as they were drawn.
            actions = super().act(shaped, deterministic)
        else:
            if isinstance(self._model, SAC) and self._model.use_sde:
                # SB3's predict keeps the noise that was drawn when the model was loaded.
                self._model.actor.reset_noise(len(shaped))
            actions, _ = self._model.predict(shaped, deterministic=deterministic or self._greedy)
        return actions if actions.ndim == 1 else actions.reshape(len(actions), -1)


class File(NamedTuple):
    """The content of a file, and its name for messages."""

    name: str
    data: bytes


def load_saved(
    saved: File, env: str, setting: Setting, statistics: File | None = None
) -> SavedPolicy:
    """The expert in ``saved``, for one setting of ``env``. This runs the code in the files.

    Args:
        saved: what SB3's ``save`` wrote.
        env: an environment.
        setting: one that the expert acts in.
        statistics: what ``save`` of the VecNormalize wrote that it was trained under, if it was.

    Raises:
        IntegrityError: not a file that SB3's PPO, SAC, TD3 or DQN wrote, or not readable here.
        UsageError: the expert has other observations or actions than the setting, or is a PPO that
            squashes its actions or was trained under VecNormalize without statistics here.
    """
    name, data = saved
    with closing(make(env, setting)) as world:
        inner = world.env if isinstance(world, Adapted) else world
        spaces = inner.observation_space, inner.action_space
    fields = _fields(name, data)
    kind = _algorithm(name, fields)
    if kind is PPO and fields.get(_NORMALISED) is not None and statistics is None:
        raise UsageError(
            f"{name} was trained under VecNormalize, whose statistics are not part of the file",
            f"name them, too, as VecNormalize.save wrote them: SETTING={name}+STATISTICS.pkl",
        )
    # What only training needs: pickled functions of other Python versions, and memory.
    unused: dict[str, Any] = {"learning_rate": 0.0, "lr_schedule": _zero, "clip_range": _zero}
    unused |= {"clip_range_vf": None} if kind is PPO else {"buffer_size": 1}
    try:
        with warnings.catch_warnings(action="ignore"):
            model = kind.load(io.BytesIO(data), device="cpu", custom_objects=unused)
    except Exception as error:
        # Unpickling raises whatever the pickled objects raise.
        raise IntegrityError(
            f"{name}: stable-baselines3 cannot load it ({described(error)[:200]})",
            "save it again with the version that is installed here",
        ) from error
    for what, own, theirs in zip(
        ("observations", "actions"),
        (model.observation_space, model.action_space),
        spaces,
        strict=True,
    ):
        if not _fit(own, theirs):
            raise UsageError(
                f"{name} has {what} in {own}, but {env} {setting} in {theirs}",
                "name an expert that was trained in this environment; stable-baselines3 counts indices "
                "from 0, so they need a wrapper if the environment does not",
            )
    if isinstance(model.policy, ActorCriticPolicy) and model.policy.squash_output:
        raise UsageError(
            f"{name} squashes its actions (squash_output), which is read of SAC only",
            "train the expert without squash_output",
        )
    model.policy.set_training_mode(False)
    normaliser = None if statistics is None else _normaliser(statistics, spaces[0])
    return SavedPolicy(model, normaliser)


def _normaliser(statistics: File, space: gymnasium.Space) -> VecNormalize:
    """What normalises observations of ``space``."""
    try:
        found = pickle.loads(statistics.data)
    except Exception as error:
        raise IntegrityError(
            f"{statistics.name} cannot be unpickled ({type(error).__name__})", _STATISTICS
        ) from error
    if not isinstance(found, VecNormalize):
        raise IntegrityError(f"{statistics.name} holds a {type(found).__name__}", _STATISTICS)
    if found.observation_space.shape != space.shape:
        raise UsageError(
            f"{statistics.name} normalises observations of shape {found.observation_space.shape}, "
            f"but they are of shape {space.shape}",
            _STATISTICS,
        )
    return found


def _zero(_: float) -> float:
    return 0.0


def _fields(name: str, data: bytes) -> dict[str, Any]:
    """What SB3 wrote as JSON: hyperparameters, and pickles as text. This runs no code."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if archive.getinfo("data").file_size > _MAX_JSON_BYTES:
                raise ValueError(f"its description is larger than {_MAX_JSON_BYTES >> 20} MiB")
            return dict(json.loads(archive.read("data")))
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, OSError, RecursionError) as error:
        raise IntegrityError(
            f"{name} was not saved by stable-baselines3 ({str(error)[:200]})",
            "name a file that model.save() wrote",
        ) from None


def _algorithm(name: str, fields: Mapping[str, Any]) -> type[BaseAlgorithm]:
    """The algorithm whose hyperparameters ``fields`` are, by their names."""
    found = {kind for mark, kind in _MARKS.items() if mark in fields}
    if len(found) != 1:
        raise IntegrityError(
            f"{name} was saved by another algorithm than PPO, SAC, TD3 or DQN",
            "these are the ones that are read",
        )
    return found.pop()


def _fit(one: gymnasium.Space, other: gymnasium.Space) -> bool:
    """Whether a model with space ``one`` can act in or observe ``other``; it counts indices from 0."""
    if isinstance(one, Box) and isinstance(other, Box):
        return one.shape == other.shape and (
            np.allclose(one.low, other.low) and np.allclose(one.high, other.high)
        )
    if isinstance(one, Discrete) and isinstance(other, Discrete):
        return int(one.start) == 0 and int(one.n) == int(other.n)
    if isinstance(one, MultiDiscrete) and isinstance(other, MultiDiscrete):
        return not one.start.any() and np.array_equal(one.nvec, other.nvec)
    return False
