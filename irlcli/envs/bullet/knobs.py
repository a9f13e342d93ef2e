"""The knobs of Ant and HalfCheetah (paper Table 2) and their library, without importing PyBullet."""

from irlcli.envs.spec import Knob, Needs

PYBULLET = Needs(
    "irlcli.envs.bullet.engine",
    "PyBullet",
    "use Python 3.11, for which it has wheels, or a MuJoCo robot, such as --env mujoco-ant",
)

# Which legs, the robot decides.
LEG_LENGTH = Knob("leg_length", ("multiplier",), 0.2, 5.0, "length of the legs")
WALKER_KNOBS = {
    "mass": Knob("mass", ("multiplier",), 0.1, 10.0, "mass of every link"),
    "goal-y": Knob(
        "goal_y", ("absolute",), -1e4, 1e4, "the goal is at (1000, goal-y) m", observed="a goal"
    ),
    "direction": Knob(
        "direction",
        ("absolute", "range"),
        -180.0,
        180.0,
        "direction of the goal, in degrees from straight ahead",
        observed="a goal",
    ),
    "friction": Knob(
        "friction",
        ("triple",),
        0.0,
        10.0,
        "tangential, torsional and rolling friction of the robot's links",
    ),
}
