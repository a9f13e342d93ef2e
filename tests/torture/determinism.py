"""Every stage twice, under conditions that must not matter: the ids must be equal.

    python tests/torture/determinism.py [--env ant ...]

The second time has two processes that step the environments, and another hash seed, locale, time zone,
umask, number of threads, current directory and path of the store. Profile smoke. Exits 1 where an id
differs, and names the artefacts.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from irlcli.store import Store

# Training intervention and unseen setting.
ROBOTS = {
    "lunar-lander": ("engine-power=1x,1.25x", "engine-power=1.5x"),
    "ant": ("leg-length=1x,2x", "leg-length=3x"),
    "half-cheetah": ("direction=-10..0,5", "direction=10"),
    "reacher": ("gravity=0.5x,2x", "gravity=4x"),
}
OTHERWISE = {
    **{"PYTHONHASHSEED": "12345", "LC_ALL": "C", "TZ": "Asia/Kathmandu"},
    **{"OMP_NUM_THREADS": "2", "COLUMNS": "20", "TERM": "dumb"},
}


def lines(env: str) -> list[list[str]]:
    """The whole chain in ``env``."""
    if env == "gridworld":
        mazes = ["--env", env, "--intervention", "path-group=1,2,3"]
        return [
            ["collect-experts", *mazes, "--name", "demos"],
            ["train-maxent", "--demos", "demos", "--method", "irm"],
            ["report", "figure2"],
        ]
    trained, unseen = ROBOTS[env]
    return [
        ["collect-experts", "--env", env, "--intervention", trained, "--name", "demos"],
        ["train-airl", "--demos", "demos", "--method", "irm", "--name", "airl"],
        ["transfer", "--reward", "airl", "--ood", unseen, "--name", "moved"],
        ["evaluate", "--policy", "moved"],
        ["evaluate", "--expert", "--env", env, "--ood", unseen],
        ["evaluate", "--random", "--env", env, "--ood", unseen],
    ]


def compute(store: Path, chain: Sequence[Sequence[str]], workers: int, **options) -> dict[str, str]:
    """Run ``chain`` into a new ``store``; id to stage of everything in it."""
    for line in chain:
        common = ["--profile", "smoke", "--quiet", "--workers", str(workers), "--store", str(store)]
        command = [sys.executable, "-m", "irlcli", *line, *common]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, **options)
    return {a.id: a.manifest.record.stage for a in Store(store).artefacts()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", choices=[*ROBOTS, "gridworld"])
    chosen = parser.parse_args().env or [*ROBOTS, "gridworld"]
    differ = 0
    # The second run has another current directory, so it needs the checkout's path.
    path = os.pathsep.join(filter(None, [os.getcwd(), os.environ.get("PYTHONPATH")]))
    for env in chosen:
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as place:
            first = compute(Path(place) / "a", lines(env), 1)
            elsewhere = Path(place) / "another größe"
            elsewhere.mkdir()
            second = compute(
                elsewhere / "of store",
                lines(env),
                2,
                cwd=elsewhere,
                env={**os.environ, **OTHERWISE, "PYTHONPATH": path},
                umask=0o077,
            )
        odd = {
            id16: stage
            for id16, stage in (first | second).items()
            if (id16 in first) != (id16 in second)
        }
        differ += len(odd)
        print(
            f"{env:14}{len(first):4} artefacts, {len(odd)} differ  {time.monotonic() - started:6.0f} s"
        )
        for id16, stage in odd.items():
            print(f"  {id16} {stage}", file=sys.stderr)
    sys.exit(1 if differ else 0)


if __name__ == "__main__":
    main()
