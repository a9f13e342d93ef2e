"""Own demonstrations through the real command line: imported, learned from, exported, refused."""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from answers import assert_answered, snapshot

from irlcli.data.demonstrations import read_demonstrations
from irlcli.store import Store

LANDER = ["--env", "lunar-lander", "--intervention", "engine-power=1x,1.25x"]


@pytest.fixture
def exported(irl, store_copy, tmp_path):
    """The smoke store's demonstrations as one Parquet file."""
    path = tmp_path / "demos.parquet"
    done = irl("export", "demos", "demos", "--to", f"parquet:{path}", "--store", store_copy.path)
    assert done.code == 0, done.err
    assert done.out.strip() == str(path)
    return path


def imported(irl, store, *words):
    done = irl("import", *words, "--store", store.path, "--quiet")
    assert done.code == 0, done.err
    return Store(store.path).resolve(done.out.strip().rpartition("/")[2]).artefact


def test_cut_takes_an_episode_without_its_end_and_says_so(irl, store_copy, exported):
    table = pq.read_table(exported)
    ended = np.asarray(table["terminated"]) | np.asarray(table["truncated"])
    without_first_end = np.delete(np.arange(len(table)), np.flatnonzero(ended)[0])
    pq.write_table(table.take(without_first_end), exported)
    line = ["import", exported, *LANDER, "--store", store_copy.path, "--quiet"]
    assert_answered(irl(*line), 2, "neither terminated nor truncated")
    done = irl(*line, "--cut")
    assert done.code == 0 and "1 episode" in done.err


@pytest.mark.parametrize("beyond", [0, 5])
def test_an_end_that_is_cut_off_is_no_termination(irl, tmp_path, beyond):
    """A reacher's episode never terminates; one that runs past the limit is cut there."""
    steps = 150 + beyond
    states = np.zeros((steps, 9), np.float32)
    columns = {"obs": list(states), "next_obs": list(states), "action": [[0.0, 0.0]] * steps}
    ends = [False] * (steps - 1) + [True]
    table = pa.table({**columns, "reward": [0.0] * steps, "terminated": ends})
    pq.write_table(table, tmp_path / "long.parquet")
    line = ["import", tmp_path / "long.parquet", "--env", "reacher"]
    line += ["--intervention", "gravity=0.5x", "--cut", "--store", tmp_path / "runs"]
    done = irl(*line)
    assert done.code == 0, done.err
    assert ("episodes are terminated" in done.err) == (beyond == 0)


def test_sources_and_counts_need_an_order_of_their_settings(irl, tmp_path):
    """The options do not say whether the setting of --setting or of --intervention comes first."""
    both = ["--env", "lunar-lander", "--setting", "default", "--intervention", "engine-power=2x"]
    for file in ("a.parquet", "b.parquet"):
        pq.write_table(pa.table({"reward": [0.0]}), tmp_path / file)
    sources = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    store = ["--store", tmp_path / "runs"]
    assert_answered(irl("import", *sources, *both, *store), 2, "order of the settings")
    line = ["collect-experts", *both, "--episodes", "1,3", *store]
    assert_answered(irl(*line), 2, "order of the settings")


def test_a_dataset_of_minari_names_only_an_environment_that_makes_it(irl, tmp_path, minari):
    """Gymnasium would make the grid of the default size."""
    store = ["--store", tmp_path / "runs", "--profile", "smoke"]
    grid = ["--set", "gridworld.size=6", "--episodes", "1", "--name", "grid"]
    made = irl(
        "collect-experts", "--env", "gridworld", "--intervention", "path-group", *grid, *store
    )
    assert made.code == 0, made.err
    done = irl("export", "demos", "grid", "--to", "minari:me/grid-v0", *store[:2])
    assert done.code == 0, done.err
    assert minari.load_dataset("me/grid-v0").env_spec is None


def test_lineage_names_the_recording_that_was_used(irl, store_copy, exported, tmp_path):
    """Other files may hold the same episodes."""
    used = imported(irl, store_copy, exported, *LANDER)
    common = ["--store", store_copy.path]
    learn = [
        "train-airl",
        "--demos",
        used.id,
        "--method",
        "bc",
        "--profile",
        "smoke",
        "--name",
        "bc",
    ]
    done = irl(*learn, *common)
    assert done.code == 0, done.err
    for compression in ("none", "gzip", "zstd", "snappy"):
        copy = tmp_path / f"{compression}.parquet"
        pq.write_table(pq.read_table(exported), copy, compression=compression)
        imported(irl, store_copy, copy, *LANDER)
    tree = json.loads(irl("lineage", "bc", "--json", *common).out)
    assert [item["from"]["id"] for item in tree["inputs"]] == [used.id]


