"""What a command costs before it does anything, against importing typer and rich.

Counted in CPU seconds of child processes, the least of several runs each, in one process run.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile

RUNS = 15


def main() -> None:
    """Print the cost of ``irl --help`` and of a cache hit, and their ratios."""
    with tempfile.TemporaryDirectory() as store:
        hit = [sys.executable, "-m", "irlcli", "evaluate", "--random", "--env", "lunar-lander"]
        hit += ["--intervention", "bounce=0.9", "--profile", "smoke", "--quiet", "--store", store]
        hit += ["--json"]
        subprocess.run(hit, check=True, stdout=subprocess.DEVNULL)
        base = _cost([sys.executable, "-c", "import typer, rich"])
        print(f"{'command':20}{'CPU ms':>8}{'x base':>8}")
        for name, command in {
            "import typer, rich": None,
            "irl --help": [sys.executable, "-m", "irlcli", "--help"],
            "a cache hit": hit,
        }.items():
            cost = base if command is None else _cost(command)
            print(f"{name:20}{1e3 * cost:8.1f}{cost / base:8.2f}")


def _cost(command: list[str]) -> float:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    costs = []
    for _ in range(RUNS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        costs.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(costs)


if __name__ == "__main__":
    main()
