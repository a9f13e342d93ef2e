"""Demonstrations that leave and come back: equal, and refused with the row that is wrong."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.exchange.expected import Expected
from irlcli.data.exchange.transitions import read_transitions, write_transitions
from irlcli.data.steps import Check, Irregular, pieces, shifted
from irlcli.data.streaming import read_stream, write_stream
from irlcli.errors import UsageError
from irlcli.interventions import parse_settings
from irlcli.trajectories import ActionSpace, Trajectory

ENV = "lunar-lander"
SETTINGS = parse_settings(ENV, "bounce=0.1,0.5")
TEXTS = tuple(map(str, SETTINGS))
HORIZON = 40
DISCRETE = ActionSpace(True, 4, np.empty(0), np.empty(0))
SEVERAL = ActionSpace(True, 5, np.empty(0), np.empty(0), (3, 2))
CONTINUOUS = ActionSpace(False, 2, -np.ones(2, np.float32), np.ones(2, np.float32))


def episode(rng, length, actions=DISCRETE, ends="terminated", rewards=True, size=3):
    """One random episode as a table of transitions."""
    obs = rng.normal(size=(length + 1, size)).astype(np.float32)
    chosen = (
        rng.integers(actions.choices or 4, size=(length, *actions.shape))
        if actions.discrete
        else rng.normal(size=(length, actions.size)).astype(np.float32)
    )
    last = np.arange(length) == length - 1
    return {
        "obs": list(obs[:-1]),
        "next_obs": list(obs[1:]),
        "action": list(chosen),
        "terminated": list(last & (ends == "terminated")),
        "truncated": list(last & (ends == "truncated")),
        **({"reward": list(rng.normal(size=length))} if rewards else {}),
    }


def table(episodes, names=TEXTS):
    """Episodes as one table, each with its number, a seed and a setting in turn."""
    columns = {name: [] for name in (*episodes[0], "episode", "setting", "seed")}
    for number, rows in enumerate(episodes):
        length = len(rows["obs"])
        for name, values in rows.items():
            columns[name] += values
        columns["episode"] += [number] * length
        columns["setting"] += [names[number % len(names)]] * length
        columns["seed"] += [number * 7] * length
    return pa.table(columns)


def expected(actions=DISCRETE, cut=False, texts=TEXTS, column="setting"):
    return Expected(ENV, texts, column, HORIZON, actions, Irregular(cut))


def imported(directory, path, actions=DISCRETE, cut=False, read=100, write=100, **options):
    """The dataset made of the Parquet file ``path``, and what was cut."""
    wanted = expected(actions, cut, **options)
    check = Check(HORIZON, 3, actions, ENV, wanted.irregular)
    directory.mkdir()
    parts = check(read_transitions(path, wanted, read))
    written = write_stream(directory, ENV, SETTINGS[: len(wanted.settings)], parts, {}, write)
    return read_demonstrations(directory), written, wanted.irregular


def assert_equal(one, other):
    assert list(one.trajectories) == list(other.trajectories)
    for text, group in one.trajectories.items():
        for a, b in zip(group, other.trajectories[text], strict=True):
            for name in ("observations", "actions", "rewards"):
                x, y = getattr(a, name), getattr(b, name)
                np.testing.assert_array_equal(x, y)
                assert x.dtype == y.dtype
            assert (a.terminated, a.truncated, a.seed) == (b.terminated, b.truncated, b.seed)


ENDS = st.sampled_from(["terminated", "truncated"])


@settings(max_examples=40, deadline=None)
@given(
    shapes=st.lists(st.tuples(st.integers(1, HORIZON), ENDS), min_size=2, max_size=8),
    actions=st.sampled_from([DISCRETE, SEVERAL, CONTINUOUS]),
    rewards=st.booleans(),
    sizes=st.lists(st.integers(1, 50), min_size=4, max_size=4),
    seed=st.integers(0, 2**31),
)
def test_import_of_export_is_the_same(tmp_path_factory, shapes, actions, rewards, sizes, seed):
    """However the steps are divided into pieces, and whatever an episode holds."""
    base = tmp_path_factory.mktemp("round")
    rng = np.random.default_rng(seed)
    made = table([episode(rng, n, actions, ends, rewards) for n, ends in shapes])
    pq.write_table(made, base / "source.parquet")
    first, written, _ = imported(base / "first", base / "source.parquet", actions, read=sizes[0])
    assert written["length"].to_pylist() == [n for n, _ in shapes]
    names, steps = read_stream(base / "first", sizes[1])
    write_transitions(base / "out.parquet", ENV, names, steps, sizes[2])
    second, _, _ = imported(base / "second", base / "out.parquet", actions, read=sizes[3])
    assert_equal(first, second)
    for name in ("steps.parquet", "episodes.parquet"):
        assert (base / "first" / name).read_bytes() == (base / "second" / name).read_bytes()
    exported = pq.read_table(base / "out.parquet")
    np.testing.assert_array_equal(
        np.stack(exported["obs"].to_pylist()), np.stack(made["obs"].to_pylist())
    )
    assert exported["seed"].to_pylist() == made["seed"].to_pylist()


def test_what_is_imported_is_what_stood_in_the_file(tmp_path):
    rng = np.random.default_rng(0)
    rows = [episode(rng, 3), episode(rng, 5, ends="truncated")]
    pq.write_table(table(rows, ["0.1", "bounce=0.5"]), tmp_path / "a.parquet")
    demos, _, _ = imported(tmp_path / "a", tmp_path / "a.parquet")
    (one,), (two,) = (demos.trajectories[text] for text in TEXTS)
    np.testing.assert_array_equal(one.observations[:-1], rows[0]["obs"])
    np.testing.assert_array_equal(one.observations[-1], rows[0]["next_obs"][-1])
    np.testing.assert_array_equal(two.actions, rows[1]["action"])
    np.testing.assert_array_equal(two.rewards, rows[1]["reward"])
    assert one.terminated and two.truncated and (one.seed, two.seed) == (0, 7)


def test_without_a_reward_no_return_is_known(tmp_path):
    rng = np.random.default_rng(0)
    made = table([episode(rng, 3, rewards=False), episode(rng, 4, rewards=False)])
    pq.write_table(made, tmp_path / "a.parquet")
    demos, written, _ = imported(tmp_path / "a", tmp_path / "a.parquet")
    assert "return" not in written.column_names
    assert all(np.isnan(t.episode_return) for g in demos.trajectories.values() for t in g)
    assert "reward" not in pq.read_schema(tmp_path / "a" / "steps.parquet").names
    assert "return" not in pq.read_schema(tmp_path / "a" / "episodes.parquet").names


def test_episodes_may_be_told_by_their_ends_alone(tmp_path):
    rng = np.random.default_rng(0)
    made = table([episode(rng, n) for n in (2, 1, 6)], TEXTS[:1])
    pq.write_table(made.drop_columns(["episode", "seed", "setting"]), tmp_path / "a.parquet")
    demos, _, _ = imported(tmp_path / "a", tmp_path / "a.parquet", texts=TEXTS[:1], column=None)
    (group,) = demos.trajectories.values()
    assert [len(t) for t in group] == [2, 1, 6]
    assert {t.seed for t in group} == {-1}


def test_an_episode_of_the_whole_horizon_needs_no_flag(tmp_path):
    rng = np.random.default_rng(0)
    pq.write_table(
        table([episode(rng, HORIZON, ends="open"), episode(rng, 2)]), tmp_path / "a.parquet"
    )
    demos, _, irregular = imported(tmp_path / "a", tmp_path / "a.parquet")
    assert demos.trajectories[TEXTS[0]][0].truncated
    assert (irregular.long, irregular.unended) == (0, 0)


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("which", ["long", "unended"])
def test_episodes_that_are_not_whole_are_refused_or_cut(tmp_path, cut, which):
    rng = np.random.default_rng(0)
    length, ends = (HORIZON + 5, "terminated") if which == "long" else (4, "open")
    pq.write_table(
        table([episode(rng, 2), episode(rng, length, ends=ends), episode(rng, 3)]),
        tmp_path / "a.parquet",
    )
    if not cut:
        row = 2 + HORIZON if which == "long" else 2 + 3
        with pytest.raises(UsageError, match=f"row {row}: ") as caught:
            imported(tmp_path / "a", tmp_path / "a.parquet")
        assert "--cut" in caught.value.hint
        return
    demos, _, irregular = imported(tmp_path / "a", tmp_path / "a.parquet", cut=True)
    (changed,) = demos.trajectories[TEXTS[1]]
    assert len(changed) == min(length, HORIZON) and changed.truncated
    assert (irregular.long, irregular.unended) == ((1, 0) if which == "long" else (0, 1))
    first, last = demos.trajectories[TEXTS[0]]
    assert first.terminated and last.terminated


def changed(column, row, value):
    """A change of one cell."""

    def change(made):
        values = made[column].to_pylist()
        values[row] = value
        place = made.schema.get_field_index(column)
        return made.set_column(place, column, pa.array(values))

    return change


@pytest.mark.parametrize(
    ("change", "row", "message"),
    [
        (changed("obs", 6, [0.0, float("nan"), 0.0]), 6, "obs is not finite"),
        (changed("next_obs", 6, [0.0, float("inf"), 0.0]), 6, "next_obs is not finite"),
        (changed("obs", 0, [1e300, 0.0, 0.0]), 0, "obs is not finite"),
        (changed("reward", 4, float("nan")), 4, "reward is not finite"),
        (changed("reward", 4, -1e39), 4, "reward is not finite"),
        (changed("obs", 5, [0.0, 0.0]), 5, "obs has 2 numbers"),
        (changed("obs", 5, None), 5, "obs is missing"),
        (changed("obs", 5, [0.0, None, 0.0]), 5, "obs is missing"),
        (changed("action", 7, 4), 7, "action is not one of"),
        (changed("action", 7, -1), 7, "action is not one of"),
        (changed("action", 7, 0.5), 0, "action is of real numbers"),
        (changed("action", 7, None), 7, "action is missing"),
        (changed("setting", 4, "0.9"), 4, "setting '0.9' is not one of bounce=0.1, bounce=0.5"),
        (changed("setting", 4, "mass=1x"), 4, "setting 'mass=1x' is not one of"),
        (changed("setting", 4, None), 4, "setting is missing"),
        (changed("setting", 5, "bounce=0.1"), 5, "the setting changes within an episode"),
        (changed("terminated", 4, True), 5, "the episode has steps after its end"),
        (changed("obs", 5, [9.0, 9.0, 9.0]), 5, "obs differs from next_obs"),
        (changed("seed", 5, 9), 5, "the seed changes within an episode"),
        (changed("episode", 8, 0), 8, "episode 0 begins again"),
        (changed("episode", 2, None), 2, "episode is missing"),
        (changed("episode", 2, float("nan")), 2, "episode is not finite"),
        (
            lambda made: made.set_column(
                made.schema.get_field_index("setting"), "setting", pa.array([["0.1"]] * len(made))
            ),
            0,
            "setting is a list",
        ),
        (
            lambda made: made.set_column(
                made.schema.get_field_index("terminated"),
                "terminated",
                pa.array([0.0] * len(made)),
            ),
            0,
            "terminated is not true or false",
        ),
        (lambda made: made.drop_columns(["next_obs"]), None, "no column 'next_obs'"),
        (lambda made: made.drop_columns(["setting"]), None, "no column 'setting'"),
        (
            lambda made: made.set_column(0, "obs", pa.array(["text"] * len(made))),
            0,
            "obs is of type string",
        ),
    ],
)
def test_a_row_that_cannot_be_used_is_named(tmp_path, change, row, message):
    """Also where a part of the file ends before it."""
    rng = np.random.default_rng(0)
    pq.write_table(change(table([episode(rng, n) for n in (4, 4, 4)])), tmp_path / "a.parquet")
    for read in (1, 2, 100):
        with pytest.raises(UsageError) as caught:
            imported(tmp_path / str(read), tmp_path / "a.parquet", read=read)
        assert message in caught.value.message and caught.value.hint
        if row is not None:
            assert f"a.parquet row {row}: " in caught.value.message


def test_an_episode_column_of_lists_is_named(tmp_path):
    made = table([episode(np.random.default_rng(0), 3)], TEXTS[:1])
    made = made.set_column(made.schema.get_field_index("episode"), "episode", pa.array([[0]] * 3))
    pq.write_table(made, tmp_path / "a.parquet")
    with pytest.raises(UsageError, match="row 0: episode is a list"):
        imported(tmp_path / "out", tmp_path / "a.parquet", texts=TEXTS[:1])


def test_numbers_of_episodes_are_of_any_width(tmp_path):
    rng = np.random.default_rng(0)
    made = table([episode(rng, n) for n in (3, 1, 2)], TEXTS[:1])
    at = made.schema.get_field_index("episode")
    for kind in (pa.uint8(), pa.float16(), pa.float64(), pa.string()):
        named = pa.array(np.asarray(made["episode"]).astype(str)).cast(pa.int32()).cast(kind)
        pq.write_table(made.set_column(at, "episode", named), tmp_path / f"{kind}.parquet")
        demos, _, _ = imported(tmp_path / str(kind), tmp_path / f"{kind}.parquet", texts=TEXTS[:1])
        assert [len(t) for t in demos.trajectories[TEXTS[0]]] == [3, 1, 2]


def test_seeds_that_a_dataset_cannot_hold_are_unknown(tmp_path):
    made = table([episode(np.random.default_rng(0), 1) for _ in range(3)], TEXTS[:1])
    seeds = pa.array([5, 2**63 - 1, 2**63], pa.uint64())
    made = made.set_column(made.schema.get_field_index("seed"), "seed", seeds)
    pq.write_table(made, tmp_path / "a.parquet")
    found, _, _ = imported(tmp_path / "out", tmp_path / "a.parquet", texts=TEXTS[:1])
    assert [t.seed for t in found.trajectories[TEXTS[0]]] == [5, 2**63 - 1, -1]


@pytest.mark.parametrize("read", [1, 7, HORIZON])
def test_a_last_batch_of_steps_that_are_cut_leaves_nothing(tmp_path, read):
    made = [episode(np.random.default_rng(0), n) for n in (3, HORIZON + 9)]
    pq.write_table(table(made, TEXTS[:1]), tmp_path / "a.parquet")
    _, written, irregular = imported(
        tmp_path / "out", tmp_path / "a.parquet", cut=True, read=read, write=1, texts=TEXTS[:1]
    )
    assert written["length"].to_pylist() == [3, HORIZON] and irregular.long == 1


def test_other_observations_and_actions_than_the_environments_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    for rows, message in (
        ([episode(rng, 3, size=5)], "obs has 5 numbers, but observations of lunar-lander have 3"),
        ([episode(rng, 3, CONTINUOUS)], "action is of real numbers, 2 numbers"),
    ):
        pq.write_table(table(rows * 2), tmp_path / "a.parquet")
        with pytest.raises(UsageError, match=message):
            imported(tmp_path / f"{len(message)}", tmp_path / "a.parquet")


def test_each_of_several_indices_has_choices_of_its_own(tmp_path):
    rng = np.random.default_rng(0)
    made = episode(rng, 3, SEVERAL)
    for number, (chosen, message) in enumerate(
        (
            ([0, 2], "row 1: action is not one of the 2 whole numbers from 0 to 2, 1"),
            ([-1, 0], "row 1: action is not one of the 2"),
        )
    ):
        wrong = {**made, "action": [made["action"][0], np.array(chosen), made["action"][2]]}
        pq.write_table(table([wrong, made]), tmp_path / "a.parquet")
        with pytest.raises(UsageError, match=message):
            imported(tmp_path / str(number), tmp_path / "a.parquet", SEVERAL)
    pq.write_table(table([episode(rng, 3)] * 2), tmp_path / "a.parquet")
    with pytest.raises(UsageError, match="row 0: action is of whole numbers, 1 number, but"):
        imported(tmp_path / "one", tmp_path / "a.parquet", SEVERAL)


@pytest.mark.parametrize(
    ("space", "start", "chosen", "listed"),
    [
        (DISCRETE, 2, 1, "the whole numbers from 2 to 5"),
        (SEVERAL, np.array([-1, 1]), [-2, 1], "the 2 whole numbers from -1, 1 to 1, 2"),
    ],
)
def test_indices_are_those_of_the_environment(tmp_path, space, start, chosen, listed):
    made = episode(np.random.default_rng(0), 6, space)
    counted = made | {"action": [a + start for a in made["action"]]}
    pq.write_table(table([counted], TEXTS[:1]), tmp_path / "a.parquet")
    wanted = expected(space, texts=TEXTS[:1])
    check = Check(HORIZON, 3, space, ENV, wanted.irregular, start)
    (steps,) = check(read_transitions(tmp_path / "a.parquet", wanted))
    np.testing.assert_array_equal(steps.actions, made["action"])
    (out,) = shifted([steps], start)
    np.testing.assert_array_equal(out.actions, counted["action"])
    counted["action"][3] = chosen
    pq.write_table(table([counted], TEXTS[:1]), tmp_path / "b.parquet")
    with pytest.raises(UsageError, match=f"row 3: action is not one of {listed}"):
        list(
            Check(HORIZON, 3, space, ENV, wanted.irregular, start)(
                read_transitions(tmp_path / "b.parquet", wanted)
            )
        )


def test_whole_numbers_are_continuous_actions_too(tmp_path):
    rng = np.random.default_rng(0)
    rows = [{**episode(rng, 3), "action": [[1, 0], [0, -1], [1, 1]]}] * 2
    pq.write_table(table(rows), tmp_path / "a.parquet")
    demos, _, _ = imported(tmp_path / "a", tmp_path / "a.parquet", CONTINUOUS)
    (one,), _ = demos.trajectories.values()
    assert one.actions.dtype == np.float32 and one.actions.tolist() == rows[0]["action"]


def test_lists_of_any_arrow_type_and_nested_lists_are_vectors(tmp_path):
    rng = np.random.default_rng(0)
    made = table([episode(rng, 3), episode(rng, 2)])
    pq.write_table(made, tmp_path / "a.parquet")
    plain, _, _ = imported(tmp_path / "a", tmp_path / "a.parquet")
    for kind in (
        pa.large_list(pa.float64()),
        pa.list_(pa.float64(), 3),
        pa.list_(pa.list_(pa.float32(), 1)),
        pa.list_view(pa.float32()),
        pa.large_list_view(pa.float64()),
    ):
        other = made
        for name in ("obs", "next_obs"):
            values = made[name].to_pylist()
            if pa.types.is_fixed_size_list(kind.value_type):
                values = [[[x] for x in row] for row in values]
            place = other.schema.get_field_index(name)
            other = other.set_column(place, name, pa.array(values, kind))
        pq.write_table(other, tmp_path / "b.parquet")
        demos, _, _ = imported(tmp_path / str(kind).replace(" ", ""), tmp_path / "b.parquet")
        assert_equal(plain, demos)


def test_parts_are_divided_anew():
    from irlcli.data.steps import Steps

    ones = np.ones(3, bool)
    part = Steps(ones, ones, ones, ones, None, ones, ones, ones, ones, str)
    for size, lengths in ((6, [6, 6, 3]), (4, [4, 4, 4, 3]), (1, [1] * 15), (99, [15])):
        assert [len(p) for p in pieces([part] * 5, size)] == lengths


def test_a_trajectory_knows_all_of_its_rewards_or_none():
    def make(rewards):
        return Trajectory(
            np.zeros((3, 1), np.float32), np.zeros(2, np.int64), rewards, True, False, 0
        )

    assert np.isnan(make(np.full(2, np.nan)).episode_return)
    with pytest.raises(ValueError, match="not finite"):
        make(np.array([np.nan, 1.0]))


@pytest.mark.parametrize("kind", [pa.float16(), pa.float32(), pa.float64()])
def test_a_setting_is_a_number_of_any_width(tmp_path, kind):
    rng = np.random.default_rng(0)
    made = table([episode(rng, 3), episode(rng, 4)], [0.1, 0.5])
    at = made.column_names.index("setting")
    numbers = pa.array(np.asarray(made["setting"]).astype(kind.to_pandas_dtype()))
    pq.write_table(made.set_column(at, "setting", numbers), tmp_path / "a.parquet")
    demos, _, _ = imported(tmp_path / "a", tmp_path / "a.parquet")
    assert [len(group) for group in demos.trajectories.values()] == [1, 1]


def test_a_value_without_its_knob_is_refused_where_there_are_several_knobs():
    two = Expected(
        "ant", ("mass=2x", "leg-length=2x"), "setting", HORIZON, CONTINUOUS, Irregular(False)
    )
    assert two.index("leg-length=2.0x", "row 0") == 1
    with pytest.raises(UsageError, match="'2x' is not one of mass=2x, leg-length=2x"):
        two.index("2x", "row 0")
    one = Expected("ant", ("mass=2x", "mass=3x"), "setting", HORIZON, CONTINUOUS, Irregular(False))
    assert one.index("3x", "row 0") == 1


@pytest.mark.parametrize("order", [("with", "without"), ("without", "with")])
def test_sources_with_and_without_a_reward_do_not_mix(tmp_path, order):
    rng = np.random.default_rng(0)
    parts = []
    for name in order:
        made = table([episode(rng, 3, rewards=name == "with")], TEXTS[:1])
        pq.write_table(made, tmp_path / f"{name}.parquet")
        parts += read_transitions(tmp_path / f"{name}.parquet", expected(), 100)
    with pytest.raises(UsageError, match="some sources have a true reward"):
        list(pieces(parts, 100))