def test_an_output_path_that_links_to_itself_is_a_file_that_exists(irl, store_copy, tmp_path):
    for name, target in (("loop", "loop"), ("dangling", "nowhere")):
        (tmp_path / name).symlink_to(tmp_path / target)
        words = ["export", "demos", "demos", "--to", f"parquet:{tmp_path / name}"]
        assert_answered(irl(*words, "--store", store_copy.path), 2, f"{name} exists")
        assert (tmp_path / name).is_symlink()


def test_a_terminated_export_leaves_nothing(store_copy, tmp_path):
    """The writer of the file is stopped by the signal that a batch system sends."""
    code = (
        "import os, signal, sys\n"
        "from irlcli.data.exchange import transitions\n"
        "def write(path, *_):\n"
        "    path.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    raise AssertionError('not reached')\n"
        "transitions.write_transitions = write\n"
        "from irlcli.cli.main import main\n"
        "main()\n"
    )
    words = ["export", "demos", "demos", "--to", f"parquet:{tmp_path / 'x' / 'a.parquet'}"]
    (tmp_path / "x").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", code, *words, "--store", store_copy.path], capture_output=True
    )
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    assert list((tmp_path / "x").iterdir()) == []


def assert_equal(one, two):
    assert list(one.trajectories) == list(two.trajectories)
    for text, group in one.trajectories.items():
        for a, b in zip(group, two.trajectories[text], strict=True):
            np.testing.assert_array_equal(a.observations, b.observations)
            np.testing.assert_array_equal(a.actions, b.actions)
            np.testing.assert_array_equal(a.rewards, b.rewards)
            assert (a.terminated, a.truncated, a.seed) == (b.terminated, b.truncated, b.seed)


def test_import_of_an_export_is_the_same_dataset(irl, store_copy, exported):
    artefact = imported(irl, store_copy, exported, *LANDER)
    recorded = Store(store_copy.path).resolve("demos").artefact
    one, two = (read_demonstrations(a.directory) for a in (recorded, artefact))
    assert_equal(one, two)
    returns = [
        [
            row["mean_return"]
            for row in json.loads((a.directory / "summary.json").read_text())["settings"]
        ]
        for a in (recorded, artefact)
    ]
    assert returns[0] == returns[1]


def test_observations_outside_the_environments_bounds_are_counted(
    irl, store_copy, exported, tmp_path
):
    """LunarLander's positions lie within 2.5: in other units they do not."""
    table = pq.read_table(exported)
    observations = np.stack(table["obs"].to_pylist()).astype(np.float32)
    assert (np.abs(observations[:, 0]) < 2.5).all()
    following = np.stack(table["next_obs"].to_pylist()).astype(np.float32)
    observations[:7, 0] = following[:6, 0] = 250.0
    for name, values in (("obs", observations), ("next_obs", following)):
        at = table.schema.get_field_index(name)
        other = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 8)
        table = table.set_column(at, name, other)
    pq.write_table(table, tmp_path / "other.parquet")
    line = [*LANDER, "--store", store_copy.path]
    assert "warning" not in irl("import", exported, *line).err
    done = irl("import", tmp_path / "other.parquet", *line)
    assert done.code == 0
    outside = f"outside the environment's bounds: {{}} in {len(table)} steps"
    assert outside.format(7) in done.err
    # The last one of an episode, where its absorbing state is.
    following[np.flatnonzero(table["terminated"])[0], 0] = 250.0
    at = table.schema.get_field_index("next_obs")
    other = pa.FixedSizeListArray.from_arrays(pa.array(following.ravel()), 8)
    pq.write_table(table.set_column(at, "next_obs", other), tmp_path / "last.parquet")
    assert outside.format(8) in irl("import", tmp_path / "last.parquet", *line).err


def test_an_end_where_no_episode_ends_is_warned_of(irl, tmp_path):
    pytest.importorskip("pybullet")
    columns = {
        "obs": [[0.0] * 17] * 3,
        "next_obs": [[0.0] * 17] * 3,
        "action": [[0.0] * 6] * 3,
        "terminated": [False, False, True],
    }
    pq.write_table(pa.table(columns), tmp_path / "own.parquet")
    where = ["--env", "half-cheetah", "--setting", "default", "--store", tmp_path / "runs"]
    done = irl("import", tmp_path / "own.parquet", *where)
    assert done.code == 0, done.err
    assert "1 of 1 episodes are terminated, but no episode of this environment" in done.err


