"""The MuJoCo robots: interventions and time limits.

The paper's authors use these five robots in a second paper (Ovinnikov et al. 2024, arXiv 2409.08012),
with other masses, joint limits, actuators and friction.
"""

from irlcli.envs.spec import EnvironmentSpec, Knob, Needs

MUJOCO = Needs("mujoco", "MuJoCo", "in irlcli's checkout: pip install '.[mujoco]'")


def _knobs(legs: str) -> dict[str, Knob]:
    """The interventions of every robot; ``legs`` says which legs change."""
    return {
        "mass": Knob("mass", ("multiplier",), 0.1, 10.0, "mass of every part"),
        "friction": Knob(
            "friction", ("multiplier",), 0.0, 10.0, "friction of the robot and of the floor"
        ),
        "gravity": Knob("gravity", ("multiplier",), 0.0, 10.0, "multiple of 9.81 m/s^2"),
        "leg-length": Knob("leg_length", ("multiplier",), 0.2, 3.0, f"length of {legs}"),
        "actuator-strength": Knob(
            "actuator_strength", ("multiplier",), 0.05, 10.0, "torque of every motor"
        ),
        "joint-limit": Knob("joint_limit", ("multiplier",), 0.1, 2.0, "how far every joint turns"),
    }


def _spec(
    name: str,
    robot: str,
    knobs: dict[str, Knob],
    terminates: bool,
    symmetries: str | None = None,
) -> EnvironmentSpec:
    return EnvironmentSpec(
        name=name,
        entry_point=f"irlcli.envs.mujoco.env:{robot}",
        gym_id=f"irlcli/MuJoCo{robot}-v0",
        max_episode_steps=1000,
        terminates=terminates,
        knobs=knobs,
        symmetries=symmetries,
        unobserved="the horizontal position of the robot",
        needs=MUJOCO,
    )


def _falling(name: str, robot: str, legs: str, symmetries: str | None = None) -> EnvironmentSpec:
    """A robot whose episode may end with a fall."""
    ends = Knob(
        "terminate_when_unhealthy",
        ("absolute",),
        0.0,
        1.0,
        "whether a fall ends the episode",
        whole=True,
    )
    knobs = {**_knobs(legs), "terminate-when-unhealthy": ends}
    return _spec(name, robot, knobs, terminates=True, symmetries=symmetries)


MUJOCO_ROBOTS = (
    _falling("mujoco-ant", "Ant", "the hind legs", "irlcli.envs.mujoco.symmetries:ant"),
    _spec("mujoco-half-cheetah", "HalfCheetah", _knobs("both legs"), terminates=False),
    _falling("mujoco-hopper", "Hopper", "the leg"),
    _falling("mujoco-walker2d", "Walker2d", "both legs"),
    _falling("mujoco-humanoid", "Humanoid", "both legs"),
)
