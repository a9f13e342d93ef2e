"""Datasets of Minari and of imitation: read as recorded, refused with the episode that is wrong."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from gymnasium import spaces

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.exchange.expected import Expected
from irlcli.data.exchange.imitation import read_imitation
from irlcli.data.exchange.minari import read_minari
from irlcli.data.steps import Check, Irregular
from irlcli.data.streaming import write_stream
from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import parse_settings
from irlcli.trajectories import ActionSpace

ENV, HORIZON = "lunar-lander", 40
SETTINGS = parse_settings(ENV, "bounce=0.1,0.5")
ACTIONS = ActionSpace(True, 4, np.empty(0), np.empty(0))


def imported(read, source, directory, settings=SETTINGS[:1], cut=False, column=None, size=None):
    """The trajectories by setting that ``read`` finds in ``source``."""
    irregular = Irregular(cut)
    texts = tuple(map(str, settings))
    expected = Expected(ENV, texts, column, HORIZON, ACTIONS, irregular)
    check = Check(HORIZON, 3, ACTIONS, ENV, irregular)
    directory.mkdir(exist_ok=True)
    more = () if size is None else (size,)
    write_stream(directory, ENV, settings, check(read(source, expected, *more)), {})
    return read_demonstrations(directory).trajectories


def episode(rng, length):
    return {
        "obs": rng.normal(size=(length + 1, 3)).astype(np.float32),
        "acts": rng.integers(4, size=length),
        "rews": rng.normal(size=length),
        "terminal": True,
    }


# imitation: a Hugging Face dataset on disk


def save_imitation(directory, episodes, per_batch=2):
    """As ``datasets.Dataset.save_to_disk`` does; see :data:`MADE_BY_IMITATION`."""
    directory.mkdir()
    columns = {name: [e[name] for e in episodes] for name in episodes[0]}
    for name in ("obs", "acts", "rews"):
        if name in columns:
            columns[name] = [np.asarray(v).tolist() for v in columns[name]]
    columns["infos"] = [["{}"] * len(e["acts"]) for e in episodes]
    table = pa.table(columns)
    with pa.ipc.new_stream(directory / "data-00000-of-00001.arrow", table.schema) as stream:
        stream.write_table(table, max_chunksize=per_batch)
    files = [{"filename": "data-00000-of-00001.arrow"}]
    (directory / "state.json").write_text(json.dumps({"_data_files": files}))


@pytest.mark.parametrize("size", [1, 6, 1000])
def test_trajectories_of_imitation(tmp_path, size):
    rng = np.random.default_rng(0)
    made = [episode(rng, n) for n in (5, 3, HORIZON, 1)]
    save_imitation(tmp_path / "trajectories", made)
    found = imported(read_imitation, tmp_path / "trajectories", tmp_path / "out", size=size)
    (group,) = found.values()
    assert [len(t) for t in group] == [5, 3, HORIZON, 1]
    for a, b in zip(made, group, strict=True):
        np.testing.assert_array_equal(a["obs"], b.observations)
        np.testing.assert_array_equal(a["acts"], b.actions)
        np.testing.assert_array_equal(a["rews"], b.rewards)
    # terminal says nothing about the reason: at the time limit it was the time limit.
    assert [t.truncated for t in group] == [False, False, True, False]


def test_trajectories_that_imitation_itself_saved(tmp_path):
    """Saved by imitation 1.0.1 and datasets 5.2.0: 5, 3 and 7 steps of 3 numbers."""
    source = Path(__file__).parent / "imitation"
    (group,) = imported(read_imitation, source, tmp_path / "out").values()
    assert [len(t) for t in group] == [5, 3, 7]
    # Written by numpy.random.default_rng(0), the observations first.
    first = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    np.testing.assert_array_equal(group[0].observations, first)


@pytest.mark.parametrize("cut", [False, True])
def test_irregular_trajectories_of_imitation(tmp_path, cut):
    rng = np.random.default_rng(0)
    made = [episode(rng, 2), episode(rng, 0), episode(rng, HORIZON + 3), episode(rng, 4)]
    made[3]["terminal"] = False
    for kept, message in (
        ([0, 1], "episode 1 has no steps"),
        ([0, 2], f"episode 1, step {HORIZON}: the episode has more than {HORIZON} steps"),
        ([0, 3], "episode 1, step 3: the episode stops here"),
    ):
        source = tmp_path / str(kept[1])
        save_imitation(source, [made[k] for k in kept])
        if not cut:
            with pytest.raises(UsageError, match=message):
                imported(read_imitation, source, tmp_path / "out")
            continue
        (group,) = imported(read_imitation, source, tmp_path / "out", cut=True).values()
        expected = [2, min(len(made[kept[1]]["acts"]), HORIZON)]
        assert [len(t) for t in group] == [n for n in expected if n]


def test_without_rewards_imitations_returns_are_unknown(tmp_path):
    rng = np.random.default_rng(0)
    made = [{k: v for k, v in episode(rng, 3).items() if k != "rews"}]
    save_imitation(tmp_path / "a", made)
    ((only,),) = imported(read_imitation, tmp_path / "a", tmp_path / "out").values()
    assert np.isnan(only.episode_return)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"acts": [0, 1]}, "has 2 actions, 4 observations and 3 rewards"),
        ({"obs": [[0.0] * 3] * 3}, "has 3 actions, 3 observations and 3 rewards"),
        ({"obs": [[0.0] * 3, [0.0] * 2, [0.0] * 3, [0.0] * 3]}, "observation 1: obs has 2 numbers"),
        ({"obs": [[0.0] * 3, [None] * 3, [0.0] * 3, [0.0] * 3]}, "observation 1: obs is missing"),
        ({"acts": [0, 9, 0]}, "step 1: action is not one of"),
        ({"rews": [0.0, float("nan"), 0.0]}, "step 1: reward is not finite"),
    ],
)
def test_an_episode_of_imitation_that_cannot_be_used_is_named(tmp_path, change, message):
    rng = np.random.default_rng(0)
    made = [episode(rng, 3), episode(rng, 3)]
    made[1] |= change
    if "obs" in change:
        made[1]["obs"] = np.array(change["obs"], dtype=object)
    save_imitation(tmp_path / "a", made)
    with pytest.raises(UsageError) as caught:
        imported(read_imitation, tmp_path / "a", tmp_path / "out")
    assert "episode 1" in caught.value.message and message in caught.value.message


@pytest.mark.parametrize(
    ("terminal", "message"),
    [
        ([True, None], "episode 1: terminal is missing"),
        ([[True], [True]], "terminal is not true or false"),
        ([1.0, 0.0], "terminal is not true or false"),
    ],
)
def test_what_is_no_end_of_an_episode_is_named(tmp_path, terminal, message):
    rng = np.random.default_rng(0)
    made = [
        episode(rng, 3) | {"terminal": terminal[0]},
        episode(rng, 0) | {"terminal": terminal[1]},
    ]
    save_imitation(tmp_path / "a", made)
    with pytest.raises(UsageError, match=message):
        imported(read_imitation, tmp_path / "a", tmp_path / "out", cut=True)


@pytest.mark.parametrize(
    "damage", ["truncated", "text", "outside", "none", "stateless", "selected"]
)
def test_a_damaged_directory_of_imitation_is_refused(tmp_path, damage):
    rng = np.random.default_rng(0)
    source = tmp_path / "a"
    save_imitation(source, [episode(rng, 30) for _ in range(9)])
    data, state = source / "data-00000-of-00001.arrow", source / "state.json"
    match damage:
        case "truncated":
            data.write_bytes(data.read_bytes()[:900])
        case "text":
            data.write_text("no arrow at all")
        case "outside":
            state.write_text(json.dumps({"_data_files": [{"filename": "../x.arrow"}]}))
        case "none":
            state.write_text(json.dumps({"_data_files": []}))
        case "stateless":
            state.unlink()
        case "selected":
            # As datasets saves what select() and shuffle() return.
            (source / "indices-00000-of-00001.arrow").touch()
    with pytest.raises(IntegrityError):
        imported(read_imitation, source, tmp_path / "out")


# Minari


def save_minari(directory, episodes, metadata=(), data_format="hdf5", observations=None):
    """A dataset made by Minari's own storage."""
    pytest.importorskip("minari")
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    box = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    storage = MinariStorage.new(
        directory, observations or box, spaces.Discrete(4), data_format=data_format
    )
    for number, rows in enumerate(episodes):
        ends = np.arange(len(rows["acts"])) == len(rows["acts"]) - 1
        storage.update_episodes(
            [
                EpisodeBuffer(
                    id=number,
                    seed=number * 7,
                    observations=rows["obs"],
                    actions=rows["acts"],
                    rewards=rows["rews"],
                    terminations=ends & rows["terminal"],
                    truncations=ends & (not rows["terminal"]),
                )
            ]
        )
    storage.update_episode_metadata(metadata, range(len(metadata)))


