"""Learners turn demonstrations into a reward. Importing this loads no torch."""

from importlib import import_module
from typing import Any

# Name to module and class, one line each. A class has the interface of
# :class:`irlcli.learners.airl.AIRL`.
LEARNERS = {
    "airl": "irlcli.learners.airl:AIRL",
}


def learner(name: str) -> Any:
    """The learner class called ``name``, one of :data:`LEARNERS`."""
    module, _, attribute = LEARNERS[name].partition(":")
    return getattr(import_module(module), attribute)
