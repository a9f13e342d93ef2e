"""What each method adds to the discriminator's update, in one process's own CPU seconds.

The methods update in turn on the same rollout, so that other load and changes of the machine's
speed affect all alike. Run by ``make bench``.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import torch

from benchmarks.airl import INTERVENTIONS, build
from irlcli.configs import load_config
from irlcli.interventions import parse_settings
from irlcli.methods import METHODS, fields
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import make_worlds


def main() -> None:
    """Print the median milliseconds of a round's updates by method, and the ratio to ERM's."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="lunar-lander", choices=sorted(INTERVENTIONS))
    parser.add_argument("--intervention", help="KNOB=VALUE,... in place of the usual one")
    parser.add_argument("--rounds", type=int, default=8)
    arguments = parser.parse_args()
    env = arguments.env
    settings = parse_settings(env, arguments.intervention or INTERVENTIONS[env])
    base = load_config(env).airl_of(settings)
    worlds = make_worlds(env, settings, base.ppo.n_envs)
    demos = [roll_out(env, s, "random", 10, 0, "bench") for s in settings]

    built = {}
    for name, method in METHODS.items():
        if method.learns_reward:
            flags = fields(name, "airl") | {"airl.challenger.life": 0}
            flags |= {"airl.penalty_warmup_rounds": 0, "airl.penalty_ramp_rounds": 1}
            config = load_config(env, flags=flags).airl_of(settings)
            built[name] = build(env, settings, worlds, demos, config)[:2]
    learners = {name: learner for name, (_, learner) in built.items()}
    trainer, _ = built["erm"]
    rollouts = trainer.train_round(0, learners["erm"])
    seconds: dict[str, list[float]] = {name: [] for name in learners}
    for index in range(arguments.rounds + 1):
        for name, one in learners.items():
            started = time.process_time()
            one.update(index, rollouts, trainer.policy)
            if index > 0:
                # The first round warmed up caches, and nothing was replayed in it.
                seconds[name].append(time.process_time() - started)
    print(f"{env}, {len(settings)} settings, {base.updates_per_round} minibatches a round")
    print(f"{'method':16}{'CPU ms a round':>16}{'x erm':>8}")
    for name, found in seconds.items():
        ratio = median(a / b for a, b in zip(found, seconds["erm"], strict=True))
        print(f"{name:16}{1e3 * median(found):16.1f}{ratio:8.2f}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