@pytest.mark.parametrize(("data_format", "size"), [("hdf5", 1), ("hdf5", 1000), ("arrow", 6)])
def test_a_dataset_of_minari(tmp_path, data_format, size):
    rng = np.random.default_rng(0)
    made = [episode(rng, n) for n in (5, 3, 2)]
    made[1]["terminal"] = False
    names = [{"place": text} for text in ("0.1", "bounce=0.5", "bounce=0.1")]
    save_minari(tmp_path / "data", made, names, data_format)
    data, out = tmp_path / "data", tmp_path / "out"
    found = imported(read_minari, data, out, settings=SETTINGS, column="place", size=size)
    assert list(found) == ["bounce=0.1", "bounce=0.5"]
    group = [found["bounce=0.1"][0], found["bounce=0.5"][0], found["bounce=0.1"][1]]
    for number, (a, b) in enumerate(zip(made, group, strict=True)):
        np.testing.assert_array_equal(a["obs"], b.observations)
        np.testing.assert_array_equal(a["acts"], b.actions)
        np.testing.assert_array_equal(a["rews"], b.rewards)
        assert (b.terminated, b.seed) == (a["terminal"], number * 7)


def test_what_minari_holds_and_irl_cannot_use_is_named(tmp_path):
    rng = np.random.default_rng(0)
    made = [episode(rng, 3), episode(rng, 3)]
    save_minari(tmp_path / "a", made, [{"place": "0.1"}, {"place": "0.9"}])
    for column, message in (
        ("place", "episode 1: setting '0.9' is not one of"),
        ("setting", "episode 0 has no 'setting'; it has: id, place, seed, total_steps"),
    ):
        with pytest.raises(UsageError) as caught:
            imported(
                read_minari, tmp_path / "a", tmp_path / "out", settings=SETTINGS, column=column
            )
        assert message in caught.value.message
    nested = spaces.Dict(x=spaces.Box(-np.inf, np.inf, (3,), np.float32))
    save_minari(tmp_path / "b", [], observations=nested)
    with pytest.raises(UsageError, match="observation space is a Dict"):
        imported(read_minari, tmp_path / "b", tmp_path / "out")


