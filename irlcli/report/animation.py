"""Animated GIFs of a policy acting in several settings side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageOps

from irlcli.envs import registration as envs
from irlcli.envs.registry import environment
from irlcli.interventions import Setting
from irlcli.rl.policy import Policy, require_observations

PANEL = (320, 240)
_CAPTION = 16
_FRAMES_PER_SECOND = 20


def write_gif(
    path: Path, policy: Policy, env: str, settings: Sequence[Setting], steps: int, seed: int
) -> None:
    """Play one episode of ``policy`` in each setting, all from ``seed``, in real time.

    Actions are the most likely ones. When an episode ends, its panel keeps the last frame.

    Args:
        path: the GIF to write.
        env: name of the environment.
        settings: a panel each, left to right.
        steps: at most this many steps per episode; at most the time limit.
        seed: of the episodes' starts.

    Raises:
        UsageError: a setting's observations differ from those the policy was trained on.
        OSError: ``path`` cannot be written.
    """
    worlds = [envs.make(env, setting, render_mode="rgb_array") for setting in settings]
    for world, setting in zip(worlds, settings, strict=True):
        require_observations(policy, world.observation_space, f"{env} {setting}")
    rate = worlds[0].metadata["render_fps"]
    stride = max(1, round(rate / _FRAMES_PER_SECOND))
    limit = min(steps, environment(env).max_episode_steps)
    panels = [
        _panels(world, policy, f"{env} {setting}", limit, stride, seed)
        for world, setting in zip(worlds, settings, strict=True)
    ]
    # Every episode has a panel, so the first row of panels is complete.
    last = [next(panel) for panel in panels]
    frames = [_beside(last)]
    while any(drawn := [next(panel, None) for panel in panels]):
        last = [new or old for new, old in zip(drawn, last, strict=True)]
        frames.append(_beside(last))
    for world in worlds:
        world.close()
    # GIF durations have a resolution of 10 ms.
    duration = round(100 * stride / rate) * 10
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration, loop=0)


def _panels(
    world: gymnasium.Env, policy: Policy, caption: str, limit: int, stride: int, seed: int
) -> Iterator[Image.Image]:
    """A panel for every ``stride``-th step of one episode, and one for its end."""
    observation, _ = world.reset(seed=seed)
    total = 0.0
    for step in range(limit):
        if step % stride == 0:
            yield _panel(_frame(world), f"{caption}   step {step}   return {total:.0f}")
        action = policy.act(np.asarray(observation)[None], deterministic=True)[0]
        observation, reward, terminated, truncated, _ = world.step(action)
        total += float(reward)
        if terminated or truncated:
            break
    yield _panel(_frame(world), f"{caption}   step {step + 1}   return {total:.0f}")


def _frame(world: gymnasium.Env) -> np.ndarray:
    return np.asarray(world.render())


def _panel(picture: np.ndarray, caption: str) -> Image.Image:
    """``picture`` [H, W, 3] uint8, resized to a panel, with a caption above it."""
    panel = Image.new("RGB", (PANEL[0], PANEL[1] + _CAPTION), "white")
    panel.paste(ImageOps.pad(Image.fromarray(picture), PANEL), (0, _CAPTION))
    ImageDraw.Draw(panel).text((4, 2), caption, fill="black")
    return panel


def _beside(panels: Sequence[Image.Image]) -> Image.Image:
    """All panels in one image, left to right."""
    row = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1] + _CAPTION))
    for index, panel in enumerate(panels):
        row.paste(panel, (PANEL[0] * index, 0))
    return row