@pytest.fixture
def minari(tmp_path, monkeypatch):
    """Minari with an empty directory of datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return pytest.importorskip("minari")


def test_a_round_trip_through_minari(irl, store_copy, minari):
    common = ["--store", store_copy.path]
    done = irl("export", "demos", "demos", "--to", "minari:me/lander-v0", *common)
    assert done.code == 0, done.err
    dataset = minari.load_dataset("me/lander-v0")
    recorded = read_demonstrations(Store(store_copy.path).resolve("demos").artefact.directory)
    assert dataset.total_episodes == sum(map(len, recorded.trajectories.values()))
    assert "observations" in repr(dataset[0])
    assert dataset.env_spec.id == "irlcli/LunarLander-v0"
    assert "me" in minari.namespace.list_local_namespaces()
    about = list(dataset.storage.get_episode_metadata(range(dataset.total_episodes)))
    assert [(a["setting"], a["intervention"].tolist()) for a in about[:1]] == [
        ("engine-power=1x", [1.0])
    ]
    artefact = imported(irl, store_copy, "minari:me/lander-v0", *LANDER)
    assert_equal(recorded, read_demonstrations(artefact.directory))
    again = irl("export", "demos", "demos", "--to", "minari:me/lander-v0", *common)
    assert_answered(again, 2, "me/lander-v0")


def test_minari_has_no_place_for_an_unknown_reward(irl, store_copy, exported, minari, tmp_path):
    pq.write_table(pq.read_table(exported).drop_columns(["reward"]), exported)
    imported(irl, store_copy, exported, *LANDER, "--name", "own")
    words = ["export", "demos", "own", "--to", "minari:me/lander-v0", "--store", store_copy.path]
    assert_answered(irl(*words), 2, "the true reward of these demonstrations is unknown")
    assert not list((tmp_path / "minari").rglob("*.hdf5"))


def test_demonstrations_are_described_by_setting(irl, store_copy, exported):
    """Recorded or imported, new or found: the table has the means of the dataset's own episodes."""
    datasets = read_demonstrations(Store(store_copy.path).resolve("demos").artefact.directory)
    common = [*LANDER, "--store", store_copy.path]
    smoke = ["--profile", "smoke"]
    for line in (["import", exported], ["import", exported], ["collect-experts", *smoke]):
        done = irl(*line, *common)
        assert done.code == 0, done.err
        assert len(done.out.splitlines()) == 1
        for setting, episodes in datasets.trajectories.items():
            returns = [episode.rewards.sum() for episode in episodes]
            length = np.mean([len(episode.rewards) for episode in episodes])
            values = (
                f"{np.mean(returns):.1f} {np.std(returns, ddof=1):.1f} {length:.0f} {len(returns)}"
            )
            (row,) = [
                row for row in done.err.splitlines() if row.startswith(f"lunar-lander {setting} ")
            ]
            assert row.split()[2:] == values.split()
        document = json.loads(irl(*line, *common, "--json").out)
        assert [row["setting"] for row in document["demonstrations"]] == list(datasets.trajectories)


def test_an_import_is_a_hit_wherever_the_file_lies(irl, store_copy, exported, tmp_path):
    first = imported(irl, store_copy, exported, *LANDER, "--name", "own")
    moved = exported.rename(tmp_path / "moved.parquet")
    again = irl("import", moved, *LANDER, "--store", store_copy.path, "--dry-run")
    assert again.out.startswith("HIT") and first.id in again.out
    assert "import" in irl("lineage", "own", "--store", store_copy.path).out


def test_a_reward_is_learned_from_demonstrations_without_a_reward(irl, store_copy, exported):
    """And nothing shows a return that nobody measured."""
    table = pq.read_table(exported).drop_columns(["reward"])
    pq.write_table(table, exported)
    common = ["--store", store_copy.path]
    done = irl("import", exported, *LANDER, *common, "--name", "own")
    assert done.code == 0, done.err
    assert "no true reward" in done.err
    rows = [row.split() for row in done.err.splitlines() if row.startswith("lunar-lander ")]
    assert [row[2:4] for row in rows] == [["-", "-"]] * 2
    artefact = Store(store_copy.path).resolve("own").artefact
    summary = json.loads((artefact.directory / "summary.json").read_text())
    assert all(row["mean_return"] is None for row in summary["settings"])
    learn = ["train-airl", "--demos", "own", "--profile", "smoke", "--quiet", *common]
    without = irl(*learn, "--method", "irm")
    assert without.code == 0, without.err
    # The true reward is no input of learning: the reward has the same bytes.
    learned = Store(store_copy.path).resolve(without.out.strip().rpartition("/")[2]).artefact
    known = Store(store_copy.path).resolve("airl").artefact
    for name in ("reward.pt", "policy.pt"):
        assert learned.output(name).sha256 == known.output(name).sha256


