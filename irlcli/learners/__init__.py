"""Learners turn demonstrations into a reward. Importing this loads no torch.

The reward, from training to other programs: :mod:`~irlcli.learners.reward_model` is g and h,
:mod:`~irlcli.learners.scoring` how they score a policy in training, :mod:`~irlcli.learners.frozen`
what is left when training ended, :mod:`~irlcli.learners.standalone` the module inside it that
leaves the package, and :mod:`irlcli.rewards` the function of arrays around it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from irlcli.errors import imported


class Learner(NamedTuple):
    """Where an adversarial learner's class is, and what is part of its definition.

    Attributes:
        place: ``module:class``. The class has the interface of :class:`irlcli.learners.airl.AIRL`.
        fixes: fields of ``[airl]`` that the learner defines, whatever a config says.
    """

    place: str
    fixes: Mapping[str, Any] = {}


# Name to learner, one line each.
LEARNERS = {
    "airl": Learner("irlcli.learners.airl:AIRL"),
    "gail": Learner(
        "irlcli.learners.gail:GAIL", {"logit": "f", "shaping": False, "policy_reward": "f"}
    ),
}


def learner(name: str) -> Any:
    """The learner class called ``name``, one of :data:`LEARNERS`.

    Raises:
        StageFailed: its module cannot be imported.
    """
    return imported(f"learner {name!r}", LEARNERS[name].place)
