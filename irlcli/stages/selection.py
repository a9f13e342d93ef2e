"""Which round of adversarial training to keep, by data that is in distribution and held out.

Adversarial training has no loss that falls: the last round is not the best one. What it may
be chosen by is data of the settings trained on, never the setting that a method is judged in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from irlcli import rl
from irlcli.dataset import Demonstrations
from irlcli.errors import UsageError
from irlcli.interventions import parse_setting
from irlcli.rl import Policy
from irlcli.settings import AIRLSettings
from irlcli.stages.actions import SeenActions
from irlcli.stages.adversary import Adversary
from irlcli.trajectories import Trajectory, transitions

HELD_OUT_SHARE = 5  # one episode in so many, at least one


class Selection:
    """Keeps the policy and the reward of the round with the highest score so far.

    Args:
        score: of a policy, and the actions that likelihoods are of; higher is better.
        every: rounds between two scores; the last of ``rounds`` is always scored.
    """

    def __init__(self, score: Callable[[Policy, SeenActions], float], every: int, rounds: int):
        self._score = score
        self._every = every
        self._rounds = rounds
        self.best: dict[str, Any] = {}

    def consider(self, index: int, policy: Policy, adversary: Adversary) -> float:
        """The score of round ``index``, NaN where none is due; the earlier of equals is kept."""
        if (index + 1) % self._every and index + 1 != self._rounds:
            return float("nan")
        score = self._score(policy, adversary.actions)
        if not self.best or score > self.best["score"]:
            self.best = {
                "round": index,
                "score": score,
                "policy": {name: t.clone() for name, t in policy.state_dict().items()},
                "reward": adversary.reward_state(),
            }
        return score

    def restore(self, policy: Policy, adversary: Adversary) -> None:
        """Put the best round's networks back in place."""
        policy.network.load_state_dict(self.best["policy"])
        adversary.load_reward_state(self.best["reward"])

    def state_dict(self) -> dict[str, Any]:
        """What a later process needs to go on."""
        return self.best

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()``."""
        self.best = dict(state)


def split(
    demos: Demonstrations, config: AIRLSettings, rounds: int, seed: int
) -> tuple[Demonstrations, Selection]:
    """What is left of ``demos`` to train on, and the selection by what was held out of them.

    Raises:
        UsageError: a setting with a single episode, where episodes are to be held out.
    """
    groups = dict(demos.trajectories)
    if config.select == "episodes":
        held_out = {}
        for text, episodes in groups.items():
            count = max(1, len(episodes) // HELD_OUT_SHARE)
            if len(episodes) <= count:
                raise UsageError(
                    f"{text} has one demonstration: none can be held out",
                    "select by a setting, or record more episodes",
                )
            groups[text], held_out[text] = episodes[:-count], episodes[-count:]
        score = partial(log_likelihood, held_out=held_out)
    else:
        del groups[config.select]
        score = partial(
            true_return,
            env=demos.env,
            setting=config.select,
            episodes=config.select_episodes,
            seed=seed,
        )
    kept = Demonstrations(demos.env, groups, demos.metadata)
    return kept, Selection(score, config.select_every, rounds)


def log_likelihood(
    policy: Policy, actions: SeenActions, held_out: Mapping[str, Sequence[Trajectory]]
) -> float:
    """Mean log pi(a|s) over the steps of ``held_out``, every setting of equal weight."""
    means = []
    for trajectories in held_out.values():
        data = actions.of(transitions(trajectories, max(len(t) for t in trajectories)))
        means.append(float(actions.log_prob(policy, data).double().mean()))
    return float(np.mean(means))


def true_return(
    policy: Policy, _: SeenActions, env: str, setting: str, episodes: int, seed: int
) -> float:
    """Mean true return of ``policy`` in ``setting``, from the same states in every round."""
    where = parse_setting(env, setting)
    trajectories = rl.roll_out(env, where, policy, episodes, seed, "selection")
    return float(np.mean([t.episode_return for t in trajectories]))