def test_a_file_per_setting(irl, store_copy, exported, tmp_path):
    table = pq.read_table(exported)
    names = np.array(table["setting"].to_pylist())
    paths = []
    for number, text in enumerate(("engine-power=1x", "engine-power=1.25x")):
        part = table.filter(pa.array(names == text)).drop_columns(["setting"])
        paths.append(tmp_path / f"{number}.parquet")
        pq.write_table(part, paths[-1])
    both = imported(irl, store_copy, *paths, *LANDER)
    one = imported(irl, store_copy, exported, *LANDER)
    assert both.output("steps.parquet").sha256 == one.output("steps.parquet").sha256


def test_a_source_of_one_setting_names_no_other_one(irl, store_copy, exported, minari, tmp_path):
    """Whether by itself, or one of several in another order than the settings."""
    store = ["--store", store_copy.path, "--quiet"]
    table = pq.read_table(exported)
    names = np.array(table["setting"].to_pylist())
    first = int(np.argmax(names == "engine-power=1.25x"))
    refused = (
        f"row {first}: 'setting' says engine-power=1.25x, but the command names engine-power=1x"
    )
    one = [*LANDER[:3], "engine-power=1x"]
    assert_answered(irl("import", exported, *one, *store), 2, refused)
    # In every type that text has in Arrow.
    for kind in (pa.large_string(), pa.string_view(), pa.dictionary(pa.int32(), pa.string())):
        column = pa.array(names.tolist()).cast(kind)
        typed = table.set_column(table.schema.get_field_index("setting"), "setting", column)
        pq.write_table(typed, tmp_path / "typed.parquet")
        assert_answered(irl("import", tmp_path / "typed.parquet", *one, *store), 2, refused)
    parts = []
    for text in ("1.25x", "1x"):
        parts.append(tmp_path / f"{text}.parquet")
        pq.write_table(table.filter(pa.array(names == f"engine-power={text}")), parts[-1])
    assert_answered(irl("import", *parts, *LANDER, *store), 2, "1.25x.parquet row 0: ")
    imported(irl, store_copy, *reversed(parts), *LANDER)
    assert irl("export", "demos", "demos", "--to", "minari:me/all-v0", *store[:2]).code == 0
    assert_answered(irl("import", "minari:me/all-v0", *one, *store), 2, "says engine-power=1.25x")
    # A value of the knob is enough, as text or as a number.
    other = table.drop_columns(["setting"])
    swapped = []
    for text in ("1x", "1.25x"):
        swapped.append(tmp_path / f"short-{text}.parquet")
        mine = other.filter(pa.array(names == f"engine-power={text}"))
        column = pa.array([text] * len(mine))
        pq.write_table(mine.append_column("setting", column), swapped[-1])
    imported(irl, store_copy, *swapped, *LANDER)
    said = "says 1.25x, but the command names engine-power=1x"
    assert_answered(irl("import", *reversed(swapped), *LANDER, *store), 2, said)
    twice = [swapped[0], swapped[0]]
    assert_answered(irl("import", *twice, *LANDER, *store), 2, "two of the sources are the same")
    foreign = tmp_path / "foreign.parquet"
    for said, usual, named in (("1.25x", "expert", one[-1]), (0.5, 0.1, "bounce=0.1")):
        column = pa.array([said, *[usual] * (len(other) - 1)])
        pq.write_table(other.append_column("setting", column), foreign)
        done = irl("import", foreign, *one[:-1], named, *store)
        assert_answered(done, 2, f"row 0: 'setting' says {said}, but the command names {named}")
    # The column may mean something else.
    pq.write_table(other.append_column("setting", pa.array(["novice"] * len(other))), foreign)
    imported(irl, store_copy, foreign, *one)


