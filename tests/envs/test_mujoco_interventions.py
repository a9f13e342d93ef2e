"""Each intervention on a MuJoCo robot changes the physics as documented."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mujoco_robots import ROBOTS, lowest, mass, mujoco, posed

from irlcli.envs.mujoco.spec import MUJOCO_ROBOTS
from irlcli.envs.registration import make
from irlcli.errors import UsageError
from irlcli.interventions import Setting, Value, parse_setting

# [kg], of Gymnasium's models.
MASSES = {"Ant": 0.911, "HalfCheetah": 14.0, "Hopper": 15.820, "Walker2d": 23.677}


@pytest.fixture(params=sorted(ROBOTS))
def name(request):
    return request.param


@pytest.mark.parametrize("name", sorted(MASSES))
def test_the_originals_weigh_what_they_should(name):
    assert mass(ROBOTS[name]()) == pytest.approx(MASSES[name], abs=5e-4)


def test_mass_multiplies_the_mass_and_inertia_of_every_body(name):
    plain, heavy = ROBOTS[name]().model, ROBOTS[name](mass=3.0).model
    np.testing.assert_allclose(heavy.body_mass, 3.0 * plain.body_mass)
    np.testing.assert_allclose(heavy.body_inertia, 3.0 * plain.body_inertia)
    np.testing.assert_allclose(heavy.body_ipos, plain.body_ipos)


def test_mass_is_the_weight_that_the_floor_carries():
    """At rest, the vertical contact forces add up to m g."""
    for factor in (1.0, 2.0):
        env = ROBOTS["HalfCheetah"](mass=factor)
        env.reset(seed=0)
        for _ in range(200):
            env.step(np.zeros(6))
        force, carried = np.zeros(6), 0.0
        for contact in range(env.data.ncon):
            mujoco.mj_contactForce(env.model, env.data, contact, force)
            carried += force[0]
        assert carried == pytest.approx(factor * 14.0 * 9.81, rel=0.01)


def test_half_the_gravity_halves_the_fall(name):
    drops = []
    for factor in (0.5, 1.0):
        env = posed(ROBOTS[name](gravity=factor))
        index = getattr(env, "z_index", 1)
        start = env.data.qpos[index]
        env.data.qpos[index] = start + 5.0
        for _ in range(10):
            env.step(np.zeros(env.action_space.shape))
        drops.append(start + 5.0 - env.data.qpos[index])
    # Joints that relax in flight move the torso, too.
    assert drops[0] == pytest.approx(0.5 * drops[1], rel=0.1)
    assert drops[1] == pytest.approx(0.5 * 9.81 * (10 * env.dt) ** 2, rel=0.2)


@pytest.mark.parametrize("factor", [0.25, 0.5, 1.0, 2.0])
def test_friction_shortens_a_slide(factor):
    """A block of speed v slides v^2 / (2 mu g); the half-cheetah's mu is 0.4."""
    env = ROBOTS["HalfCheetah"](friction=factor)
    env.reset(seed=0)
    for _ in range(200):
        env.step(np.zeros(6))
    start = env.data.qpos[0]
    env.data.qvel[0] = 2.0
    for _ in range(200):
        env.step(np.zeros(6))
    expected = 2.0**2 / (2.0 * 0.4 * factor * 9.81)
    assert env.data.qpos[0] - start == pytest.approx(expected, rel=0.1)


def test_friction_multiplies_the_coefficients_of_robot_and_floor(name):
    plain, rough = ROBOTS[name]().model, ROBOTS[name](friction=2.5).model
    np.testing.assert_allclose(rough.geom_friction, 2.5 * plain.geom_friction)


def test_actuator_strength_multiplies_the_force_of_every_motor(name):
    forces = []
    for factor in (1.0, 0.5):
        env = posed(ROBOTS[name](actuator_strength=factor))
        env.data.ctrl[:] = env.action_space.high
        mujoco.mj_forward(env.model, env.data)
        forces.append(env.data.qfrc_actuator.copy())
    np.testing.assert_allclose(forces[1], 0.5 * forces[0])
    assert np.abs(forces[0]).max() > 10.0


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_joint_limit_multiplies_every_range_and_keeps_the_start(name, factor):
    plain, changed = ROBOTS[name]().model, ROBOTS[name](joint_limit=factor).model
    limited = plain.jnt_limited.astype(bool)
    before, after = plain.jnt_range[limited], changed.jnt_range[limited]
    np.testing.assert_allclose(np.ptp(after, axis=1), factor * np.ptp(before, axis=1))
    start = plain.qpos0[plain.jnt_qposadr[limited]]
    np.testing.assert_allclose(np.clip(start, *after.T), np.clip(start, *before.T))


def test_a_smaller_joint_limit_stops_a_motor_earlier():
    angles = []
    for factor in (0.25, 1.0):
        env = ROBOTS["Ant"](joint_limit=factor, gravity=0.0)
        env.reset(seed=0)
        for _ in range(40):
            env.step(np.array([0, 0, 1, 0, 0, 0, 0, 0], float))
        angles.append(math.degrees(env.data.qpos[7]))
    # 30 degrees either way; the limit is soft.
    assert angles == [pytest.approx(0.25 * 30, abs=3.0), pytest.approx(30, abs=3.0)]


def chain(env, *bodies: str) -> list[float]:
    """Distances [m] between the joints of a leg, of its first joint per body."""
    joints = [env.model.body(body).jntadr[0] for body in bodies]
    anchors = env.data.xanchor[joints]
    return np.linalg.norm(np.diff(anchors, axis=0), axis=1).tolist()


