"""Rows of true returns: the sample is the seed, and no seed counts twice."""

import msgspec
import pytest

from irlcli.descriptions import Evaluation, LearnedReward, Returns, Subject
from irlcli.errors import UsageError
from irlcli.report.returns import rows


def evaluation(agent, mean, seed=None, made=None, **subject):
    summary = Evaluation(
        policy=Subject(agent=agent, env="lunar-lander", seed=seed, **subject),
        settings=(Returns(setting="bounce=0.9", episodes=20, mean_return=mean),),
    )
    return summary, made or {}


def test_statistics_are_over_seeds():
    found = rows(
        [
            evaluation("random", -200.0),
            *(
                evaluation("transfer", mean, 0, method="irm", reward_seed=seed)
                for seed, mean in enumerate((1.0, 3.0, 8.0))
            ),
            evaluation("expert", 250.0, 0),
        ]
    )
    assert [row.agent for row in found] == ["expert", "airl-irm transfer", "random"]
    assert found[1].mean == 4.0
    assert found[1].deviation == pytest.approx(13.0**0.5)
    assert found[0].deviation is None


def test_experts_of_other_settings_are_rows_of_their_own():
    near, far, own = ("bounce=0.5", "bounce=0.1", "bounce=0.9")
    found = rows(
        [evaluation("expert", m, 0, settings=(s,)) for m, s in ((1, near), (2, far), (3, own))]
    )
    assert [(row.agent, row.mean) for row in found] == [
        ("expert", 3),
        ("expert of bounce=0.1", 2),
        ("expert of bounce=0.5", 1),
    ]


def test_a_student_is_zero_shot_only_where_no_one_showed_it_anything():
    shown = {"bounce=0.9": "airl-irm in distribution", "bounce=0.1": "airl-irm zero-shot"}
    for setting, agent in shown.items():
        (row,) = rows([evaluation("student", 1.0, 0, method="irm", settings=(setting,))])
        assert row.agent == agent
    turned = evaluation("student", 1.0, 0, method="irm", settings=("direction=-10..0",))[0]
    turned = msgspec.structs.replace(
        turned,
        policy=msgspec.structs.replace(turned.policy, env="ant"),
        settings=tuple(
            msgspec.structs.replace(turned.settings[0], setting=f"direction={value}")
            for value in ("-5", "-10..0", "-10..10", "10")
        ),
    )
    found = {row.setting: row.agent for row in rows([(turned, {})])}
    assert [found[f"direction={v}"].split()[1] for v in ("-5", "-10..0")] == ["in", "in"]
    assert [found[f"direction={v}"].split()[1] for v in ("-10..10", "10")] == ["zero-shot"] * 2


def test_what_another_reward_pays_is_a_row_of_its_own():
    trained_in = ("bounce=0.1",)

    def by_reward(agent, seed, learned, **subject):
        summary, made = evaluation(agent, 5.0, 0, **subject)
        (place,) = summary.settings
        return msgspec.structs.replace(
            summary,
            reward=LearnedReward(method="irm", seed=seed, settings=trained_in),
            settings=(msgspec.structs.replace(place, mean_learned_return=learned),),
        ), made

    own = {"method": "irm", "reward_settings": trained_in}
    found = rows(
        [
            *(by_reward("expert", seed, learned) for seed, learned in ((0, -2.0), (1, -4.0))),
            by_reward("transfer", 1, 7.0, reward_seed=1, **own),
            by_reward("transfer", 2, 9.0, reward_seed=1, **own),
            by_reward(
                "transfer", 3, 8.0, reward_seed=3, method="irm", reward_settings=("bounce=0",)
            ),
            by_reward("student", 0, 6.0, method="irm", settings=trained_in),
            evaluation("idle", 1.0),
        ]
    )
    other = "on airl-irm's reward"
    assert {row.agent: (row.learned, len(row.returns)) for row in found} == {
        f"expert {other}": (-3.0, 2),
        "airl-irm zero-shot": (6.0, 1),
        "airl-irm transfer": (7.0, 1),
        f"airl-irm transfer {other}": (8.5, 2),
        "idle": (None, 1),
    }


def test_a_seed_that_comes_twice_is_refused():
    twice = [evaluation("student", x, 3, method="erm") for x in (1.0, 2.0)]
    with pytest.raises(UsageError, match=r"airl-erm zero-shot in bounce=0\.9 has seed 3 twice"):
        rows(twice)


def test_seeds_that_differ_in_more_than_the_seed_are_refused():
    made = [{"train-airl.airl.penalty_weight": weight, "evaluate.env": "x"} for weight in (1, 100)]
    students = [evaluation("student", 1.0, k, m, method="irm") for k, m in enumerate(made)]
    with pytest.raises(UsageError, match=r"differ in train-airl\.airl\.penalty_weight: 1 and 100"):
        rows(students)
    assert len(rows(students[:1])) == 1
