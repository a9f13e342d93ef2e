"""An assessment of a learned reward, from the returns of a bank of policies; and as tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlcli.data.descriptions import (
    Assessed,
    Assessment,
    BankEntry,
    LearnedReward,
    Measured,
)
from irlcli.report.reward_quality import (
    Member,
    agreement,
    difference,
    measured,
    return_distance,
    split_regret,
)


def assess(env: str, reward: LearnedReward, members: Sequence[Member]) -> Assessment:
    """All numbers about ``reward``, by setting and over all settings together."""
    places = list(dict.fromkeys(m.setting for m in members))
    settings = tuple(_in(place, [m for m in members if m.setting == place]) for place in places)
    return Assessment(
        env=env,
        reward=reward,
        settings=settings,
        pooled=None if len(places) == 1 else _ranked("", members),
        bank=tuple(
            BankEntry(
                policy=m.policy,
                kind=m.kind,
                setting=m.setting,
                true=measured(m.true),
                learned=measured(m.learned),
                progress=m.progress,
            )
            for m in members
        ),
    )


def _ranked(setting: str, members: Sequence[Member]) -> Assessed:
    return Assessed(
        setting=setting,
        overall=agreement(members),
        lower_half=agreement(members, lower=True),
        return_distance=return_distance(members),
    )


def _in(setting: str, members: Sequence[Member]) -> Assessed:
    found = _ranked(setting, members)
    of = {m.kind: m for m in members}
    if "expert" not in of:
        return found
    retrained = [m for m in members if m.kind == "retrained"]
    return Assessed(
        setting=setting,
        overall=found.overall,
        lower_half=found.lower_half,
        return_distance=found.return_distance,
        expert_minus_idle=difference(_per_step(of["expert"]), _per_step(of["idle"])),
        retrained=tuple(split_regret(m, of["expert"], of["random"]) for m in retrained),
    )


def _per_step(member: Member) -> Measured:
    return measured(member.learned / np.asarray(member.steps, np.float64))
