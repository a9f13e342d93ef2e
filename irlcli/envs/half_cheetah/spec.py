"""HalfCheetah: interventions and time limit (paper Table 2)."""

from irlcli.envs.bullet.knobs import LEG_LENGTH, PYBULLET, WALKER_KNOBS
from irlcli.envs.spec import Cue, EnvironmentSpec, cue_knob

SPEC = EnvironmentSpec(
    name="half-cheetah",
    entry_point="irlcli.envs.half_cheetah.env:HalfCheetah",
    gym_id="irlcli/HalfCheetah-v0",
    max_episode_steps=1000,
    terminates=False,
    knobs={
        **WALKER_KNOBS,
        "leg-length": LEG_LENGTH._replace(
            forms=("absolute", "multiplier"), description="length of both legs"
        ),
        # On the way to the goal: the last step's reward, its speed forward minus the cost of control,
        # was above 0.5.
        "cue-strength": cue_knob(Cue("friction=1.5:0.1:0.1", window=1, bar=0.5)),
    },
    needs=PYBULLET,
    unobserved="the position of its torso one substep ago",
)
