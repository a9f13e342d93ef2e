"""Films of a policy acting in several settings side by side, as GIF or MP4."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageOps

from irlcli.envs import registration as envs
from irlcli.envs.registry import environment
from irlcli.errors import StageFailed, UsageError
from irlcli.interventions import Setting
from irlcli.rl.policy import Policy, require_observations
from irlcli.trajectories import Trajectory

if TYPE_CHECKING:
    from irlcli.learners.frozen import FrozenReward

PANEL = (320, 240)
# Two lines. With them a frame is a multiple of 16 pixels high, as video codecs want it.
_CAPTION = 32
_FRAMES_PER_SECOND = 20


class Film(NamedTuple):
    """What is drawn: frames of ``size`` (width, height) pixels, each shown ``seconds`` long."""

    frames: Iterator[Image.Image]
    size: tuple[int, int]
    seconds: float


def film(
    policy: Policy,
    env: str,
    settings: Sequence[Setting],
    steps: int,
    seed: int,
    rewards: Sequence[FrozenReward] | None,
) -> Film:
    """One episode of ``policy`` in each setting, all from ``seed``, in real time.

    Actions are the most likely ones. When an episode ends, its panel keeps the last frame. The true
    return so far is drawn, and with ``rewards`` the learned one too: a sum over the steps so far,
    and after an episode's end the learned return of the whole episode, absorbing state included.

    Args:
        policy: who acts.
        env: name of the environment.
        settings: a panel each, left to right.
        steps: at most this many steps per episode; at most the time limit.
        seed: of the episodes' starts.
        rewards: the learned reward in each setting.

    Raises:
        UsageError: a setting's observations differ from those the policy was trained on, or the
            environment draws no pictures.
    """
    # pygame, which draws many environments, would look for a display and complain.
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with ExitStack() as stack:
        with warnings.catch_warnings():
            # Gymnasium's, of an environment without pictures; the error below says it.
            warnings.filterwarnings("ignore", ".*render_mode")
            worlds = [
                stack.enter_context(closing(envs.make(env, setting, render_mode="rgb_array")))
                for setting in settings
            ]
        for world, setting in zip(worlds, settings, strict=True):
            require_observations(policy, world.observation_space, f"{env} {setting}")
        if "rgb_array" not in worlds[0].metadata.get("render_modes", ()):
            raise UsageError(
                f"{env} draws no pictures",
                'irl play needs an environment whose metadata lists the render mode "rgb_array"',
            )
        rate = worlds[0].metadata.get("render_fps", _FRAMES_PER_SECOND)
        stride = max(1, round(rate / _FRAMES_PER_SECOND))
        limit = min(steps, environment(env).max_episode_steps)
        scores = [None] * len(worlds) if rewards is None else rewards
        panels = [
            _panels(world, policy, f"{env} {setting}", limit, stride, seed, score)
            for world, setting, score in zip(worlds, settings, scores, strict=True)
        ]
        # The worlds stay open until the last frame is drawn.
        frames = _frames(panels, stack.pop_all())
    size = PANEL[0] * len(settings), PANEL[1] + _CAPTION
    return Film(frames, size, stride / rate)


def write_gif(path: Path, played: Film) -> None:
    """Write ``played`` as an endless GIF.

    Raises:
        OSError: ``path`` cannot be written.
    """
    frames = list(played.frames)
    # GIF durations have a resolution of 10 ms.
    duration = round(100 * played.seconds) * 10
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0
    )


def write_mp4(path: Path, played: Film) -> None:
    """Write ``played`` as H.264 video; frames are encoded as they are drawn.

    Raises:
        StageFailed: imageio-ffmpeg is not installed.
        OSError: ``path`` cannot be written, or ffmpeg failed.
    """
    try:
        from imageio_ffmpeg import write_frames
    except ImportError:
        raise StageFailed(
            "MP4 needs imageio-ffmpeg",
            "in irlcli's checkout: pip install '.[video]', or write a .gif",
        ) from None
    writer = write_frames(str(path), played.size, fps=1.0 / played.seconds, quality=8)
    with closing(writer):
        writer.send(None)
        for frame in played.frames:
            writer.send(frame.tobytes())


def _frames(panels: Sequence[Iterator[Image.Image]], worlds: ExitStack) -> Iterator[Image.Image]:
    with worlds:
        # Every episode has a panel, so the first row of panels is complete.
        last = [next(panel) for panel in panels]
        yield _beside(last)
        while any(drawn := [next(panel, None) for panel in panels]):
            last = [new or old for new, old in zip(drawn, last, strict=True)]
            yield _beside(last)


def _panels(
    world: gymnasium.Env,
    policy: Policy,
    title: str,
    limit: int,
    stride: int,
    seed: int,
    score: FrozenReward | None,
) -> Iterator[Image.Image]:
    """A panel for every ``stride``-th step of one episode, and one for its end."""
    observation, _ = world.reset(seed=seed)
    observations = [np.asarray(observation, np.float32)]
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    learned = 0.0
    terminated = truncated = False

    def panel() -> Image.Image:
        numbers = f"step {len(rewards)}   true return {sum(rewards):.0f}"
        numbers += "" if score is None else f"   learned return {learned:.1f}"
        return _panel(np.asarray(world.render()), title, numbers)

    while len(rewards) < limit and not (terminated or truncated):
        if len(rewards) % stride == 0:
            yield panel()
        action = policy.act(observations[-1][None], deterministic=True)[0]
        observation, reward, terminated, truncated, _ = world.step(action)
        observations.append(np.asarray(observation, np.float32))
        actions.append(action)
        rewards.append(float(reward))
        if score is not None:
            step = observations[-2][None], np.asarray(action)[None], observations[-1][None]
            learned += float(score.g_over_scale(*step)[0])
    if score is not None and terminated:
        learned = score.of_episode(
            Trajectory(
                observations=np.stack(observations),
                actions=np.stack(actions),
                rewards=np.array(rewards),
                terminated=True,
                truncated=False,
                seed=seed,
            )
        )
    yield panel()


def _panel(picture: np.ndarray, *lines: str) -> Image.Image:
    """``picture`` [H, W, 3] uint8, resized to a panel, with a caption above it."""
    panel = Image.new("RGB", (PANEL[0], PANEL[1] + _CAPTION), "white")
    panel.paste(ImageOps.pad(Image.fromarray(picture), PANEL), (0, _CAPTION))
    for row, line in enumerate(lines):
        ImageDraw.Draw(panel).text((4, 2 + 14 * row), line, fill="black")
    return panel


def _beside(panels: Sequence[Image.Image]) -> Image.Image:
    """All panels in one image, left to right."""
    row = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1] + _CAPTION))
    for index, panel in enumerate(panels):
        row.paste(panel, (PANEL[0] * index, 0))
    return row
