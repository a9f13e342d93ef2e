"""Values that the shell completes. Each function imports what it lists when it is asked."""


def environments() -> list[str]:
    """Names of environments."""
    from irlcli.envs.registry import ENVIRONMENTS

    return list(ENVIRONMENTS)


def methods() -> list[tuple[str, str]]:
    """Names of methods, with their titles."""
    from irlcli.methods import METHODS

    return [(method.name, method.title) for method in METHODS.values()]


def maxent_methods() -> list[tuple[str, str]]:
    """Those of :func:`methods` that MaxEnt IRL has as well, with their titles."""
    from irlcli.methods import METHODS
    from irlcli.penalties import maxent_methods

    return [(name, METHODS[name].title) for name in maxent_methods()]


def groupings() -> list[str]:
    """Ways to group demonstrations."""
    from typing import get_args

    from irlcli.configs.fields import Grouping

    return list(get_args(Grouping))


def penalties(learner: str) -> list[str]:
    """Penalties of ``learner``: ``airl`` or ``maxent``."""
    from irlcli.penalties import PENALTIES

    return [name for name, penalty in PENALTIES.items() if learner in penalty.learners]


def algorithms() -> list[str]:
    """Names of retraining algorithms."""
    from irlcli.rl import ALGORITHMS

    return list(ALGORITHMS)


def profiles() -> list[str]:
    """Names of profiles."""
    from irlcli.configs import PROFILES

    return list(PROFILES)


def tables() -> list[tuple[str, str]]:
    """Names of tables and figures, with their titles."""
    from irlcli.experiments.tables import load_tables

    return [(table.name, table.title) for table in load_tables().values()]


def reports() -> list[tuple[str, str]]:
    """What ``irl report`` writes, with titles."""
    from irlcli.experiments.tables import REPORTS

    return [*REPORTS.items(), *tables()]
