"""What is run: methods, rows of ``settings/`` and seeds. Both environments import this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from irlcli.errors import UsageError, suggest

ROWS = ("lunar-lander.engine-power", "half-cheetah.friction")


class Method(NamedTuple):
    """One line of the tables.

    Attributes:
        name: as in ``--methods``.
        title: in the tables.
        module: the module of this package that runs it.
        expert: whether it trains an expert of one setting, on the true reward; otherwise a student of
            all settings' experts.
        environments: those where it differs from the other methods; empty for all.
    """

    name: str
    title: str
    module: str
    expert: bool = False
    environments: tuple[str, ...] = ()


METHODS = {
    method.name: method
    for method in (
        Method("airl", "irlcli: AIRL, standard", "ours"),
        Method("airl-plain", "irlcli: AIRL, no challengers", "ours"),
        Method("imitation-airl", "imitation: AIRL, defaults", "theirs"),
        Method("imitation-airl-best", "imitation: AIRL, best known", "theirs"),
        Method("imitation-gail", "imitation: GAIL, defaults", "theirs"),
        Method("imitation-gail-best", "imitation: GAIL, best known", "theirs"),
        # HalfCheetah's episodes always last 1000 steps.
        Method(
            "imitation-airl-variable",
            "imitation: AIRL, best known, variable horizon",
            "theirs",
            environments=("lunar-lander",),
        ),
        Method(
            "imitation-gail-variable",
            "imitation: GAIL, best known, variable horizon",
            "theirs",
            environments=("lunar-lander",),
        ),
        Method("expert", "irlcli: train-expert", "ours", expert=True),
        Method("zoo-ppo", "stable-baselines3: PPO, rl-baselines3-zoo", "theirs", expert=True),
    )
}


class Task(NamedTuple):
    """One training run."""

    method: str
    row: str
    settings: tuple[str, ...]
    seed: int

    @property
    def group(self) -> str:
        """What it is compared with: the students of a row, or the experts of a setting."""
        if METHODS[self.method].expert:
            return f"{self.row}: experts of {self.settings[0]}"
        return f"{self.row}: students"

    @property
    def name(self) -> str:
        """Of its files."""
        setting = (self.settings[0],) if METHODS[self.method].expert else ()
        return ".".join((self.row, self.method, *setting, str(self.seed)))


def chosen(text: str | None, known: Sequence[str], option: str) -> list[str]:
    """The names of a comma-separated list, in the order of ``known``; without a list, all.

    Raises:
        UsageError: one of them is unknown.
    """
    if text is None:
        return list(known)
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise UsageError(f"{option}: unknown name {name!r}", suggest(name, known))
    return [name for name in known if name in names]


def tasks(
    settings: Mapping[str, Sequence[str]], methods: Sequence[str], seeds: Sequence[int]
) -> list[Task]:
    """Every task, seed by seed, so that an interrupted benchmark has compared all methods.

    ``settings`` are those of each row.
    """
    return [
        Task(name, row, tuple(group), seed)
        for seed in seeds
        for row, trained in settings.items()
        for name in methods
        if row.split(".")[0] in (METHODS[name].environments or (row.split(".")[0],))
        for group in ([[one] for one in trained] if METHODS[name].expert else [trained])
    ]
