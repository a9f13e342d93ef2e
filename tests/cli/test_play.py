"""Films: of the right length and size, with the true and the learned return drawn."""

from __future__ import annotations

import json

import numpy as np
import pytest
from answers import assert_answered
from PIL import Image, ImageDraw

from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.interventions import parse_setting
from irlcli.report import animation
from irlcli.rl.rollout import roll_out
from irlcli.seeds import derive
from irlcli.stages.base import environment_key
from irlcli.stages.running import frozen_reward
from irlcli.store import Store


def frames_of(path):
    """(frames, width, height) of an MP4, read back."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    frames = [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]
    return frames, about


def test_an_mp4_shows_what_the_gif_shows(irl, smoke_store, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    for name in ("film.gif", "film.mp4"):
        words = ["play", "airl", "--out", tmp_path / name, "--steps", "40", "--ood", "1.5x"]
        done = irl(*words, "--store", smoke_store.path)
        assert done.code == 0, done.err
    frames, about = frames_of(tmp_path / "film.mp4")
    gif = Image.open(tmp_path / "film.gif")
    assert len(frames) == gif.n_frames
    assert about["size"] == gif.size == (3 * 320, 272)
    assert about["duration"] == pytest.approx(gif.n_frames * gif.info["duration"] / 1000, rel=0.05)
    for index in (0, len(frames) - 1):
        gif.seek(index)
        drawn = np.asarray(gif.convert("RGB"), dtype=float)
        # H.264 and 256 colours lose a little.
        assert np.abs(frames[index] - drawn).mean() < 8.0
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".irl")] == []


@pytest.fixture
def lines(monkeypatch):
    """Every line of text that is drawn."""
    drawn = []
    original = ImageDraw.ImageDraw.text

    def spied(draw, xy, text, *more, **style):
        drawn.append(text)
        return original(draw, xy, text, *more, **style)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", spied)
    return drawn


def test_the_returns_drawn_are_those_of_the_episode(irl, smoke_store, tmp_path, lines):
    """At the end both are what `irl evaluate` would measure of this episode."""
    store = Store(smoke_store.path)
    airl = store.resolve("airl").artefact.directory
    policy, _ = load_policy_file(airl / "policy.pt")
    setting = parse_setting("lunar-lander", "engine-power=1x")
    (episode,) = roll_out("lunar-lander", setting, policy, 1, 5, "play", deterministic=True)
    assert episode.terminated
    model, origin = load_reward_file(airl / "reward.pt")
    where = environment_key("lunar-lander")
    learned = frozen_reward(where, str(setting), model, origin).of_episode(episode)
    played = animation.film(
        policy,
        "lunar-lander",
        [setting],
        10_000,
        derive("play", 5, 0)[0],
        [frozen_reward(where, str(setting), model, origin)],
    )
    assert 2 * sum(1 for _ in played.frames) == len(lines)
    assert lines[-2:] == [
        "lunar-lander engine-power=1x",
        f"step {len(episode)}   true return {episode.episode_return:.0f}   "
        f"learned return {learned:.1f}",
    ]


@pytest.mark.parametrize(
    ("policy", "words", "method"),
    [
        ("airl", ["--setting", "engine-power=1.5x,friction=0.5"], "irm"),
        ("moved", [], "irm"),
        ("moved", ["--reward", "airl"], "irm"),
        ("EXPERT", [], None),
        ("EXPERT", ["--reward", "airl"], "irm"),
    ],
)
def test_the_learned_return_is_drawn_if_there_is_a_reward(
    irl, smoke_store, tmp_path, lines, policy, words, method
):
    policy = policy.replace("EXPERT", smoke_store.expert)
    out = ["--out", tmp_path / "a.gif", "--steps", "3", "--json", "--store", smoke_store.path]
    done = irl("play", policy, *words, *out)
    assert done.code == 0, done.err
    assert json.loads(done.out)["reward"] == method
    captions = lines[1::2]
    assert captions and all("true return" in caption for caption in captions)
    assert all(("learned return" in caption) == (method is not None) for caption in captions)


def test_what_cannot_be_drawn_is_named(irl, smoke_store, tmp_path):
    common = ["--store", smoke_store.path]
    (tmp_path / "directory.gif").mkdir()
    for words, code, named in (
        (["airl", "--out", tmp_path / "a.avi"], 2, "a.avi"),
        (["airl", "--out", tmp_path / "directory.gif"], 2, "is a directory"),
        (["airl", "--out", tmp_path / "no" / "a.mp4"], 2, "not a directory"),
        (["airl", "--out", smoke_store.path / "a.gif"], 2, "lies in the store"),
        (["airl", "--out", tmp_path / "a.mp4", "--reward", "nothing"], 3, "nothing"),
        (["airl", "--out", tmp_path / "a.mp4", "--reward", "demos"], 2, "reward.pt"),
    ):
        assert_answered(irl("play", *words, *common), code, named)


def test_without_ffmpeg_the_message_says_what_to_install(irl, smoke_store, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    out = tmp_path / "a.mp4"
    out.write_text("old")
    done = irl("play", "airl", "--out", out, "--steps", "2", "--store", smoke_store.path)
    assert ".[video]" in assert_answered(done, 1, "imageio-ffmpeg") + done.err
    assert out.read_text() == "old"
