"""Rows of true returns are samples over seeds, and no seed counts twice."""

import msgspec
import pytest

from irlcli.data.descriptions import Evaluation, Returns, RewardOrigin, Subject
from irlcli.errors import UsageError
from irlcli.report.returns import rows


def evaluation(agent, mean, seed=None, made=None, episodes=20, progress=None, stopped=0, **subject):
    place = Returns(
        setting="bounce=0.9",
        episodes=episodes,
        stopped=stopped,
        mean_return=mean,
        mean_progress=progress,
    )
    summary = Evaluation(
        policy=Subject(agent=agent, env="lunar-lander", seed=seed, **subject), settings=(place,)
    )
    return summary, made or {}, False


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
    assert [row.agent for row in found] == ["expert", "AIRL-IRM retrained policy", "random"]
    assert found[1].mean == 4.0
    assert found[1].deviation == pytest.approx(13.0**0.5)
    assert found[0].deviation is None


def test_episodes_that_an_error_stopped_are_added_up():
    (row,) = rows([evaluation("expert", 0.0, k, stopped=n) for k, n in enumerate((2, 0, 5))])
    assert row.stopped == (7, 60)


def test_a_policy_under_several_rewards_acted_once():
    under = [
        msgspec.structs.replace(
            evaluation("expert", 0.0, 0, stopped=2)[0],
            reward=RewardOrigin(settings=("bounce=0.1",), seed=k, method="erm"),
        )
        for k in range(3)
    ]
    (row,) = rows([(summary, {}, False) for summary in under])
    assert row.stopped == (2, 20)


def test_a_row_has_the_fewest_episodes_of_its_seeds():
    (row,) = rows([evaluation("expert", 0.0, k, episodes=n) for k, n in enumerate((20, 5))])
    assert row.episodes == 5


@pytest.mark.parametrize(("measured", "mean"), [((3.0, None), None), ((3.0, 5.0), 4.0)])
def test_progress_is_a_mean_over_all_seeds_or_unknown(measured, mean):
    (row,) = rows([evaluation("expert", 0.0, k, progress=x) for k, x in enumerate(measured)])
    assert row.progress == mean


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


def test_a_student_is_zero_shot_only_without_demonstrations_of_the_setting():
    shown = {
        "bounce=0.9": "AIRL-IRM student, in distribution",
        "bounce=0.1": "AIRL-IRM student, zero-shot",
    }
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
    found = {row.setting: row.agent for row in rows([(turned, {}, False)])}
    assert [found[f"direction={v}"].split(", ")[1] for v in ("-5", "-10..0")] == [
        "in distribution"
    ] * 2
    assert [found[f"direction={v}"].split(", ")[1] for v in ("-10..10", "10")] == ["zero-shot"] * 2


def test_returns_under_another_reward_are_a_row_of_their_own():
    def by_reward(agent, learned, seed, own=False, **subject):
        summary, made, _ = evaluation(agent, 5.0, subject.pop("policy_seed", 0), **subject)
        (place,) = summary.settings
        summary = msgspec.structs.replace(
            summary,
            reward=RewardOrigin(method="irm", seed=seed, settings=("bounce=0.1",)),
            settings=(msgspec.structs.replace(place, mean_learned_return=learned),),
        )
        return summary, made, own

    irm = {"method": "irm"}
    found = rows(
        [
            *(by_reward("expert", learned, seed) for seed, learned in ((0, -2.0), (1, -4.0))),
            by_reward("transfer", 7.0, 1, own=True, reward_seed=1, **irm),
            # The same method, settings and seed, but another reward: another lambda, say.
            by_reward("transfer", 9.0, 1, reward_seed=1, **irm),
            by_reward("transfer", 8.0, 1, reward_seed=2, **irm),
            by_reward("student", 6.0, 0, own=True, settings=("bounce=0.1",), **irm),
            evaluation("idle", 1.0),
        ]
    )
    other = "under AIRL-IRM's reward"
    assert {row.agent: (row.learned, len(row.returns), row.deviation) for row in found} == {
        # One expert under two rewards is no sample of true returns.
        f"expert {other}": (-3.0, 1, None),
        "AIRL-IRM student, zero-shot": (6.0, 1, None),
        "AIRL-IRM retrained policy": (7.0, 1, None),
        f"AIRL-IRM retrained policy {other}": (8.5, 2, 0.0),
        "idle": (None, 1, None),
    }
    twice = [by_reward("expert", 1.0, 4) for _ in range(2)]
    with pytest.raises(
        UsageError, match=r"reward in bounce=0\.9 have seed 0 under the reward of seed 4"
    ):
        rows(twice)


def test_policies_under_several_rewards_count_once_each():
    summaries = []
    for policy, mean in ((0, 0.0), (1, 10.0)):
        for reward in range(3):
            summary, made, own = evaluation("expert", mean, policy)
            origin = RewardOrigin(method="irm", seed=reward, settings=("bounce=0.1",))
            summaries.append((msgspec.structs.replace(summary, reward=origin), made, own))
    (row,) = rows(summaries)
    assert row.returns == (0.0, 10.0)
    assert row.deviation == pytest.approx(50.0**0.5)


def test_a_repeated_seed_is_refused():
    twice = [evaluation("student", x, 3, method="erm") for x in (1.0, 2.0)]
    with pytest.raises(
        UsageError, match=r"two runs of AIRL-ERM student, zero-shot in bounce=0\.9 have seed 3"
    ):
        rows(twice)


def test_runs_that_differ_in_a_parameter_are_rows_that_name_it():
    weight = "train-airl.airl.penalty_weight"
    runs = [
        evaluation("student", mean, seed, {weight: w, "evaluate.env": "x"}, method="irm")
        for mean, seed, w in ((1.0, 0, 1.0), (3.0, 1, 1.0), (8.0, 0, 100.0))
    ]
    alone = "AIRL-IRM student, zero-shot"
    assert [(row.agent, row.returns) for row in rows(runs)] == [
        (f"{alone}, airl.penalty_weight 1", (1.0, 3.0)),
        (f"{alone}, airl.penalty_weight 100", (8.0,)),
    ]
    assert [row.agent for row in rows(runs[:2])] == [alone]


def test_a_parameter_that_some_runs_do_not_have_tells_them_apart():
    runs = [
        evaluation("student", 1.0, 0, made, method="irm")
        for made in ({"train-airl.demonstrations": "0" * 64}, {})
    ]
    found = [row.agent.partition("zero-shot")[2] for row in rows(runs)]
    assert found == [
        ", train-airl.demonstrations 000000000000",
        ", train-airl.demonstrations unset",
    ]


def test_runs_that_share_too_little_are_refused():
    made = [{f"train-airl.airl.field_{i}": value for i in range(4)} for value in (1, 2)]
    students = [evaluation("student", 1.0, k, m, method="irm") for k, m in enumerate(made)]
    with pytest.raises(UsageError, match=r"differ in 4 parameters: train-airl\.airl\.field_0, "):
        rows(students)


def test_an_agent_without_a_seed_is_one_agent():
    twice = [evaluation("random", x, None) for x in (1.0, 2.0)]
    with pytest.raises(UsageError, match=r"random in bounce=0\.9 appears twice"):
        rows(twice)