def test_a_dataset_of_images_is_refused(tmp_path):
    """Minari reads images by another way, which does not check where the other numbers are."""
    images = spaces.Box(0, 255, (32, 32), np.uint8)
    save_minari(tmp_path / "a", [], observations=images)
    metadata = tmp_path / "a" / "metadata.json"
    metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {"jpeg_encoding": False}))
    with pytest.raises(UsageError, match="images"):
        imported(read_minari, tmp_path / "a", tmp_path / "out")


@pytest.mark.parametrize("form", ["soft link", "external link", "external data", "virtual"])
def test_numbers_outside_a_datasets_file_are_refused(tmp_path, form):
    """The key of an import covers the file itself."""
    import h5py

    for name in ("a", "b"):
        save_minari(tmp_path / name, [episode(np.random.default_rng(0), 3) for _ in range(2)])
    imported(read_minari, tmp_path / "a", tmp_path / "out")
    other = tmp_path / "b" / "main_data.hdf5"
    (tmp_path / "numbers.bin").write_bytes(np.ones(3).tobytes())
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        if form == "external link":
            del file["episode_1"]
            file["episode_1"] = h5py.ExternalLink(other, "episode_1")
        else:
            del file["episode_1"]["rewards"]
        if form == "soft link":
            file["episode_1"]["rewards"] = h5py.SoftLink("/episode_0/rewards")
        elif form == "external data":
            outside = [(tmp_path / "numbers.bin", 0, h5py.h5f.UNLIMITED)]
            file["episode_1"].create_dataset("rewards", (3,), float, external=outside)
        elif form == "virtual":
            virtual = h5py.VirtualLayout((3,), float)
            virtual[:] = h5py.VirtualSource(other, "episode_1/rewards", (3,))
            file["episode_1"].create_virtual_dataset("rewards", virtual)
    with pytest.raises(IntegrityError, match=r"another file|is a link"):
        imported(read_minari, tmp_path / "a", tmp_path / "out2")


