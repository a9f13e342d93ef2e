"""MaxEnt IRL on cued maps: closed forms, and the case in which invariance must win."""

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from irlcli.configs import CuedMapsConfig
from irlcli.controls.cued_fits import (
    dataset,
    fit,
    held_out_risk,
    unseen,
    without,
)
from irlcli.controls.cued_maps import draw, features, hint_weights, torus
from irlcli.controls.methods import MapMethod
from irlcli.learners.maxent import MaxEnt, Risks
from irlcli.learners.soft_values import solve

CONFIG = CuedMapsConfig(
    size=12,
    horizon=6,
    value=2.0,
    texture=0.75,
    episodes=600,
    unseen=0.1,
    unseen_maps=2,
    iterations=250,
    warmup=100,
    learning_rate=1e-2,
)
LINEAR = 0
SEEDS = range(4)


def strengths(*of_each_setting):
    return np.tile(np.array(of_each_setting)[:, None], (len(SEEDS), 1, 1))


@pytest.mark.parametrize("penalty", ["irmv1", "irmv1-full", "closed-form", "vrex"])
def test_the_invariant_reward_has_no_penalty_and_is_a_fixed_point(penalty):
    """A texture that always agrees with the quality: psi = value / 2 and 0 is the true reward."""
    maps = draw([0], 6, 1.0, np.array([[[0.95], [0.8]]]), purpose=0)
    settings = torus(6, 2)
    expert = solve(settings, 2.0 * maps.quality, 5).occupancy[0]
    # The same map twice: equal risks, so that V-REx is zero as well.
    maps.kinds[:, 1] = maps.kinds[:, 0]
    own = np.zeros((2, 2, 36))
    own[[0, 1], [0, 1]] = expert[0]
    learner = MaxEnt(
        settings, features(1), [Risks(own, np.eye(2), np.full(2, 0.5))], np.array([1e4]),
        np.zeros(1), [0], penalty=penalty, horizon=5, hidden=0, learning_rate=1e-2,
        kinds=maps.kinds,
    )  # fmt: skip
    with torch.no_grad():
        learner.networks.psi[0, :, 0] = torch.tensor([1.0, 0.0])
    learner.step(record=True)
    assert learner.records[0].penalty[0] == pytest.approx(0.0, abs=1e-20)
    assert np.allclose(learner.networks.psi.grad, 0.0, atol=1e-8)


@pytest.fixture(scope="module")
def data():
    return dataset(CONFIG, strengths(0.95, 0.8), SEEDS)


def quality(data, variants, hidden=LINEAR):
    """Mean quality visited in unseen maps, for each variant."""
    fitted = fit(CONFIG, data, variants, hidden, SEEDS)
    return unseen(CONFIG, fitted, SEEDS, 1).quality.mean(-1)


@pytest.mark.parametrize("hidden", [LINEAR, 8], ids=["linear", "learned"])
def test_irm_wins_and_neither_its_control_nor_l2_do(data, hidden):
    """Chance is 0.5."""
    erm, decayed, shuffled, irm, texture = quality(
        data,
        [
            MapMethod("pooled"),
            MapMethod("pooled", l2=0.1),
            MapMethod("shuffled", "irmv1-full", 1e4),
            MapMethod("per-setting", "irmv1-full", 1e4),
            MapMethod("pooled", sees="texture"),
        ],
        hidden,
    )
    assert max(erm, decayed, shuffled) < 0.45
    assert 0.52 < irm < texture + 0.03


def test_without_a_gap_between_the_settings_nothing_helps():
    data = dataset(CONFIG, strengths(0.875, 0.875), SEEDS)
    irm, vrex = quality(
        data,
        [MapMethod("per-setting", "irmv1-full", 1e2), MapMethod("per-setting", "vrex", 1e2)],
    )
    assert max(irm, vrex) < 0.47


def test_erm_pays_for_the_colour_and_the_texture_alone_does_not(data):
    fitted = fit(
        CONFIG, data, [MapMethod("pooled"), MapMethod("pooled", sees="texture")], LINEAR, SEEDS
    )
    (erm, texture) = hint_weights(fitted.reward)
    assert (erm[:, 1] > erm[:, 0]).all() and (erm > 0.0).all()
    assert (texture[:, 1] == 0.0).all() and (texture[:, 0] > 0.5).all()


def test_the_risk_of_a_setting_is_its_negative_log_likelihood(data):
    fitted = fit(replace(CONFIG, iterations=120), data, [MapMethod("pooled")], LINEAR, SEEDS)
    each = [held_out_risk(CONFIG, data, e, fitted) for e in (0, 1)]
    # The record is made before the last update.
    assert np.allclose(np.mean(each, axis=0), -fitted.log_likelihood, rtol=1e-3)


def test_group_dro_nears_the_smallest_worst_risk_as_lambda_grows(data):
    """Its loss does not grow with lambda, so a large one must not make the steps small."""
    weights = (0.0, 10.0, 100.0)
    chosen = [MapMethod("per-setting", "group-dro", weight) for weight in weights]
    fitted = fit(CONFIG, data, chosen, LINEAR, SEEDS)
    risks = np.stack([held_out_risk(CONFIG, data, e, fitted) for e in (0, 1)])
    worst = risks.max(axis=0).mean(axis=-1)
    assert worst[2] < worst[0] and worst[2] <= worst[1] + 1e-3


def test_a_setting_that_is_left_out_is_gone(data):
    (kept,) = without(data, 0).maps.kinds.swapaxes(0, 1)
    assert np.array_equal(kept, data.maps.kinds[:, 1])
    assert all(len(demos.states) == 1 for demos in without(data, 0).demos)


def test_the_penalty_before_is_that_at_the_end_of_the_warm_up(data):
    """A fit that ends there has it as its last one."""
    variant = [MapMethod("per-setting", "irmv1-full", 1e4, warm=True)]
    short, whole = (
        fit(replace(CONFIG, iterations=n), data, variant, LINEAR, SEEDS)
        for n in (CONFIG.warmup + 1, CONFIG.iterations)
    )
    np.testing.assert_allclose(whole.penalty_before, short.penalty)
    assert (whole.penalty < 0.2 * whole.penalty_before).all()


def test_variants_come_back_in_the_order_that_they_were_asked_for(data):
    wanted = [
        MapMethod("pooled"),
        MapMethod("per-setting", "vrex", 10.0),
        MapMethod("pooled", l2=5.0),
    ]
    short = replace(CONFIG, iterations=110)
    together = fit(short, data, wanted, LINEAR, SEEDS).reward
    for k, variant in enumerate(wanted):
        assert np.allclose(together[k], fit(short, data, [variant], LINEAR, SEEDS).reward[0])
