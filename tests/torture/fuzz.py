"""Coverage-guided fuzzing of everything that reads files and text from users.

    python tests/torture/fuzz.py [--seconds 600] [--target NAME] [--seed 0]

Inputs that reach new lines of irlcli are kept and mutated further. Every input must be accepted, or
refused with one of the program's own errors; anything else is a finding, and so is an input that
takes longer than ten seconds. Each target runs in its own process with 8 GiB of address space, so
crashes and decompression bombs are findings too. Prints executions, lines reached and inputs kept;
exits 1 and prints the input if there is a finding.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import IrlError

PACKAGE = str(Path(__file__).parent.parent.parent / "irlcli")
SLOW_SECONDS = 10
ADDRESS_SPACE = 8 << 30
TOKENS = (
    *(b"=", b",", b"..", b":", b"x", b"1e308", b"-0.0", b"nan", b"2x", b"-10..0", b"1.5:0.1:0.1"),
    *(b"[", b"]", b"{", b"}", b'"', b"\\", b"\n", b"\0", b"\xff", b"null", b"1e999", b"9" * 400),
    *(b"../", b"/", b".", b"abc", b"PAR1", b"PK\x03\x04", b"\x80\x02", b"R.", b"\x7f\xff\xff\xff"),
    *(b"airl.ppo.", b"engine-power", b"true", b"[[", b"\xd9\xa3x", b"\xe2\x80\xae"),
)


class Target(NamedTuple):
    """Initial inputs, and the function that reads one."""

    seeds: Sequence[bytes]
    read: Callable[[bytes], object]


def interventions(place: Path) -> Target:
    from irlcli.envs.registry import ENVIRONMENTS
    from irlcli.interventions import parse_setting, parse_settings

    def read(data: bytes) -> None:
        text = data.decode("utf-8", "surrogateescape")
        for env in ENVIRONMENTS:
            try:
                settings = parse_settings(env, text)
            except IrlError as error:
                assert error.hint
            else:
                for setting in settings:
                    assert parse_setting(env, str(setting)) == setting

    return Target(
        [b"engine-power=1x,1.25x", b"friction=1.5:0.1:0.1", b"direction=-10..0", b"goal-y=-900,0"],
        read,
    )


def overrides(place: Path) -> Target:
    from irlcli.configs import load_config

    def read(data: bytes) -> None:
        load_config("gridworld", overrides=[data.decode("utf-8", "surrogateescape")])

    seeds = [b"airl.penalty_weight=30", b"airl.hidden=[32, 32]", b"expert.ppo.activation=relu"]
    return Target(seeds, read)


def settings_files(place: Path) -> Target:
    from irlcli.configs import load_config

    def read(data: bytes) -> None:
        (place / "settings.toml").write_bytes(data)
        load_config("gridworld", files=[place / "settings.toml"])

    demo = Path(PACKAGE).parent / "settings" / "demo" / "lunar-lander.toml"
    seeds = [
        demo.read_bytes(),
        b"[airl]\npenalty = 'irmv1'\n[airl.ppo]\nn_envs = 4",
        b"",
        b"a.b = [{}]",
    ]
    return Target(seeds, read)


def _publish(store, files: dict[str, bytes], stage: str = "train-airl"):
    from irlcli.store import KeyRecord

    record = KeyRecord(stage, 1, {"seed": 0, "learning_rate": 1e-5}, {"reward": "0" * 64})
    store.create()
    with store.working_on(record.key, wait=False) as scratch:
        output = scratch.new_output()
        for name, data in files.items():
            (output / name).write_bytes(data)
        return store.publish(record, output, {"command": ["irl", stage]}).artefact


def references(place: Path) -> Target:
    from irlcli.store import Store

    # The default store, and one elsewhere, in which runs/ID must be found too.
    stores = [Store(place / name) for name in ("runs", "elsewhere")]
    for store in stores:
        artefact = _publish(store, {"reward.pt": b"x"})
        store.set_name("best", artefact)
    os.chdir(place)

    def read(data: bytes) -> None:
        # No argument of a process contains a zero byte.
        ref = data.replace(b"\0", b"").decode("utf-8", "surrogateescape")
        for store in stores:
            try:
                found = store.resolve(ref)
            except IrlError as error:
                assert error.hint
                continue
            if found.artefact is not None:
                inside = (store.root / artefact.id).resolve()
                assert found.path.resolve().is_relative_to(inside)

    seeds = [
        b"best",
        b"best/reward.pt",
        artefact.id[:5].encode(),
        b"runs/best/reward.pt",
        f"runs/{artefact.id[:4]}/reward.pt".encode(),
        b"./runs",
    ]
    return Target(seeds, read)


def manifests(place: Path) -> Target:
    from irlcli.store import Store
    from irlcli.store.manifest import read_manifest, read_provenance

    artefact = _publish(Store(place / "runs"), {"reward.pt": b"x", "policy.pt": b"y"})
    seeds = [(artefact.directory / n).read_bytes() for n in ("manifest.json", "provenance.json")]

    def read(data: bytes) -> None:
        for name, reader in (
            ("manifest.json", read_manifest),
            ("provenance.json", lambda directory: read_provenance(directory, artefact.manifest.id)),
        ):
            (place / name).write_bytes(data)
            try:
                reader(place)
            except IrlError:
                # One file being refused must not keep the other from being read.
                continue

    return Target(seeds, read)


def describing(place: Path) -> Target:
    import json

    from irlcli.data import descriptions
    from irlcli.store import read_json

    policy = {"agent": "student", "env": "lunar-lander", "settings": ["bounce=0.5"], "seed": 0}
    network = {"algorithm": "ppo", "env": "lunar-lander", "net_arch": [64], "activation": "tanh"}
    subject = {"agent": "expert", "env": "ant"}
    row = {"setting": "mass=2x", "episodes": 3, "mean_return": 1.5, "stopped": 0}
    seeds = [
        {**policy, "network": {**network, "ortho_init": True}, "method": "irm"},
        {"policy": subject, "settings": [row]},
        {"env": "ant", "settings": ["mass=2x", "mass=1x"]},
        {"env": "ant", "settings": [row]},
        {"settings": [{"setting": "x", "seen": True, "log_likelihood": 0.0}]},
    ]

    def read(data: bytes) -> None:
        (place / "description.json").write_bytes(data)
        value = read_json(place / "description.json")
        for form in (descriptions.Reward, descriptions.TabularReward, descriptions.Policy):
            _refused(descriptions.parse, value, form)
        for form in (descriptions.Dataset, descriptions.Evaluation):
            _refused(descriptions.parse, value, form)
        for form in (descriptions.Quality, descriptions.DemonstrationSummary):
            _refused(descriptions.convert, value, form)

    return Target([json.dumps(seed).encode() for seed in seeds], read)


def _refused(parse, value, form) -> None:
    try:
        parse(value, form, "description.json")
    except IrlError as error:
        assert error.hint


def _demonstrations(place: Path, changed: str) -> Target:
    import numpy as np
    import pyarrow.parquet as pq

    from irlcli.data.demonstrations import read_demonstrations
    from irlcli.data.streaming import write_demonstrations
    from irlcli.interventions import parse_settings
    from irlcli.trajectories import Trajectory

    rng = np.random.default_rng(0)
    groups = [
        (
            setting,
            [
                Trajectory(
                    observations=rng.normal(size=(n + 1, 3)).astype(np.float32),
                    actions=rng.integers(4, size=n),
                    rewards=rng.normal(size=n),
                    terminated=True,
                    truncated=False,
                    seed=n,
                )
                for n in (1, 3)
            ],
        )
        for setting in parse_settings("lunar-lander", "bounce=0.1,0.5")
    ]
    write_demonstrations(place, "lunar-lander", groups, {})
    path = place / changed
    seeds = [path.read_bytes()]
    # Without compression and checksums a changed byte reaches the decoders of the columns.
    pq.write_table(pq.read_table(path), path, compression="none")
    seeds.append(path.read_bytes())

    def read(data: bytes) -> None:
        path.write_bytes(data)
        read_demonstrations(place)

    return Target(seeds, read)


def steps(place: Path) -> Target:
    return _demonstrations(place, "steps.parquet")


def episodes(place: Path) -> Target:
    return _demonstrations(place, "episodes.parquet")


def tensors(place: Path) -> Target:
    import torch

    from irlcli.data.tensors import load_policy_file, load_reward_file, to_bytes

    path = place / "reward.pt"
    sound = {"kind": "reward", "schema": 1, "description": "{}", "state": {"a": torch.zeros(2)}}

    def read(data: bytes) -> None:
        path.write_bytes(data)
        for load in (load_reward_file, load_policy_file):
            try:
                load(path)
            except IrlError as error:
                assert error.hint

    return Target([to_bytes(sound), to_bytes({**sound, "state": {}}), to_bytes([1, "x"])], read)


TARGETS: dict[str, Callable[[Path], Target]] = {
    "interventions": interventions,
    "overrides": overrides,
    "settings-files": settings_files,
    "references": references,
    "manifests": manifests,
    "descriptions": describing,
    "steps": steps,
    "episodes": episodes,
    "tensors": tensors,
}


def mutate(data: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """``data`` with a few bytes flipped, cut, repeated, or replaced by a token or another input."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(7):
            case 0 if at < len(changed):
                changed[at] ^= 1 << rng.randrange(8)
            case 1 if at < len(changed):
                changed[at] = rng.randrange(256)
            case 2:
                del changed[at : at + rng.choice((1, 2, 4, 16, 64))]
            case 3:
                changed[at:at] = rng.choice(TOKENS)
            case 4:
                token = rng.choice(TOKENS)
                changed[at : at + len(token)] = token
            case 5:
                changed[at:at] = changed[at : at + rng.randrange(1, 32)] * rng.choice((1, 2, 50))
            case _:
                other = rng.choice(others)
                cut = rng.randrange(len(other) + 1)
                changed[at:] = other[cut:]
    return bytes(changed[: 1 << 16])


