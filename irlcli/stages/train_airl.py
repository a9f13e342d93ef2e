"""Adversarial IRL from demonstrations: ERM, ERM-balanced or IRM (paper Algorithm 1)."""

from collections.abc import Mapping, Sequence
from contextlib import closing

import msgspec

from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import Setting, check_tabular, environment, parse_setting
from irlcli.settings import PENALISED, AIRLSettings
from irlcli.stages import From, Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations."""

    env: str
    physics: int
    settings: tuple[str, ...]
    seed: int
    airl: AIRLSettings


def request(
    demos: Source | From,
    env: str,
    settings_: Sequence[Setting],
    airl: AIRLSettings,
    seed: int = 0,
    basis: Mapping[str, Source | From] | None = None,
) -> Request:
    """A reward and a student policy learned from ``demos``, recorded in ``settings_`` of ``env``.

    ``basis`` are further artefacts that the parameters follow from: part of the lineage.

    Outputs ``reward.pt``, ``policy.pt`` (the student), their descriptions as JSON, and
    ``metrics.parquet`` with one row per round and setting.

    Raises:
        UsageError: a tabular environment, gSDE, worlds that the settings cannot share equally, or
            a selection by something that the demonstrations do not hold.
    """
    check_tabular(env, "train-airl", wanted=False)
    if airl.ppo.use_sde:
        raise UsageError(
            "airl.ppo.use_sde: AIRL needs log pi(a|s) of the action taken, and gSDE's noise "
            "outlasts a step",
            "leave it unset; airl.ppo.log_std_init sets how much the policy explores",
        )
    texts = tuple(str(s) for s in settings_)
    airl = _resolved_selection(airl, texts)
    if airl.actions == "sampled":
        airl = msgspec.structs.replace(airl, actions=msgspec.UNSET)
    if airl.bc_epochs == 0:
        airl = msgspec.structs.replace(airl, bc_epochs=msgspec.UNSET)
    trained = len(_trained(airl, texts))
    if airl.ppo.n_envs % trained:
        raise UsageError(
            f"{airl.ppo.n_envs} worlds cannot be shared equally by {trained} settings",
            f"--set airl.ppo.n_envs to a multiple of {trained}",
        )
    if airl.method not in PENALISED:
        # What does not enter the loss is no part of the identity.
        airl = msgspec.structs.replace(
            airl, penalty_weight=0.0, penalty_warmup_rounds=0, penalty_ramp_rounds=0
        )
    parameters = Parameters(
        env=env, physics=environment(env).physics, settings=texts, seed=seed, airl=airl
    )
    label = f"train-airl {_variant(airl)} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos, **(basis or {})}, label)


def _resolved_selection(airl: AIRLSettings, settings: Sequence[str]) -> AIRLSettings:
    """``airl`` with every field of the selection set, or none of them."""
    if airl.select in (msgspec.UNSET, "last"):
        unset = dict.fromkeys(("select", "select_every", "select_episodes"), msgspec.UNSET)
        return msgspec.structs.replace(airl, **unset)
    if airl.select != "episodes" and airl.select not in settings:
        raise UsageError(
            f"{airl.select!r} can select no round: it is not in the demonstrations",
            f"one of: last, episodes, {', '.join(settings)}",
        )
    if airl.select in settings and len(settings) == 1:
        raise UsageError(
            f"without {airl.select} there is no setting left to train on", "select by episodes"
        )
    return msgspec.structs.replace(
        airl, select_every=airl.select_every or 10, select_episodes=airl.select_episodes or 10
    )


def _variant(airl: AIRLSettings) -> str:
    weight = f" lambda {airl.penalty_weight:g}" if airl.method in PENALISED else ""
    select = "" if airl.select is msgspec.UNSET else f" selecting by {airl.select}"
    clone = "" if airl.bc_epochs is msgspec.UNSET else " from a clone"
    return f"{airl.method}{weight}{select}{clone}"


def _trained(airl: AIRLSettings, settings: Sequence[str]) -> tuple[str, ...]:
    """The settings that are trained on: all but one that selects."""
    return tuple(text for text in settings if text != airl.select)


def run(job: Job) -> None:
    """Alternate policy rounds and discriminator rounds, all settings together."""
    from irlcli import descriptions, rl
    from irlcli.dataset import read_demonstrations
    from irlcli.stages.adversary import Adversary
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds
    from irlcli.stages.selection import split

    p: Parameters = job.parameters
    demos = read_demonstrations(job.inputs["demonstrations"])
    settings = list(p.settings)
    if demos.env != p.env or list(demos.trajectories) != settings:
        raise IntegrityError(
            f"the demonstrations are of {demos.env} {', '.join(demos.trajectories)}, not of "
            f"{p.env} {', '.join(settings)}"
        )
    selection = None
    if p.airl.select is not msgspec.UNSET:
        rounds = rl.rounds(p.airl.ppo, p.airl.total_steps)
        demos, selection = split(demos, p.airl, rounds, p.seed)
        settings = list(_trained(p.airl, settings))
    parsed = [parse_setting(demos.env, s) for s in settings]
    with closing(rl.make_worlds(demos.env, parsed, p.airl.ppo.n_envs, job.workers)) as worlds:
        trainer = rl.PPOTrainer(worlds, p.airl.ppo, p.airl.total_steps, p.seed, STAGE.name)
        adversary = Adversary(demos, p.airl, worlds, p.seed)
        rows = train_rounds(job, trainer, settings, adversary=adversary, selection=selection)
    selected = None
    if selection is not None:
        best = selection.best
        selected = descriptions.Selected(round=best["round"], score=best["score"])
    origin = {"settings": tuple(settings), "method": p.airl.method, "seed": p.seed}
    write_policy(job.output, trainer.policy, p.airl.ppo, p.env, agent="student", **origin)
    adversary.write_reward(job.output, env=p.env, airl=p.airl, selected=selected, **origin)
    write_metrics(job.output, rows)


STAGE = Stage("train-airl", 2, run)
