"""The gridworld's knobs (paper Sec. 5.1)."""

from irlcli.envs.spec import EnvironmentSpec, Knob

SPEC = EnvironmentSpec(
    name="gridworld",
    entry_point="irlcli.envs.gridworld.env:Gridworld",
    gym_id="irlcli/Gridworld-v0",
    max_episode_steps=32,
    knobs={
        "path-group": Knob(
            "path_group", ("absolute",), 0, 3, "the open gate; 0: no wall", whole=True
        ),
        "blocked": Knob(
            "blocked", ("absolute",), 0, 2, "how many groups' paths are barred", whole=True
        ),
    },
    discrete_actions=True,
    tabular=True,
)
