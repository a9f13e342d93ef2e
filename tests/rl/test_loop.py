"""Rounds of training: what a row holds, and what a resumed run needs."""

import numpy as np
import pytest
import torch

from irlcli.learners.selection import BestRound
from irlcli.rl.loop import Training
from irlcli.trajectories import Rollout


def an_episode(episode_return, progress, terminated, errors=()):
    """Of two steps, in each of two worlds."""
    ends = np.array([[False, False], [True, True]])
    nothing = np.zeros((2, 2, 1), dtype=np.float32)
    return Rollout(
        observations=nothing,
        actions=nothing,
        next_observations=nothing,
        log_probs=nothing[..., 0],
        true_rewards=np.zeros((2, 2)),
        terminated=ends & terminated,
        truncated=ends & ~np.array(terminated),
        lengths=2 * ends,
        returns=np.where(ends, episode_return, 0.0),
        progress=np.where(ends, progress, 0.0),
        errors=errors,
    )


class Counting:
    """A trainer of five rounds, each of which adds 1 to the policy's only weight."""

    rounds, steps_per_round = 5, 4

    def __init__(self):
        self.policy = torch.nn.Linear(1, 1, bias=False)
        self.policy.load_state_dict({"weight": torch.zeros(1, 1)})

    @property
    def steps(self):
        return 4 * int(self.policy.weight.item())

    def train_round(self, index, source):
        with torch.no_grad():
            self.policy.weight += 1.0
        # The first world's episode terminates, the other's is cut.
        return [an_episode(7.0, 9.0, [True, False])]

    def state_dict(self):
        return {"weight": self.policy.weight.detach().clone()}

    def load_state_dict(self, state):
        self.policy.load_state_dict(state)


class FakeChallengers:
    """Whose episodes return 16 and progress by 32."""

    def __init__(self, errors=()):
        self.errors = errors

    def train_round(self, index):
        return [an_episode(16.0, 32.0, [False, False], self.errors)]


class FixedReward:
    """Has a snapshot, as the learners that selectors keep."""

    def snapshot(self):
        return {}

    def load_snapshot(self, state):
        pass


def training(selector=None, challengers=None):
    settings = ["one", "other"]
    return Training(Counting(), None, settings, selector=selector, challengers=challengers)


def test_a_row_holds_the_episodes_of_its_setting():
    one, other = training().run(lambda *_: None, pytest.fail)[:2]
    for row, terminated in ((one, 1.0), (other, 0.0)):
        assert (row["true_return"], row["progress"], row["episode_length"]) == (7.0, 9.0, 2.0)
        assert (row["episodes"], row["terminated"]) == (1, terminated)


def test_a_row_holds_what_the_challenger_earned():
    for row in training(challengers=FakeChallengers()).run(lambda *_: None, pytest.fail):
        assert (row["challenger_return"], row["challenger_progress"]) == (16.0, 32.0)
        assert (row["true_return"], row["progress"]) == (7.0, 9.0)


def test_an_error_in_a_challengers_world_is_named():
    warnings = []
    challengers = FakeChallengers(((1, "the state is not finite"),))
    training(challengers=challengers).run(lambda *_: None, warnings.append)
    assert len(warnings) == 5
    named = "other, the challenger's world 1, round 0: the state is not finite"
    assert warnings[0].startswith(named)


def test_a_round_is_scored_after_the_learner_has_learned_from_it():
    """Otherwise the reward that is kept would be another than the one that scored."""
    calls = []

    class Learning:
        def begin(self, trainer):
            calls.append("begin")

        def update(self, index, rollouts, policy, challenger_rollouts):
            calls.append(f"update {index}")
            return [{}, {}]

    class Scoring:
        def consider(self, index, policy):
            calls.append(f"score {index}")
            return {}

        def restore(self, policy):
            calls.append("restore")

    Training(Counting(), None, ["one", "other"], Learning(), Scoring()).run(
        lambda *_: None, pytest.fail
    )
    rounds = [call for index in range(5) for call in (f"update {index}", f"score {index}")]
    assert calls == ["begin", *rounds, "restore"]


def test_a_resumed_run_remembers_the_best_round():
    """The second of five rounds scores highest; the run is cut after each of them."""

    def selected():
        return training(
            BestRound(lambda policy: -abs(policy.weight.item() - 2.0), FixedReward(), 1, 5)
        )

    saved = []
    selected().run(lambda t, _: saved.append((t.state_dict(), list(t.rows))), pytest.fail)
    assert len(saved) == 5
    for state, rows in saved:
        resumed = selected()
        resumed.load_state_dict(state, rows)
        resumed.run(lambda *_: None, pytest.fail)
        assert resumed.policy.weight.item() == 2.0
