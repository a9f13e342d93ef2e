"""Which transitions the discriminator sees: whole episodes, in the groups of the method."""

from functools import partial
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch
from msgspec import UNSET

from irlcli.configs import AIRLConfig, PPOConfig
from irlcli.data.demonstrations import Demonstrations
from irlcli.data.tensors import to_bytes
from irlcli.interventions import parse_settings
from irlcli.learners.adversary import Adversary, deal, starts_by
from irlcli.rl import ppo as rl
from irlcli.rl.loop import train_rounds
from irlcli.seeds import derive
from irlcli.stages import train_airl
from irlcli.stages.base import Job
from irlcli.trajectories import join

SETTINGS = parse_settings("lunar-lander", "engine-power=1x,1.25x")
CONFIG = AIRLConfig(updates_per_round=2, batch_size=32, ppo=PPOConfig(n_envs=8, n_steps=64))


@pytest.fixture(scope="module")
def demos():
    groups = {
        str(s): tuple(rl.roll_out("lunar-lander", s, "random", 4, 0, f"test {s}")) for s in SETTINGS
    }
    return Demonstrations("lunar-lander", groups, {})


def make(demos, **changes):
    config = msgspec.structs.replace(CONFIG, **changes)
    worlds = rl.make_worlds("lunar-lander", SETTINGS, config.ppo.n_envs)
    trainer = rl.PPOTrainer(worlds, config.ppo, 10_000, 0, "test")
    return trainer, Adversary(demos, config, worlds, 0)


def test_seeds_of_different_purposes_differ():
    seeds = {
        tuple(derive(purpose, seed, index, 2))
        for purpose in ("train-expert", "train-airl", "transfer")
        for seed in range(3)
        for index in range(-1, 3)
    }
    assert len(seeds) == 3 * 3 * 4
    assert derive("transfer", 1, 2, 3)[:2] == derive("transfer", 1, 2, 2)


def test_starts_by_keeps_the_episodes_that_began_in_time():
    ended = np.zeros((7, 2), dtype=bool)
    ended[[1, 4], 0] = True  # episodes start at 0, 2, 5
    assert starts_by(ended, 2)[:, 0].tolist() == [True] * 5 + [False] * 2
    assert starts_by(ended, 4)[:, 0].tolist() == [True] * 5 + [False] * 2
    assert starts_by(ended, 5)[:, 0].all()
    assert starts_by(ended, -3)[:, 0].tolist() == [True] * 2 + [False] * 5
    assert starts_by(ended, 0)[:, 1].all()


def test_episodes_that_start_in_time_are_an_unbiased_sample():
    """Half of all episodes take 2 steps, half 10: whole ones at a horizon of 10 show just that."""
    rng = np.random.default_rng(0)
    ended = np.zeros((15, 20_000), dtype=bool)
    for world in range(ended.shape[1]):
        t = -1
        while (t := t + rng.choice([2, 10])) < 15:
            ended[t, world] = True
    short = {}
    for name, kept in (
        ("in time", starts_by(ended, 15 - 10)),
        ("all that end", np.ones_like(ended)),
    ):
        lengths = []
        for world in range(ended.shape[1]):
            ends = np.flatnonzero(ended[:, world] & kept[:, world])
            lengths.append(np.diff(ends, prepend=-1))
        short[name] = np.mean(np.concatenate(lengths) == 2)
    assert short["in time"] == pytest.approx(0.5, abs=0.01)
    assert short["all that end"] > 0.6


def test_deal_gives_every_group_its_share_of_every_setting():
    settings = np.repeat([0, 1], [8, 4])
    groups = deal(settings, np.random.default_rng(1))
    for setting, share in ((0, 4), (1, 2)):
        assert np.bincount(groups[settings == setting]).tolist() == [share, share]
    assert sorted(deal(np.array([0, 1, 2]), np.random.default_rng(0))) == [0, 1, 2]
    different = deal(settings, np.random.default_rng(2))
    assert not np.array_equal(groups, different)


def test_rounds_cut_no_episode_that_the_discriminator_sees(demos):
    trainer, adversary = make(demos, ppo=PPOConfig(n_envs=8, n_steps=1500))
    (rollout,) = trainer.train_round(0, partial(adversary.reward, policy=trainer.policy))
    groups = adversary._by_group([rollout], adversary._world_groups)
    for data in groups:
        # Each kept episode stands for exactly the horizon: its steps and its absorbing ones.
        ends = data.terminated.sum()
        assert ends > 0
        assert len(data) + data.remaining.sum() == ends * 1000
    assert sum(len(d) for d in groups) < rollout.terminated.size


