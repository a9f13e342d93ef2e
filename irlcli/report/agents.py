"""What agents and measures are called and how they are drawn. Methods come from their table."""

from irlcli.methods import METHODS

BASELINES = {
    "expert": "expert",
    "reused": "training experts, reused",
    "random": "random",
    "idle": "idle",
}
MEASURES = {
    "transfer": "Transfer: the policy retrained on the frozen reward, in the held-out setting",
    "from-student": "From the student: the student, retrained on the frozen reward, in the held-out setting",
    "zero-shot": "Zero-shot: the student, in the held-out setting",
    "transfer-id": "Transfer in distribution: a policy retrained in each training setting, their mean",
    "id": "In distribution: the student, mean over the training settings",
}
PROGRESS = (
    "Progress: what walking or reaching earned, before costs; for MuJoCo's robots, metres forward; "
    "for other environments, what they report."
)
# Measures of policies trained on the frozen reward, and measures in the training settings.
RETRAINED = ("transfer", "from-student", "transfer-id")
IN_DISTRIBUTION = ("transfer-id", "id")
# For methods outside the table: what Okabe and Ito's palette has left, then Tol's, then greys.
_OTHER_COLOURS = ("#F0E442", "#117733", "#AA4499", "#777777", "#AAAAAA")


def title(agent: str) -> str:
    """The title of a method or baseline; a method outside the table is called by its name."""
    if agent in METHODS:
        return METHODS[agent].title
    return BASELINES.get(agent, agent)


def beside(measure: str) -> tuple[str, ...]:
    """The agents without a reward that are shown beside ``measure``."""
    return ("expert", "reused") if measure in IN_DISTRIBUTION else tuple(BASELINES)


def own_measure(agent: str, measure: str) -> str:
    """``measure``; of an agent without a reward the one in the same settings, ``id`` or ``ood``."""
    if agent not in BASELINES:
        return measure
    return "id" if measure in IN_DISTRIBUTION else "ood"


def colours(methods: tuple[str, ...]) -> dict[str, str]:
    """A colour for each of ``methods``. Those outside the table share a cycle of five."""
    others = [name for name in methods if name not in METHODS]
    cycle = {name: _OTHER_COLOURS[i % len(_OTHER_COLOURS)] for i, name in enumerate(others)}
    return {name: METHODS[name].colour if name in METHODS else cycle[name] for name in methods}


def comparisons(methods: tuple[str, ...]) -> list[tuple[str, str]]:
    """Pairs (x, y) to compare: each method that seeks invariance with each that does not.

    A method seeks invariance if it penalises the risks of the settings as they are labelled.
    """
    seeking = [
        name
        for name in methods
        if name in METHODS
        and METHODS[name].grouping == "per-setting"
        and METHODS[name].penalty != "none"
    ]
    return [(x, y) for x in seeking for y in methods if y not in seeking]
