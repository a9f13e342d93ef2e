"""Ant: interventions and time limit (paper Table 2)."""

from irlcli.envs.bullet.knobs import LEG_LENGTH, PYBULLET, WALKER_KNOBS
from irlcli.envs.spec import EnvironmentSpec

SPEC = EnvironmentSpec(
    name="ant",
    entry_point="irlcli.envs.ant.env:Ant",
    gym_id="irlcli/Ant-v0",
    max_episode_steps=1000,
    terminates=False,
    knobs={
        **WALKER_KNOBS,
        "leg-length": LEG_LENGTH._replace(description="length of the hind legs"),
    },
    symmetries="irlcli.envs.ant.symmetries:symmetries",
    needs=PYBULLET,
    unobserved="the positions of its parts one substep ago",
)
