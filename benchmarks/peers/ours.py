"""The stages ``train-airl`` and ``train-expert`` with the ``standard`` profile, one run a process.

The stages run as they are. Only what follows a round is replaced: a check instead of a checkpoint.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NoReturn

from benchmarks.peers.checks import Checks, Ended
from irlcli.configs import load_config
from irlcli.interventions import parse_setting
from irlcli.rl.loop import Training
from irlcli.stages import train_airl, train_expert
from irlcli.stages.base import Job, Request, Source

_OVERRIDES = {"airl-plain": ["airl.challenger.life=0"]}


class _Quiet:
    def progress(self, done: int, total: int, unit: str, facts: Any) -> None:
        pass

    def scalars(self, step: int, values: Any) -> None:
        pass

    def warn(self, message: str) -> None:
        print(message, file=sys.stderr)


class _NoCheckpoints:
    def load(self) -> None:
        return None

    def discard(self, reason: str) -> None:
        pass

    def offer(self, state: Any) -> None:
        pass


def requested(run: dict[str, Any], demos: Path) -> tuple[Request, int]:
    """The training that ``run`` describes, and the steps of its challengers in each round."""
    env = run["row"].split(".")[0]
    config = load_config(env, "standard", overrides=_OVERRIDES.get(run["method"], []))
    settings = [parse_setting(env, text) for text in run["settings"]]
    if run["method"] == "expert":
        setting = settings[0]
        return train_expert.request(env, setting, run["seed"], config.expert_of(setting)), 0
    # The defaults of grouping and penalty are ERM's.
    airl = config.airl_of(settings)
    request = train_airl.request(Source(demos, ""), env, settings, airl, run["seed"])
    # As it is trained: the request gives it the student's number of worlds.
    challenger = request.parameters.airl.challenger
    return request, challenger.ppo.steps_per_round if challenger.life > 0 else 0


def main() -> None:
    """Run the task that the first argument describes, as JSON."""
    run = json.loads(sys.argv[1])
    checks = Checks(run)
    demos = Path(run["dataset"])
    request, challenger_steps = requested(run, demos)

    def run_training(job: Job, training: Any) -> NoReturn:
        def after_round(training: Training, rows: Any) -> None:
            steps = training.trainer.steps + training.rounds_done * challenger_steps
            policy = training.trainer.policy
            checks.after(steps, lambda seen: policy.act(seen, deterministic=True))

        checks.begin()
        training.run(after_round, job.console.warn)
        checks.end("budget")

    train_airl.run_training = train_expert.run_training = run_training
    inputs = {"demonstrations": demos}
    with tempfile.TemporaryDirectory() as output, contextlib.suppress(Ended):
        request.stage.run(Job(request.parameters, inputs, Path(output), _NoCheckpoints(), _Quiet()))


if __name__ == "__main__":
    main()
