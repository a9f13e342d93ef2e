"""HalfCheetah: interventions and time limit (paper Table 2)."""

from irlcli.envs.bullet.knobs import WALKER_KNOBS
from irlcli.envs.spec import EnvironmentSpec, Knob

SPEC = EnvironmentSpec(
    name="half-cheetah",
    entry_point="irlcli.envs.half_cheetah.env:HalfCheetah",
    gym_id="irlcli/HalfCheetah-v0",
    max_episode_steps=1000,
    knobs={
        **WALKER_KNOBS,
        "leg-length": Knob(
            "leg_length", ("absolute", "multiplier"), 0.2, 5.0, "length of both legs"
        ),
    },
    unobserved="the position of its torso one substep ago",
)
