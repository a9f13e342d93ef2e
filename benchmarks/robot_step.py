"""Instructions that one step of each robot executes, counted by callgrind.

    python -m benchmarks.robot_step [ant half-cheetah-bullet mujoco-Ant mujoco-Ant-gymnasium ...]

Counts are the difference of two run lengths, so start-up, reset and imports cancel, and they
do not depend on what else the machine is doing. Needs ``valgrind`` on the path. Actions are
uniform in the whole range, the same for every run. A name that ends in ``-bullet`` is Bullet's step
under the same torques alone, one that ends in ``-gymnasium`` Gymnasium's own MuJoCo environment.
"""

from __future__ import annotations

import argparse
import os
import sys

import numpy as np

from benchmarks.startup import counted

SHORT, LONG = 200, 500
# Callgrind counts `rep movsb` and `rep stosb`, with which glibc copies and fills large blocks, once
# per byte. Bullet's answers are copied by them: 30 KB each.
NO_REP = "glibc.cpu.x86_rep_movsb_threshold=1000000000:glibc.cpu.x86_rep_stosb_threshold=1000000000"
MUJOCO = ("Ant", "HalfCheetah", "Hopper", "Walker2d", "Humanoid")
WORLDS = (
    "ant",
    "ant-bullet",
    "half-cheetah",
    "half-cheetah-bullet",
    "reacher",
    *(f"mujoco-{name}{of}" for name in MUJOCO for of in ("", "-gymnasium")),
)


def make(name: str):
    """The environment called ``name``."""
    kind, _, of = name.removeprefix("mujoco-").partition("-")
    if name.startswith("mujoco-"):
        if of == "gymnasium":
            import gymnasium

            return gymnasium.make(f"{kind}-v5").unwrapped
        from irlcli.envs.mujoco import env

        return getattr(env, kind)()
    from irlcli.envs.ant.env import Ant
    from irlcli.envs.half_cheetah.env import HalfCheetah
    from irlcli.envs.reacher.env import Reacher

    robots = {"ant": Ant, "half-cheetah": HalfCheetah, "reacher": Reacher}
    return robots[name.removesuffix("-bullet")]()


def roll_out(name: str, steps: int) -> None:
    """Take ``steps`` random steps of one episode."""
    env = make(name)
    env.reset(seed=0)
    random = np.random.default_rng(0)
    bound = env.action_space.high[0]
    for action in random.uniform(-bound, bound, (LONG, *env.action_space.shape))[:steps]:
        if name.endswith("-bullet"):
            env._robot.drive(env.torques * action)
            env._world.step()
        else:
            env.step(action)
    env.close()


def instructions(name: str, steps: int) -> int:
    """Instructions of a whole process that takes ``steps`` steps."""
    return counted(
        ["-m", "benchmarks.robot_step", "--roll-out", name, str(steps)],
        {**os.environ, "OMP_NUM_THREADS": "1", "GLIBC_TUNABLES": NO_REP},
    )


def main(names: list[str]) -> None:
    """Print one line per environment."""
    for name in names or list(WORLDS):
        roll_out(name, 1)  # so that no counted run compiles bytecode
        count = (instructions(name, LONG) - instructions(name, SHORT)) / (LONG - SHORT)
        print(f"{name:22s} {count / 1e6:6.3f} M instructions per step", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--roll-out"]:
        roll_out(sys.argv[2], int(sys.argv[3]))
    else:
        parser = argparse.ArgumentParser(description=__doc__)
        parser.add_argument("robot", nargs="*", help=f"default: {', '.join(WORLDS)}")
        main(parser.parse_args().robot)
