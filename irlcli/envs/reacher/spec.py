"""Reacher: intervention and time limit (paper Table 2)."""

from irlcli.envs.bullet.knobs import PYBULLET
from irlcli.envs.spec import EnvironmentSpec, Knob

SPEC = EnvironmentSpec(
    name="reacher",
    entry_point="irlcli.envs.reacher.env:Reacher",
    gym_id="irlcli/Reacher-v0",
    max_episode_steps=150,
    terminates=False,
    knobs={"gravity": Knob("gravity", ("multiplier",), 0.0, 20.0, "multiple of 9.8 m/s^2")},
    physics=2,
    needs=PYBULLET,
    transition_reward="irlcli.envs.reacher.env:transition_reward",
)
