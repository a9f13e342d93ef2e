"""An assessment of a learned reward, from the returns of a bank of policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from irlcli.data.descriptions import (
    Assessed,
    Assessment,
    BankEntry,
    RewardOrigin,
)
from irlcli.report.reward_quality import (
    Member,
    agreement,
    measured,
    return_distance,
    split_regret,
)


def assess(
    env: str,
    reward: RewardOrigin,
    members: Sequence[Member],
    epic: Mapping[str, float | None],
    epic_missing: str = "",
) -> Assessment:
    """All numbers about ``reward``, by setting and over all settings together.

    ``epic`` are EPIC distances by setting, and ``epic_missing`` says why there are none.
    """
    places = list(dict.fromkeys(m.setting for m in members))
    settings = tuple(
        _in(place, [m for m in members if m.setting == place], epic.get(place)) for place in places
    )
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
        epic_missing=epic_missing,
    )


def _ranked(setting: str, members: Sequence[Member]) -> Assessed:
    return Assessed(
        setting=setting,
        overall=agreement(members),
        lower_half=agreement(members, lower=True),
        return_distance=return_distance(members),
    )


def _in(setting: str, members: Sequence[Member], epic: float | None) -> Assessed:
    found = replace(_ranked(setting, members), epic=epic)
    of = {m.kind: m for m in members}
    if "expert" not in of:
        return found
    retrained = [m for m in members if m.kind in ("retrained", "from-student")]
    return replace(
        found,
        expert_minus_idle=measured(_per_step(of["expert"]) - _per_step(of["idle"])),
        retrained=tuple(split_regret(m, of["expert"], of["random"]) for m in retrained),
    )


def _per_step(member: Member) -> np.ndarray:
    return member.learned / np.asarray(member.steps, np.float64)