class Coverage:
    """The steps from line to line of the package that an input takes (``sys.settrace``)."""

    def __init__(self):
        self.steps: set[tuple[str, int, int]] = set()

    def __enter__(self) -> Coverage:
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _call(self, frame, event, _):
        name = frame.f_code.co_filename
        if not name.startswith(PACKAGE):
            return None
        last = 0

        def line(frame, event, _):
            nonlocal last
            if event == "line":
                self.steps.add((name, last, frame.f_lineno))
                last = frame.f_lineno
            return line

        return line


class TooSlow(Exception):
    """One input took longer than ``SLOW_SECONDS``."""


def _too_slow(*_: object) -> None:
    raise TooSlow


def fuzz(name: str, seconds: float, seed: int, place: Path) -> None:
    """Fuzz one target; raises what it finds. The current input is in ``place``/input."""
    target = TARGETS[name](place)
    # Not smaller: Torch and Arrow map far more memory than they use.
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    signal.signal(signal.SIGALRM, _too_slow)
    rng, kept, seen = random.Random(seed), list(target.seeds), set()
    done, started = 0, time.monotonic()
    while time.monotonic() - started < seconds:
        data = kept[done] if done < len(target.seeds) else mutate(rng.choice(kept), kept, rng)
        (place / "input").write_bytes(data)
        signal.alarm(SLOW_SECONDS)
        with Coverage() as coverage:
            try:
                target.read(data)
            except IrlError as error:
                assert str(error) and error.exit_code in (2, 3, 4), repr(error)
        signal.alarm(0)
        done += 1
        if not coverage.steps <= seen:
            seen |= coverage.steps
            kept.append(data)
    lines = len({(file, line) for file, _, line in seen})
    spent = time.monotonic() - started
    print(
        f"{name:16}{done:10,}{done / spent:10,.0f}{lines:8,}{len(seen):8,}{len(kept):8,}{spent:8.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600, help="in all; shared by the targets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=sorted(TARGETS), help="this one alone")
    parser.add_argument("--place", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.place is not None:
        fuzz(options.target, options.seconds, options.seed, options.place)
        return
    names = [options.target] if options.target else list(TARGETS)
    print(
        f"{'target':16}{'inputs':>10}{'per s':>10}{'lines':>8}{'steps':>8}{'kept':>8}{'seconds':>8}"
    )
    found = 0
    for name in names:
        with tempfile.TemporaryDirectory() as place:
            words = ["--target", name, "--seed", str(options.seed), "--place", place]
            words += ["--seconds", str(options.seconds / len(names))]
            code = subprocess.run([sys.executable, __file__, *words]).returncode
            if code:
                found += 1
                given = (Path(place) / "input").read_bytes()
                print(f"{name}: ended with {code} on {given[:2000]!r}", file=sys.stderr)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
