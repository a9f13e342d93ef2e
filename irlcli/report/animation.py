"""Pictures of a policy at work: several settings side by side, as an animated GIF."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageOps

from irlcli.envs import registration as envs
from irlcli.envs.registry import environment
from irlcli.interventions import Setting
from irlcli.rl.ppo import Policy, require_observations

PANEL = (320, 240)
_CAPTION = 16
_FRAMES_PER_SECOND = 20


def write_gif(
    path: Path, policy: Policy, env: str, settings: Sequence[Setting], steps: int, seed: int
) -> None:
    """Play one episode of ``policy`` in each setting, all from ``seed``, at true speed.

    Actions are the policy's most likely ones. A panel whose episode is over stands still.

    Raises:
        UsageError: a setting's observations are not those the policy was trained on.
        OSError: ``path`` cannot be written.
    """
    torch.set_num_threads(1)
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
    frames: list[Image.Image] = []
    last: list[Image.Image | None] = [None] * len(worlds)
    while True:
        drawn = [next(panel, None) for panel in panels]
        if not any(drawn):
            break
        last = [new or old for new, old in zip(drawn, last, strict=True)]
        frames.append(_beside(last))
    for world in worlds:
        world.close()
    # A GIF counts time in hundredths of a second.
    duration = round(100 * stride / rate) * 10
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration, loop=0)


def _panels(world, policy, caption, limit, stride, seed) -> Iterator[Image.Image]:
    """Every ``stride``-th step of one episode, drawn."""
    observation, _ = world.reset(seed=seed)
    total = 0.0
    for step in range(limit):
        if step % stride == 0:
            yield _panel(world.render(), f"{caption}   step {step}   return {total:.0f}")
        action = policy.act(np.asarray(observation)[None], deterministic=True)[0]
        observation, reward, terminated, truncated, _ = world.step(action)
        total += reward
        if terminated or truncated:
            break
    yield _panel(world.render(), f"{caption}   step {step + 1}   return {total:.0f}")


def _panel(picture: np.ndarray, caption: str) -> Image.Image:
    """``picture`` [H, W, 3] uint8 at the panel's size, under its caption."""
    panel = Image.new("RGB", (PANEL[0], PANEL[1] + _CAPTION), "white")
    panel.paste(ImageOps.pad(Image.fromarray(picture), PANEL), (0, _CAPTION))
    ImageDraw.Draw(panel).text((4, 2), caption, fill="black")
    return panel


def _beside(panels: Sequence[Image.Image]) -> Image.Image:
    """One picture of all panels, left to right."""
    row = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1] + _CAPTION))
    for index, panel in enumerate(panels):
        row.paste(panel, (PANEL[0] * index, 0))
    return row
