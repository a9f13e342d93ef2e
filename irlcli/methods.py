"""The named methods: which learner, which grouping of the demonstrations, which penalty.

The command line, the experiment tables, the reports and their colours read this table; a new
method is a line here.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from irlcli.errors import UsageError, suggest

# Behavioural cloning is no adversarial learner: `irlcli.stages.clone` runs it.
CLONING = "bc"


class Method(NamedTuple):
    """A named (learner, grouping, penalty).

    Attributes:
        name: as in ``--method``.
        title: in tables and figures.
        learner: a key of :data:`irlcli.learners.LEARNERS`, or ``bc``, which learns no reward. For
            ``train-maxent``, ``airl`` is MaxEnt.
        grouping: which demonstrations share a risk, see :class:`irlcli.configs.AIRLConfig`.
        penalty: a key of :data:`irlcli.penalties.PENALTIES`.
        colour: in figures. Okabe and Ito's, then Tol's, which colour-blind readers can tell apart.
        sets: further fields of ``[airl]``, zero or unset in every other method, and their values.
    """

    name: str
    title: str
    learner: str
    grouping: str
    penalty: str
    colour: str
    sets: Mapping[str, Any] = {}

    @property
    def learns_reward(self) -> bool:
        """Whether there is a reward to transfer, to retrain on and to assess."""
        return self.learner != CLONING


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("erm", "AIRL-ERM", "airl", "pooled", "none", "#0072B2"),
        Method("irm", "AIRL-IRM", "airl", "per-setting", "irmv1", "#E69F00"),
        Method("erm-balanced", "ERM-balanced", "airl", "balanced", "none", "#009E73"),
        Method("irm-shuffled", "IRM, labels shuffled", "airl", "shuffled", "irmv1", "#CC79A7"),
        Method("vrex", "AIRL-VREx", "airl", "per-setting", "vrex", "#D55E00"),
        Method("iga", "AIRL-IGA", "airl", "per-setting", "iga", "#882255"),
        Method("group-dro", "AIRL-DRO", "airl", "per-setting", "group-dro", "#56B4E9"),
        Method("l2", "ERM + L2", "airl", "pooled", "l2", "#999933"),
        Method("input-gradient", "ERM + gradients", "airl", "pooled", "input-gradient", "#332288"),
        Method("dropout", "ERM + dropout", "airl", "pooled", "none", "#44AA99", {"dropout": 0.5}),
        Method("gail", "GAIL", "gail", "pooled", "none", "#661100"),
        Method("bc", "BC", CLONING, "pooled", "none", "#000000"),
    )
}


def method(name: str) -> Method:
    """The method called ``name``.

    Raises:
        UsageError: there is no such method.
    """
    if name not in METHODS:
        raise UsageError(f"unknown method {name!r}", suggest(name, METHODS))
    return METHODS[name]


def fields(name: str, section: str) -> dict[str, Any]:
    """The config fields that ``--method NAME`` sets in ``section``: ``airl`` or ``maxent``.

    Raises:
        UsageError: there is no such method.
    """
    chosen = method(name)
    values = {"grouping": chosen.grouping, "penalty": chosen.penalty}
    if section == "airl":
        values |= {"learner": chosen.learner, **chosen.sets}
    return {f"{section}.{field}": value for field, value in values.items()}


def method_name(config: Mapping[str, Any]) -> str:
    """The name of what a ``config`` of ``[airl]`` or ``[maxent]`` trains; its parts if it has none.

    ``maxent`` has no learner, and shares the names of AIRL's methods: what it trains is never
    mistaken for AIRL's.
    """
    learner = config.get("learner", "airl")
    grouping, penalty = config.get("grouping"), config.get("penalty", "none")
    # Methods that set further fields come first: they are the more special ones.
    for known in sorted(METHODS.values(), key=lambda method: not method.sets):
        same = (known.learner, known.grouping, known.penalty) == (learner, grouping, penalty)
        if same and all(config.get(field) for field in known.sets):
            return known.name
    parts = [] if learner == "airl" else [str(learner)]
    return " ".join([*parts, str(grouping)] + ([] if penalty == "none" else [str(penalty)]))
