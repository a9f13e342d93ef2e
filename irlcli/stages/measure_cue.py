"""How a learned reward depends on a cue alone: the cue is flipped, everything else stays."""

from collections.abc import Sequence

import msgspec

from irlcli.errors import UsageError
from irlcli.interventions import Setting, cue_in
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import frozen_reward


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the measurement depends on, besides the reward and the demonstrations."""

    environment: EnvironmentKey
    settings: tuple[str, ...]


def request(
    reward: Source | From,
    demos: Source | From,
    env: str,
    settings: Sequence[Setting],
    reward_label: str = "",
) -> Request:
    """How ``reward`` (a ``reward.pt``) depends on the cue over ``demos`` of ``settings``.

    Outputs ``cue.json``.

    Raises:
        UsageError: a setting without a cue.
    """
    for setting in settings:
        if cue_in(env, setting) is None:
            raise UsageError(f"{env} {setting} has no cue", "cue-strength adds one")
    texts = tuple(str(s) for s in settings)
    label = f"measure-cue {env} {', '.join(texts)}"
    label += f" by the reward of {reward_label}" if reward_label else ""
    parameters = Parameters(environment=environment_key(env), settings=texts)
    return Request(STAGE, parameters, {"reward": reward, "demonstrations": demos}, label)


def run(job: Job) -> None:
    """Score every demonstrated step twice for each hint: with the hint at 1 and at -1."""
    import torch

    from irlcli.data.demonstrations import read_demonstrations
    from irlcli.data.descriptions import CueContrast, HintContrast
    from irlcli.data.outputs import write_json
    from irlcli.data.tensors import load_reward_file
    from irlcli.report.cue import hint_contrasts
    from irlcli.trajectories import transitions

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    demos = read_demonstrations(job.inputs["demonstrations"])
    demos.require(p.environment.name, p.settings)
    model, origin = load_reward_file(job.inputs["reward"])
    found = []
    for index, text in enumerate(p.settings):
        frozen = frozen_reward(p.environment, text, model, origin)
        steps = transitions(demos.trajectories[text], p.environment.max_episode_steps)
        contrasts = hint_contrasts(frozen.g_over_scale, steps)
        found.append(HintContrast(setting=text, steps=len(steps), **contrasts))
        facts = {text: " ".join(f"{name} {value:.2f}" for name, value in contrasts.items())}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    contrast = CueContrast(
        env=p.environment.name, reward=origin.origin, scale=origin.scale, settings=tuple(found)
    )
    write_json(job.output / "cue.json", msgspec.to_builtins(contrast))


STAGE = Stage("measure-cue", 2, run, reads=())
