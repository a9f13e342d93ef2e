"""How many demonstrated actions lie beyond the bounds, and their log pi(a|s).

    python -m benchmarks.clipped_actions DEMONSTRATIONS POLICY

For each setting: the share of the demonstrations' action components beyond the bounds, how large
they are, and the mean log pi of the demonstrations and of the policy's own actions in the same
states, with ``airl.actions`` sampled and executed. Both arguments are artefacts of the store in
IRL_STORE (``runs`` by default).
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import torch

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.tensors import load_policy_file
from irlcli.envs.registration import make
from irlcli.envs.registry import environment
from irlcli.errors import IrlError
from irlcli.experiments import references
from irlcli.interventions import parse_setting
from irlcli.learners.actions import ActionView
from irlcli.rl.worlds import action_space
from irlcli.store import Store
from irlcli.trajectories import transitions


def main(demonstrations: str, learned: str) -> None:
    """Print a line for each setting and each of the two."""
    store = Store(os.environ.get("IRL_STORE", "runs"))
    demos = read_demonstrations(references.demonstrations(store, demonstrations)[0].path)
    policy, _ = load_policy_file(references.tensor_file(store, learned, "policy")[0].path)
    torch.manual_seed(0)
    print(
        "setting                   beyond  99 % below  actions   log pi: demonstrations  the policy"
    )
    for setting, episodes in demos.trajectories.items():
        data = transitions(episodes, environment(demos.env).max_episode_steps)
        space = make(demos.env, parse_setting(demos.env, setting)).action_space
        assert isinstance(space, gymnasium.spaces.Box)
        size = np.abs(data.actions) / space.high
        own = replace(data, actions=policy.act(data.observations))
        for kind in ("sampled", "executed"):
            view = ActionView(kind, action_space(space))
            theirs, its = (
                float(view.log_prob(policy, view.of(d)).double().mean()) for d in (data, own)
            )
            print(
                f"{setting:<24}  {(size > 1).mean():>5.0%}  {np.quantile(size, 0.99):>10.1f}  "
                f"{kind:<8}  {theirs:>22.1f}  {its:>10.1f}"
            )


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m benchmarks.clipped_actions DEMONSTRATIONS POLICY")
    try:
        main(*sys.argv[1:])
    except IrlError as error:
        sys.exit(f"error: {error.message}\nhint: {error.hint}")
