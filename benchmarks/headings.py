"""Which side an Ant walks with: the mean yaw of a policy's torso, beside what it earns.

    python -m benchmarks.headings [--reward REWARD] POLICY [POLICY ...]

For each policy and each setting it was trained in, over 20 episodes: true return, progress, the
circular mean of the yaw [degrees], and the learned reward per step (in deviations of g on its
training data) if a reward is given. All are artefacts of the store in IRL_STORE (``runs`` by
default). Of PyBullet's Ant only: its observations hold the orientation as a quaternion.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

import numpy as np

from irlcli.data.tensors import load_policy_file
from irlcli.errors import IrlError, UsageError
from irlcli.experiments import references
from irlcli.interventions import parse_setting
from irlcli.rewards import LearnedReward, load_reward
from irlcli.rl.rollout import roll_out
from irlcli.store import Store
from irlcli.trajectories import Trajectory, transitions

_EPISODES = 20
# x, y, z, w.
_ORIENTATION = slice(1, 5)


def mean_yaw(observations: np.ndarray) -> float:
    """Circular mean [degrees] of the yaw in ``observations`` [T, D] of an Ant."""
    x, y, z, w = observations[:, _ORIENTATION].T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    return float(np.degrees(np.angle(np.exp(1j * yaw).mean())))


def main(reward: str | None, policies: Sequence[str]) -> None:
    """Print a line for each policy and setting."""
    root = os.environ.get("IRL_STORE", "runs")
    store = Store(root)
    found = {ref: references.tensor_file(store, ref, "policy") for ref in policies}
    for ref, (_, described) in found.items():
        _check_ant(ref, described.env)
    if reward is not None:
        _check_ant(reward, references.tensor_file(store, reward, "reward")[1].env)
    # Before the rollouts: a reward that takes no observations of a setting is refused.
    pays = {
        text: None if reward is None else load_reward(reward, root, setting=text)
        for _, described in found.values()
        for text in described.settings
    }
    print(f"{'policy':<40} {'setting':<24} {'return':>7} {'progress':>8} {'yaw':>5}  reward/step")
    for ref, (source, described) in found.items():
        policy, _ = load_policy_file(source.path)
        for text in described.settings:
            setting = parse_setting("ant", text)
            episodes = roll_out("ant", setting, policy, _EPISODES, 0, "headings")
            pay = pays[text]
            earned = "" if pay is None else f"{_learned(pay, episodes):.2f}"
            print(
                f"{ref:<40} {text:<24} {np.mean([t.episode_return for t in episodes]):>7.0f} "
                f"{np.mean([t.progress for t in episodes]):>8.0f} "
                f"{mean_yaw(np.concatenate([t.observations for t in episodes])):>5.0f}  {earned}"
            )


def _check_ant(ref: str, env: str) -> None:
    if env != "ant":
        raise UsageError(f"{ref} belongs to {env}", "name artefacts of ant")


def _learned(pay: LearnedReward, episodes: Sequence[Trajectory]) -> float:
    data = transitions(episodes, max(len(t.rewards) for t in episodes))
    paid = pay(data.observations, data.actions, data.next_observations, data.terminated)
    return float(paid.mean())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reward")
    parser.add_argument("policies", nargs="+", metavar="POLICY")
    arguments = parser.parse_args()
    try:
        main(arguments.reward, arguments.policies)
    except IrlError as error:
        sys.exit(f"error: {error.message}\nhint: {error.hint}")