def test_shuffled_groups_hold_the_same_episodes_mixed(demos):
    _, plain = make(demos, method="irm")
    _, shuffled = make(demos, method="irm-shuffled")
    assert len(shuffled._expert) == 2

    def rows(groups):
        stacked = np.concatenate([d.observations for d in groups])
        return stacked[np.lexsort(stacked.T)]

    np.testing.assert_array_equal(rows(shuffled._expert), rows(plain._expert))
    for group in shuffled._expert:
        for true in plain._expert:
            share = np.isin(group.observations[:, 0], true.observations[:, 0]).mean()
            assert 0 < share < 1
    worlds = shuffled._world_groups
    assert np.bincount(worlds[:4]).tolist() == np.bincount(worlds[4:]).tolist() == [2, 2]


def test_diagnostics_stay_with_the_true_settings_when_labels_are_shuffled(demos):
    """With the discriminator untouched, IRM and its shuffled control see the same settings."""
    found = []
    for method in ("irm", "irm-shuffled"):
        trainer, adversary = make(demos, method=method)
        assert adversary._expert_settings[0].observations.shape[0] == sum(
            len(t) for t in demos.trajectories[str(SETTINGS[0])]
        )
        rollouts = trainer.train_round(0, partial(adversary.reward, policy=trainer.policy))
        found.append(adversary.train_round(0, rollouts, trainer.policy))
    assert [set(row) for row in found[0]] == [set(row) for row in found[1]]
    assert found[0] != found[1]


def test_erm_pools_by_count(demos):
    _, adversary = make(demos, method="erm")
    policy = rl.PPOTrainer(
        rl.make_worlds("lunar-lander", SETTINGS, 8), CONFIG.ppo, 10_000, 0, "test"
    ).policy
    pools = [adversary._pool(d, policy) for d in adversary._expert]
    _, (joined,), _ = adversary._grouped(pools, pools, [])
    assert len(joined.draw) == sum(len(pool.draw) for pool in pools)
    assert torch.equal(joined.observations, torch.cat([pool.observations for pool in pools]))


def test_a_student_begins_as_a_clone_if_asked(demos):
    """Of all experts, whatever the method; it takes the demonstrations for likelier than before."""
    found = {}
    for method, epochs in (("erm", UNSET), ("erm", 5), ("irm-shuffled", 5)):
        trainer, adversary = make(demos, method=method, bc_epochs=epochs)
        adversary.clone_experts(trainer)
        data = join(adversary._expert_settings)
        likelihood = float(adversary.actions.log_prob(trainer.policy, data).mean())
        found[method, epochs] = likelihood, to_bytes(trainer.state_dict())
    untouched, _ = make(demos)
    assert found["erm", UNSET][1] == to_bytes(untouched.state_dict())
    assert found["erm", 5][0] > found["erm", UNSET][0]
    assert found["erm", 5] == found["irm-shuffled", 5]


def test_no_epochs_of_cloning_are_no_clone(tmp_path):
    """What settings/ ask for can be switched off, and is the run that nobody asked it for."""
    made = {}
    for epochs in (UNSET, 0, 3):
        config = msgspec.structs.replace(CONFIG, bc_epochs=epochs)
        made[epochs] = train_airl.request(tmp_path, "lunar-lander", SETTINGS, config)
    assert made[0] == made[UNSET] != made[3]
    assert made[3].label.count("from a clone") == 1 and "clone" not in made[0].label


def test_a_resumed_clone_is_not_cloned_again(demos, tmp_path):
    console = SimpleNamespace(progress=lambda *_: None, scalars=lambda *_: None, warn=pytest.fail)

    def train(begin):
        saved = []
        keep = SimpleNamespace(load=lambda: begin, offer=lambda state: saved.append(state()))
        trainer, adversary = make(demos, bc_epochs=2)
        trainer.total_steps = 3 * trainer.steps_per_round
        job = Job(None, {}, tmp_path, keep, console)
        train_rounds(job, trainer, [str(s) for s in SETTINGS], adversary=adversary)
        return saved

    through = train(None)
    assert train(through[0]) == through[1:]