def test_bad_input_is_one_line_and_a_hint(irl, store_copy, exported, tmp_path):
    store = store_copy.path
    table = pq.read_table(exported)
    nan = table.set_column(
        table.schema.get_field_index("reward"),
        "reward",
        pa.array([*table["reward"].to_pylist()[:-1], float("nan")]),
    )
    pq.write_table(nan, tmp_path / "nan.parquet")
    (tmp_path / "text.parquet").write_text("no parquet at all")
    (tmp_path / "cut.parquet").write_bytes(exported.read_bytes()[:-4])
    (tmp_path / "empty").mkdir()
    pq.write_table(table.slice(0, 0), tmp_path / "none.parquet")
    other = ["--env", "lunar-lander", "--intervention", "engine-power=1x,1.5x"]
    lone = ["--env", "lunar-lander", "--intervention", "engine-power=1x"]
    robot = ["--env", "half-cheetah", "--intervention", "friction"]
    before = snapshot(store)
    for words, code, named in (
        ([exported, *other], 2, "setting 'engine-power=1.25x' is not one of"),
        ([exported, *robot, "--setting-column", "nothing"], 2, "no column 'nothing'"),
        ([exported, *lone, "--setting-column", "nothing"], 2, "no column 'nothing'"),
        ([exported, *lone, "--setting-column", "setting"], 2, "'engine-power=1.25x' is not one of"),
        (
            [exported, tmp_path / "nan.parquet", *LANDER, "--setting-column", "s"],
            2,
            "is of one setting",
        ),
        ([tmp_path / "nan.parquet", *LANDER], 2, f"row {len(table) - 1}: reward is not finite"),
        ([tmp_path / "text.parquet", *LANDER], 2, "text.parquet is not a Parquet file"),
        ([tmp_path, *LANDER], 2, "holds no trajectories of imitation"),
        ([tmp_path / "cut.parquet", *LANDER], 4, "cut.parquet"),
        ([tmp_path / "none.parquet", *LANDER], 2, "no episode"),
        ([tmp_path / "nowhere.parquet", *LANDER], 3, "nowhere.parquet"),
        ([tmp_path / "empty", *LANDER[:2], "--setting", "default"], 2, "empty"),
        (
            [exported, exported, exported, *LANDER],
            2,
            "the number of sources is 3, that of settings 2",
        ),
        (["minari:me", *LANDER], 2, "'me'"),
        (["minari:m/e-v0", *LANDER], 2, "'m/e-v0'"),
        (["minari:me/nothing-v0", *LANDER], 3, "nothing-v0"),
        ([exported, "minari:me/nothing-v0", *LANDER], 3, "nothing-v0"),
        (
            [exported, "--env", "gridworld", "--intervention", "path-group=1"],
            2,
            "gridworld cannot be imported",
        ),
        ([exported, "--env", "lunar-lander", "--intervention", "wind=1"], 2, "wind"),
        ([exported, "--env", "lunar-lander"], 2, "--intervention"),
    ):
        assert_answered(irl("import", *words, "--store", store, "--quiet"), code, named)
    assert snapshot(store) == before


def test_an_export_never_replaces_a_file(irl, store_copy, exported, tmp_path):
    before = exported.read_bytes()
    inside = Store(store_copy.path).resolve("airl").artefact.directory / "added"
    for words, code, named in (
        (["demos", "demos", "--to", f"parquet:{exported}"], 2, "exists"),
        (["demos", "demos", "--to", f"parquet:{tmp_path}/no/x.parquet"], 2, "not a directory"),
        (["demos", "demos", "--to", f"parquet:{inside}"], 2, "lies in the store"),
        (["reward", "airl", "--to", f"torch-export:{inside}"], 2, "lies in the store"),
        (["demos", "demos", "--to", "csv:x"], 2, "'csv:x'"),
        (["demos", "demos", "--to", "parquet:"], 2, "'parquet:'"),
        (["demos", "demos", "--to", "minari:me"], 2, "'me'"),
        (["demos", "demos", "--to", "minari:../../me-v0"], 2, "'../../me-v0'"),
        (["demo", "demos", "--to", "parquet:x"], 2, "'demo'"),
        (["demos", "airl", "--to", f"parquet:{tmp_path}/x.parquet"], 2, "train-airl"),
        (["demos", "nothing", "--to", f"parquet:{tmp_path}/x.parquet"], 3, "nothing"),
    ):
        assert_answered(irl("export", *words, "--store", store_copy.path), code, named)
    assert exported.read_bytes() == before
    assert [p.name for p in tmp_path.glob("*")] and not list(tmp_path.glob(".irl-export-*"))


def test_a_damaged_dataset_is_not_exported(irl, store_copy, tmp_path):
    path = Store(store_copy.path).resolve("demos").artefact.directory / "steps.parquet"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    words = ["export", "demos", "demos", "--to", f"parquet:{tmp_path / 'x.parquet'}"]
    assert_answered(irl(*words, "--store", store_copy.path), 4, "steps.parquet")
    assert not (tmp_path / "x.parquet").exists()
