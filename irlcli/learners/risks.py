"""What each risk's minibatch is drawn from: a group of demonstrations, and the policy's samples beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from irlcli.learners.grouping import Group, Part, apportion
from irlcli.learners.pools import Pool, Stratum, join_pools


def risk_strata(
    groups: Sequence[Group],
    samples: int,
    current: Sequence[Pool],
    past: Sequence[Pool],
    expert: Callable[[Part], Pool],
    pairing: str,
) -> list[list[Stratum]]:
    """The strata of each group's risk; every method draws as many samples.

    Args:
        groups: the demonstrations of each risk.
        samples: of either label, over all risks.
        current: the policy's of this round, of each setting [E].
        past: the policy's of earlier rounds [E]; empty without replay.
        expert: the demonstrations of a part.
        pairing: ``matched``: a part meets the policy's samples of its own setting; ``pooled``:
            those of all settings.
    """
    size = samples // len(groups)

    def paired(pools: Sequence[Pool], part: Part) -> Pool:
        return join_pools(pools if pairing == "pooled" else [pools[part.setting]])

    def strata(members: Group) -> list[Stratum]:
        counts = apportion(size, [part.share for part in members.parts])
        return [
            Stratum(
                policy=paired(current, part),
                expert=expert(part),
                past=paired(past, part) if past else None,
                count=count,
            )
            for part, count in zip(members.parts, counts, strict=True)
        ]

    return [strata(members) for members in groups]
