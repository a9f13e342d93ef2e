"""What the jobs of a cluster ask for."""

import re
from collections.abc import Mapping
from typing import NamedTuple

from irlcli.errors import UsageError

DEFAULT_TIME = "4:00:00"


def parse_minutes(text: str) -> int:
    """A time limit as Slurm writes it (``90``, ``4:00:00``, ``1-12``), in whole minutes.

    Raises:
        UsageError: not a time limit.
    """
    found = re.fullmatch(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?", text)
    if not found:
        raise UsageError(f"--time {text!r} is not a time limit", "for example 4:00:00, or 1-12")
    days, first, second, third = (int(part) if part else 0 for part in found.groups())
    if found[1]:
        seconds = days * 86400 + first * 3600 + second * 60 + third
    elif found[4]:
        seconds = first * 3600 + second * 60 + third
    else:
        seconds = first * 60 + second
    if seconds < 60:
        raise UsageError(f"--time {text} is less than a minute", "for example 4:00:00")
    return -(-seconds // 60)


class Resources(NamedTuple):
    """What every job asks for.

    Attributes:
        minutes: time limit.
        cpus: per job.
        parallelism: elements of an array that run at a time.
        warning: how long before the time limit a job is warned [s].
        extra: other options of sbatch, by name.
    """

    partition: str | None = None
    minutes: int = parse_minutes(DEFAULT_TIME)
    cpus: int = 1
    parallelism: int = 50
    warning: int = 90
    extra: Mapping[str, str] = {}

    def words(self) -> list[str]:
        """The options of srun for the same place and size."""
        words = [] if self.partition is None else [f"--partition={self.partition}"]
        words.append(f"--cpus-per-task={self.cpus}")
        return words + [f"--{name}={value}" for name, value in self.extra.items()]