LEGS = {
    "HalfCheetah": [("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")],
    "Hopper": [("thigh", "leg", "foot")],
    "Walker2d": [("thigh", "leg", "foot"), ("thigh_left", "leg_left", "foot_left")],
    "Humanoid": [("right_thigh", "right_shin"), ("left_thigh", "left_shin")],
}


@pytest.mark.parametrize("name", sorted(LEGS))
@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_a_longer_leg_reaches_further(name, factor):
    plain, changed = posed(ROBOTS[name]()), posed(ROBOTS[name](leg_length=factor))
    for leg in LEGS[name]:
        expected = [factor * length for length in chain(plain, *leg)]
        assert chain(changed, *leg) == pytest.approx(expected)
    # The hips are at the same place of the torso.
    for env in (plain, changed):
        env.hips = env.data.xanchor[[env.model.body(leg[0]).jntadr[0] for leg in LEGS[name]]]
        env.hips = env.hips - env.data.body("torso").xpos
    np.testing.assert_allclose(changed.hips, plain.hips, atol=1e-9)


def test_a_longer_leg_of_the_ant_is_a_hind_leg():
    feet = {}
    for factor in (1.0, 3.0):
        env = posed(ROBOTS["Ant"](leg_length=factor))
        hips = [env.data.body(f"aux_{leg}").xpos for leg in (1, 2, 3, 4)]
        ankles = [env.data.joint(f"ankle_{leg}").xanchor for leg in (1, 2, 3, 4)]
        feet[factor] = np.linalg.norm(np.subtract(ankles, hips), axis=1)
    np.testing.assert_allclose(feet[3.0] / feet[1.0], [1.0, 1.0, 3.0, 3.0])


@pytest.mark.parametrize("factor", [0.2, 0.5, 2.0, 3.0])
def test_no_leg_begins_in_the_floor(name, factor):
    """The lowest point starts at the height at which the original's does."""
    plain, changed = posed(ROBOTS[name]()), posed(ROBOTS[name](leg_length=factor))
    assert lowest(changed) == pytest.approx(lowest(plain), abs=1e-9)


def test_a_leg_keeps_its_density_and_all_else_its_mass(name):
    """A cylinder of twice the length has twice the mass, the balls at its ends stay."""
    plain, changed = ROBOTS[name]().model, ROBOTS[name](leg_length=2.0).model
    ball = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    longer = 0.0
    for body in range(1, plain.nbody):
        before, after = plain.body_mass[body], changed.body_mass[body]
        for geom in np.flatnonzero(plain.geom_bodyid == body):
            radius, half, _ = plain.geom_size[geom]
            scale = changed.geom_size[geom, 1] / half if plain.geom_type[geom] != ball else 1.0
            volume = math.pi * radius**2 * (2.0 * half + 4.0 / 3.0 * radius)
            assert changed.geom_size[geom, 0] == radius and scale in (1.0, pytest.approx(2.0))
            if len(np.flatnonzero(plain.geom_bodyid == body)) == 1 and half:
                added = math.pi * radius**2 * 2.0 * half * (scale - 1.0)
                assert after == pytest.approx(before * (1.0 + added / volume))
        longer += after - before
    assert longer > 0.0 and mass(ROBOTS[name](leg_length=2.0)) == pytest.approx(
        longer + mass(ROBOTS[name]())
    )


def test_mass_and_leg_length_combine(name):
    both = ROBOTS[name](mass=2.0, leg_length=1.5).model.body_mass
    np.testing.assert_allclose(both, 2.0 * ROBOTS[name](leg_length=1.5).model.body_mass)


@pytest.mark.parametrize("name", ["Hopper", "Walker2d", "Humanoid"])
def test_healthy_heights_follow_the_legs(name):
    """A robot of twice the height is healthy at twice the height."""
    for factor in (0.5, 1.0, 2.0):
        env = ROBOTS[name](leg_length=factor)
        env.reset(seed=0)
        start = env.init_qpos[env.z_index]
        low = env._healthy_z_range[0] / start
        assert low == pytest.approx(
            ROBOTS[name]()._healthy_z_range[0] / ROBOTS[name]().init_qpos[env.z_index]
        )
        assert not any(env.step(np.zeros(env.action_space.shape))[2] for _ in range(3))


@pytest.mark.parametrize("spec", MUJOCO_ROBOTS, ids=lambda spec: spec.name)
def test_every_bound_can_be_simulated_and_nothing_beyond(spec):
    for name, knob in spec.knobs.items():
        for end, beyond in ((knob.low, -math.inf), (knob.high, math.inf)):
            setting = Setting(((name, Value(knob.forms[0], (end,))),))
            world = make(spec.name, setting)
            world.reset(seed=0)
            for _ in range(3):
                world.step(world.action_space.high)
            text = str(Value(knob.forms[0], (math.nextafter(end, beyond),)))
            with pytest.raises(UsageError):
                parse_setting(spec.name, f"{name}={text}")


@pytest.mark.parametrize(
    "arguments",
    [{"mass": 0.0}, {"mass": -1.0}, {"mass": math.nan}, {"leg_length": 4.0}, {"friction": "x"}],
)
def test_impossible_multipliers_are_refused(arguments):
    (name,) = arguments
    with pytest.raises(ValueError, match=f"{name} must lie in"):
        ROBOTS["Hopper"](**arguments)
