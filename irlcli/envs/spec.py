"""The description of an environment, available without importing the environment itself."""

from pathlib import Path
from typing import Any, Literal, NamedTuple

Form = Literal["multiplier", "absolute", "triple", "range"]


class Cue(NamedTuple):
    """The meaning of a cue, see :mod:`irlcli.envs.cue`.

    Attributes:
        base: the setting that a cue alone is added to; its expert demonstrates.
        window: number of steps whose rewards make up the quality.
        bar: the quality is good where their sum exceeds it.
    """

    base: str
    window: int
    bar: float


class Knob(NamedTuple):
    """One mechanism of an environment that an intervention can change.

    Attributes:
        argument: keyword argument of the environment that takes the value.
        forms: allowed forms of a value; the usual form comes first.
        low, high: finite, inclusive bounds of every number in a value.
        description: short noun phrase for messages.
        whole: whether only whole numbers are allowed.
        observed: what the knob adds to the observation, as in "a goal"; empty if nothing.
        cue: its meaning, if the value is the strength of a cue. Its ``argument`` then only keeps a
            setting from having two cues.
    """

    argument: str
    forms: tuple[Form, ...]
    low: float
    high: float
    description: str
    whole: bool = False
    observed: str = ""
    cue: Cue | None = None


def cue_knob(cue: Cue) -> Knob:
    """The strength of ``cue``: the share of the steps in which it is right."""
    return Knob(
        "cue_strength",
        ("absolute",),
        0.0,
        1.0,
        "share of the steps in which the cue is right",
        observed="a cue",
        cue=cue,
    )


class Code(NamedTuple):
    """What is known of the code of an environment from outside the package.

    Attributes:
        sha256: digest of its files; None for a package installed from an index.
        distribution, version: what it was installed from; None for a loose file.
    """

    sha256: str | None
    distribution: str | None
    version: str | None


class Needs(NamedTuple):
    """A library that an environment needs and that may be missing.

    Attributes:
        module: what imports it.
        name: its own name.
        hint: how to install it, or what works instead.
    """

    module: str
    name: str
    hint: str


class Own(NamedTuple):
    """What only an environment from outside the package has.

    Attributes:
        id: in Gymnasium's registry, as ``module:EnvId``; None if it has an entry point.
        arguments: keyword arguments that are the same in every setting.
        code: what defines it. Other code is refused.
        files: patterns of further files that belong to its code.
        document: the TOML file that describes it, complete: it travels with every result.
        source: where that was read, for messages.
        directory: of the TOML file; None if the description was read from an artefact.
    """

    id: str | None
    arguments: dict[str, Any]
    code: Code
    files: tuple[str, ...]
    document: dict[str, Any]
    source: str
    directory: Path | None

    @property
    def settings(self) -> dict[str, Any]:
        """The part of the document that ``settings/ENV.toml`` has, too."""
        return {name: part for name, part in self.document.items() if name not in ("env", "knobs")}


class EnvironmentSpec(NamedTuple):
    """One environment: its names, its interventions and its time limit.

    Attributes:
        name: name on the command line, as in ``--env ant``.
        entry_point: ``module:class`` of the gymnasium environment.
        gym_id: id in gymnasium's registry.
        max_episode_steps: time limit [steps].
        knobs: the mechanisms that can be intervened on, by name.
        discrete_actions: whether an action is an index (otherwise a vector).
        terminates: whether an episode may end before the time limit.
        tabular: whether the environment is solved exactly: experts come from value iteration
            and rewards from ``train-maxent``.
        physics: version of the dynamics and the true reward. It is part of every key: increase
            it with each change that alters trajectories.
        transition_reward: ``module:function`` that computes the true reward [B] from observations,
            actions and next observations; None if they do not determine it.
        symmetries: ``module:function`` of :class:`irlcli.symmetries.Symmetries` as a function of the
            keyword arguments of settings, where there are any; else None.
        unobserved: what else the true reward depends on, besides observations and actions, worded
            as the end of a sentence; None if unknown.
        needs: a library that may be missing.
        own: of an environment from outside the package; its ``entry_point`` or ``gym_id`` is empty.
    """

    name: str
    entry_point: str
    gym_id: str
    max_episode_steps: int
    knobs: dict[str, Knob]
    discrete_actions: bool = False
    terminates: bool = True
    tabular: bool = False
    physics: int = 1
    transition_reward: str | None = None
    symmetries: str | None = None
    unobserved: str | None = None
    needs: Needs | None = None
    own: Own | None = None
