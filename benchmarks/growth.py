"""How the cost of adversarial IRL grows: with steps, settings, worlds and demonstrations.

LunarLander with the ``standard`` profile, challengers included. Every point is a process of its own:
its CPU seconds from the first round on, and its peak memory. Random demonstrations cost as much to
learn from as an expert's. Seeds at once are measured by ``benchmarks.parallel``.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from msgspec.structs import replace

from benchmarks.airl import build
from irlcli.configs import load_config
from irlcli.interventions import parse_settings
from irlcli.rl.loop import Training
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import make_worlds

ENV = "lunar-lander"
# The values of what grows; all else is as at the first of BASE.
BASE = {"rounds": 1, "settings": 2, "worlds": 16, "demonstrations": 10}
VALUES = {
    "rounds": (1, 2, 4, 8),
    "settings": (2, 4, 8, 16),
    "worlds": (8, 16, 32, 64, 128),
    "demonstrations": (10, 100, 1000),
}
WORDS = {
    "rounds": "rounds of 24,576 steps",
    "settings": "settings, which share the worlds",
    "worlds": "worlds, whose number multiplies the steps",
    "demonstrations": "demonstrations of each setting",
}


def main() -> None:
    """Print CPU seconds and memory against each quantity, and draw them if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3, help="the median is reported")
    parser.add_argument("--picture", type=Path, help="PNG file to draw")
    parser.add_argument("--point", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.point:
        print(json.dumps(measure(**json.loads(arguments.point))))
        return
    found = {
        name: [_point(name, value, arguments.repeats) for value in values]
        for name, values in VALUES.items()
    }
    for name, points in found.items():
        print(WORDS[name])
        print(f"{name:>16}{'CPU s':>10}{'x first':>10}{'size x first':>14}{'MiB':>8}")
        for value, (seconds, mib) in zip(VALUES[name], points, strict=True):
            size, cost = value / VALUES[name][0], seconds / points[0][0]
            print(f"{value:16,}{seconds:10.2f}{cost:10.2f}{size:14.0f}{mib:8.0f}")
    if arguments.picture:
        draw(found, arguments.picture)


def measure(rounds: int, settings: int, worlds: int, demonstrations: int) -> dict[str, float]:
    """CPU seconds of a training of ``rounds`` rounds, and this process's peak memory [MiB]."""
    powers = ",".join(f"{1 + number / 50:g}x" for number in range(settings))
    parsed = parse_settings(ENV, f"engine-power={powers}")
    config = load_config(ENV, "standard").airl_of(parsed)
    config = replace(config, ppo=replace(config.ppo, n_envs=worlds))
    config = replace(config, total_steps=config.ppo.steps_per_round * rounds)
    demos = [roll_out(ENV, s, "random", demonstrations, 0, "bench") for s in parsed]
    where = make_worlds(ENV, parsed, worlds)
    trainer, learner, challengers = build(ENV, parsed, where, demos, config)
    texts = [str(setting) for setting in parsed]
    training = Training(trainer, learner, texts, learner, challengers=challengers)
    started = time.process_time()
    training.run(lambda *_: None, print)
    seconds = time.process_time() - started
    mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"seconds": seconds, "mib": mib}


def _point(name: str, value: int, repeats: int) -> tuple[float, float]:
    """Medians of CPU seconds and memory."""
    point = json.dumps(BASE | {name: value})
    line = [sys.executable, "-m", "benchmarks.growth", "--point", point]
    runs = [
        json.loads(subprocess.run(line, check=True, capture_output=True, text=True).stdout)
        for _ in range(repeats)
    ]
    return tuple(statistics.median(run[what] for run in runs) for what in ("seconds", "mib"))


def draw(found: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """CPU seconds (line) and memory (dashed) against each quantity, and what linear would be."""
    figure, axes = plt.subplots(1, len(found), figsize=(3 * len(found), 2.8), layout="constrained")
    for axis, (name, points) in zip(axes, found.items(), strict=True):
        values = VALUES[name]
        seconds, mib = zip(*points, strict=True)
        axis.loglog(values, seconds, "o-", color="C0", label="CPU seconds")
        linear = [seconds[0] * value / values[0] for value in values]
        axis.loglog(values, linear, ":", color="grey", label="linear")
        axis.set_xticks(values, [f"{value:,}" for value in values])
        axis.minorticks_off()
        axis.set_xlabel(name)
        memory = axis.twinx()
        memory.plot(values, mib, "s--", color="C1", label="memory [MiB]")
        memory.set_ylim(0, None)
        handles = axis.get_lines() + memory.get_lines()
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
