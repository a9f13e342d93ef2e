"""Several trainings, of which the best is kept."""

import copy

import pytest
import torch

from irlcli.rl.restarts import Restarts


class Counting:
    """A training of two rounds, each of which adds 1 to the policy's only weight."""

    planned_steps = 20

    def steps_until(self, until):
        return self.planned_steps if until is None else until

    def __init__(self, start: float):
        self.policy = torch.nn.Linear(1, 1, bias=False)
        self.policy.load_state_dict({"weight": torch.tensor([[start]])})
        self.rows = []

    @property
    def steps(self):
        return 10 * len(self.rows)

    def run(self, after_round, warn, until=None):
        for index in range(len(self.rows), 2):
            if until is not None and self.steps >= until:
                break
            with torch.no_grad():
                self.policy.weight += 1.0
            self.rows.append({"round": index, "weight": self.policy.weight.item()})
            after_round(self, self.rows[-1:])
        return self.rows

    def state_dict(self):
        return {"weight": self.policy.weight.detach().clone()}

    def load_state_dict(self, state, rows):
        self.policy.load_state_dict(state)
        self.rows = list(rows)


def restarts(starts, score=lambda policy: policy.weight.item(), until=None):
    return Restarts(lambda index: Counting(starts[index]), len(starts), score, until)


@pytest.mark.parametrize(
    ("starts", "best"), [([0.0, 5.0, 3.0], 7.0), ([5.0, 3.0, 0.0], 7.0), ([1.0], 3.0)]
)
def test_the_policy_with_the_highest_score_is_in_place(starts, best):
    runs = restarts(starts)
    rows = runs.run(lambda *_: None, pytest.fail)
    assert runs.policy.weight.item() == best
    assert runs.scores == [start + 2 for start in starts]
    assert {row["weight"] for row in rows if row["kept"]} == {best - 1, best}
    assert [row["restart"] for row in rows] == sorted(2 * list(range(len(starts))))
    assert runs.steps == runs.planned_steps == 20 * len(starts)


def test_of_equal_scores_the_first_is_kept():
    runs = restarts([4.0, 1.0, 7.0], score=lambda policy: 1.0)
    runs.run(lambda *_: None, pytest.fail)
    assert runs.policy.weight.item() == 6.0


@pytest.mark.parametrize("until", [None, 10])
def test_a_resumed_run_equals_a_whole_one(until):
    saved = []
    whole = restarts([0.0, 5.0, 3.0], until=until)

    def keep(training, _):
        saved.append((copy.deepcopy(training.state_dict()), list(training.rows)))

    rows = whole.run(keep, pytest.fail)
    assert len(saved) == (6 if until is None else 4)
    for state, before in saved:
        resumed = restarts([0.0, 5.0, 3.0], until=until)
        resumed.load_state_dict(state, before)
        assert resumed.run(lambda *_: None, pytest.fail) == rows
        assert resumed.scores == whole.scores
        assert resumed.policy.weight.item() == whole.policy.weight.item()


def test_steps_are_those_of_all_restarts():
    seen = []
    restarts([0.0, 5.0]).run(lambda t, _: seen.append(t.steps), pytest.fail)
    assert seen == [10, 20, 30, 40]


@pytest.mark.parametrize(
    ("starts", "best"), [([0.0, 5.0, 3.0], 1), ([0.0, 3.0, 5.0], 2), ([5.0, 3.0, 0.0], 0)]
)
def test_only_the_best_of_compared_restarts_is_trained_to_its_end(starts, best):
    seen = []
    runs = restarts(starts, until=10)
    rows = runs.run(lambda training, _: seen.append(training.steps), pytest.fail)
    assert runs.scores == [start + 1 for start in starts]
    assert runs.policy.weight.item() == starts[best] + 2
    rounds = [(row["restart"], row["round"], row["kept"]) for row in rows]
    assert rounds == sorted([(n, 0, n == best) for n in range(3)] + [(best, 1, True)])
    assert seen == [10, 20, 30, 40] and runs.planned_steps == 40