def test_an_episode_of_another_form_is_named(tmp_path):
    import h5py

    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 3) for _ in range(4)])
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        del file["episode_2"]["observations"]
        file["episode_2"]["observations"] = np.zeros((4, 5), np.float32)
    with pytest.raises(UsageError, match="episode 2, step 0: obs has 5 numbers"):
        imported(read_minari, tmp_path / "a", tmp_path / "out")
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        del file["episode_2"]["observations"]
        file["episode_2"]["observations"] = [b"text"] * 4
    with pytest.raises(IntegrityError, match="not rows of numbers"):
        imported(read_minari, tmp_path / "a", tmp_path / "again")


@pytest.mark.parametrize(
    ("seed", "kept"),
    [
        (np.uint64(7), 7),
        (np.uint64(2**63 + 5), -1),
        (-3, -1),
        ("None", -1),
        (np.nan, -1),
        ([1, 2], -1),
    ],
)
def test_a_seed_that_a_dataset_cannot_hold_is_unknown(tmp_path, seed, kept):
    import h5py

    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 3)])
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        file["episode_0"].attrs["seed"] = seed
    ((only,),) = imported(read_minari, tmp_path / "a", tmp_path / "out").values()
    assert only.seed == kept


def test_a_setting_that_is_no_text_is_refused(tmp_path):
    import h5py

    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 3)])
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        file["episode_0"].attrs["setting"] = np.bytes_(b"\xff\xfe")
    with pytest.raises(IntegrityError, match="utf-8"):
        imported(read_minari, tmp_path / "a", tmp_path / "out")


@pytest.mark.parametrize("name", ["rewards", "terminations", "truncations"])
def test_several_numbers_in_a_step_are_refused(tmp_path, name):
    import h5py

    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 3)])
    with h5py.File(tmp_path / "a" / "main_data.hdf5", "a") as file:
        del file["episode_0"][name]
        file["episode_0"][name] = np.zeros((3, 1))
    with pytest.raises(UsageError, match=f"episode 0: {name} are of shape"):
        imported(read_minari, tmp_path / "a", tmp_path / "out")


def test_no_environment_is_made_to_find_the_spaces(tmp_path):
    """Metadata without spaces would make Minari import the module that they name."""
    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 3)])
    path = tmp_path / "a" / "metadata.json"
    metadata = json.loads(path.read_text())
    marker = tmp_path / "marker.py"
    del metadata["observation_space"]
    metadata["env_spec"] = json.dumps({"id": "x-v0", "entry_point": "marker:run"})
    path.write_text(json.dumps(metadata))
    marker.write_text("raise SystemExit('it ran')")
    with pytest.raises(IntegrityError, match="describe no spaces"):
        imported(read_minari, tmp_path / "a", tmp_path / "out")


@pytest.mark.parametrize("damage", ["truncated", "text", "metadata", "missing", "count"])
def test_a_damaged_dataset_of_minari_is_refused(tmp_path, damage):
    save_minari(tmp_path / "a", [episode(np.random.default_rng(0), 30) for _ in range(5)])
    data, metadata = tmp_path / "a" / "main_data.hdf5", tmp_path / "a" / "metadata.json"
    match damage:
        case "truncated":
            data.write_bytes(data.read_bytes()[:3000])
        case "text":
            data.write_text("no hdf5 at all")
        case "metadata":
            metadata.write_text("{")
        case "missing":
            data.unlink()
        case "count":
            found = json.loads(metadata.read_text())
            del found["total_episodes"]
            metadata.write_text(json.dumps(found))
    with pytest.raises(IntegrityError):
        imported(read_minari, tmp_path / "a", tmp_path / "out")
