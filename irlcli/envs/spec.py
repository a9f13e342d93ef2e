"""What the program knows of an environment without importing it."""

from typing import Literal, NamedTuple

Form = Literal["multiplier", "absolute", "triple", "range"]


class Knob(NamedTuple):
    """One mechanism of an environment that can be intervened on.

    Attributes:
        argument: the environment's keyword argument.
        forms: the forms that a value may have, the usual one first.
        low, high: inclusive bounds of every number of a value.
        description: one phrase for messages.
        whole: only whole numbers are allowed.
        observed: the value becomes part of the observation.
    """

    argument: str
    forms: tuple[Form, ...]
    low: float
    high: float
    description: str
    whole: bool = False
    observed: bool = False


class EnvironmentSpec(NamedTuple):
    """One environment: what it is called, what can be changed in it, how long an episode lasts.

    Attributes:
        name: as in ``--env``.
        entry_point: ``module:class`` of the gymnasium environment.
        gym_id: id under which gymnasium knows it.
        max_episode_steps: time limit [steps].
        knobs: by name.
        discrete_actions: whether an action is an index; a vector otherwise.
        tabular: solved exactly; value iteration gives the experts, ``train-maxent`` the rewards.
        physics: counts the changes that altered what happens in it. Part of every key.
    """

    name: str
    entry_point: str
    gym_id: str
    max_episode_steps: int
    knobs: dict[str, Knob]
    discrete_actions: bool = False
    tabular: bool = False
    physics: int = 1
