"""Kills, failing calls, full disks, clocks set back: the store stays whole, and a rerun gives the
same bytes.

    python tests/torture/crash.py [--short] [--part random ...]
"""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from harness import Chain, Child, Fault, command, figures, irl, must, preload, seeded, warm_up

CHEAP = ("grid", "train-maxent")
_ENOUGH = 2000  # calls; far more than one stage makes
_TOLERATED = 40  # calls that only save work, at most
_YEAR = 365 * 86400


def killed_at_every_call(chain: Chain, stage: str, work: Path, stride: int) -> int:
    """SIGKILL at every ``stride``-th call that changes a file; returns the number of kills.

    The rerun after each kill is killed half as far in; the one after that completes.
    """
    kills = 0
    for n in range(0, _ENOUGH, stride):
        store = chain.fresh(stage, work / "store")
        ended = irl(store, *command(stage), fault=Fault(n))
        if ended.code == 0:
            assert n > 30, "calls were not intercepted"
            return kills
        again = irl(store, *command(stage), fault=Fault(n // 2))
        for killed in (ended, again):
            assert killed.code in (0, -signal.SIGKILL), killed
            kills += killed.code != 0
        chain.assert_sound(stage, store)
        chain.assert_completes(stage, store)
        print(f"crash: {stage}: {kills} kills", file=sys.stderr, flush=True)
    raise AssertionError(f"{stage} never completed")


def killed_at_random(chain: Chain, stage: str, work: Path, wanted: int) -> tuple[int, int]:
    """SIGKILL at random times, several per run; returns the numbers of kills and of completed runs."""
    random = seeded()
    kills = runs = 0
    while kills < wanted:
        store = chain.fresh(stage, work / "store")
        for _ in range(random.randint(1, 5)):
            child = Child(store, command(stage))
            time.sleep(random.uniform(0.0, 1.1 * chain.seconds[stage]))
            if not child.ended():
                child.kill()
            ended = child.wait()
            chain.assert_sound(stage, store)
            if ended.code == 0:
                break
            assert ended.code == -signal.SIGKILL, ended
            kills += 1
        chain.assert_completes(stage, store)
        runs += 1
        print(f"crash: {stage}: {kills} kills", file=sys.stderr, flush=True)
    return kills, runs


def refused_calls(
    chain: Chain, stage: str, work: Path, stride: int, persists: Sequence[bool], leases: bool
) -> int:
    """One kind of call fails, once or from a point on; returns the number of failed runs.

    Those of leases and locks, which a run may survive, only if ``leases``.
    """
    refused = 0
    for call, number in (
        ("fsync", errno.EIO),
        ("rename", errno.EIO),
        ("link", errno.EPERM),
        ("write", errno.ENOSPC),
        ("mkdir", errno.EDQUOT),
        ("open", errno.EROFS),
    ):
        for persist in persists:
            # What only saves work may fail without failing the run.
            unharmed = 0
            for n in range(0, _ENOUGH, stride):
                store = chain.fresh(stage, work / "store")
                spared = None if leases else store / ".locks"
                fault = Fault(n, number, persist, (call,), spared=spared)
                ended = irl(store, *command(stage), fault=fault)
                chain.assert_sound(stage, store)
                if ended.code == 0:
                    unharmed += 1
                    if unharmed > _TOLERATED // stride:
                        break
                    continue
                must(ended, 1)
                assert os.strerror(number) in ended.err and "hint: " in ended.err, ended.err
                chain.assert_completes(stage, store)
                refused += 1
    assert refused >= 6, refused
    return refused


def clock_set_back(chain: Chain, stage: str, work: Path) -> int:
    """A run is killed, the clock is set back or forward by a year, and the run is resumed."""
    from irlcli.store import Store

    for clock in (-_YEAR, _YEAR):
        store = chain.fresh(stage, work / "store")
        child = Child(store, command(stage))
        while not child.ended() and not list(store.glob(".work/*/checkpoint")):
            time.sleep(0.001)
        if not child.ended():
            child.kill()
        child.wait()
        must(irl(store, *command(stage), fault=Fault(clock=clock)))
        chain.assert_sound(stage, store)
        assert Store(store).ids() == chain.ids[stage]
        for artefact in Store(store).artefacts():
            origin = artefact.provenance()
            assert origin["seconds"] >= 0 and all(a["seconds"] >= 0 for a in origin["attempts"])
        # Artefacts dated in the future count as young, named or not.
        for name in (store / ".names").iterdir():
            name.unlink()
        if clock < 0:
            fault = Fault(clock=clock)
            must(irl(store, "gc", "--delete", "--grace-days", "0", fault=fault))
            assert Store(store).ids() == chain.ids[stage]
    return 2


def full_disk(chain: Chain, stage: str, work: Path, stride: int) -> dict[str, int]:
    """Run on file systems of increasing size until one suffices; enlarge each full one and rerun.

    Runs in a mount namespace of its own, where a tmpfs may be mounted.
    """
    place = work / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", str(place)], check=True)
    full = 0
    needed = 0
    inputs = sum(f.stat().st_size for f in chain.before[stage].rglob("*") if f.is_file()) >> 10
    for pages in range(2, _ENOUGH, stride):
        store = place / "store"
        subprocess.run(["mount", "-o", "remount,size=1g", str(place)], check=True)
        chain.fresh(stage, store)
        used = shutil.disk_usage(place).used
        size = used + pages * 4096
        subprocess.run(["mount", "-o", f"remount,size={size}", str(place)], check=True)
        ended = irl(store, *command(stage))
        chain.assert_sound(stage, store)
        if ended.code == 0:
            needed = pages * 4
            break
        must(ended, 1)
        assert os.strerror(errno.ENOSPC) in ended.err, ended.err
        full += 1
        subprocess.run(["mount", "-o", "remount,size=1g", str(place)], check=True)
        chain.assert_completes(stage, store)
    subprocess.run(["umount", str(place)], check=True)
    assert full > 0 and needed > 0
    return {"full disks": full, "KiB needed beside the inputs": needed, "KiB of inputs": inputs}


def in_mount_namespace(script: Path, arguments: list[str]) -> subprocess.CompletedProcess | None:
    """Run this script in a mount namespace; None if the system does not allow it."""
    unshare = ["unshare", "--mount", "--map-root-user", "--user"]
    probe = [*unshare, "sh", "-c", "mount -t tmpfs tmpfs /tmp"]
    if shutil.which("unshare") is None or subprocess.run(probe, capture_output=True).returncode:
        return None
    line = [*unshare, sys.executable, str(script), *arguments]
    return subprocess.run(line, capture_output=True, text=True)


PARTS = ("random", "refused", "clock", "disk", "calls")


def attack(part: str, chain: Chain, work: Path, short: bool) -> None:
    """Run one of :data:`PARTS` and print its measurements."""
    stage = "train-maxent"
    if part == "calls":
        for each, stride in ((stage, 42),) if short else (("grid", 1), (stage, 6)):
            found = killed_at_every_call(chain, each, work, stride)
            figures("crash", {f"{each}: kills, at every call by {stride}": found})
    elif part == "random":
        for each in (stage,) if short else chain.before:
            found, runs = killed_at_random(chain, each, work, 2 if short else 20)
            figures("crash", {f"{each}: kills at random times": found, f"{each}: runs": runs})
    elif part == "refused":
        how = (25, (False,), False) if short else (6, (False, True), True)
        figures("crash", {"refused calls": refused_calls(chain, stage, work, *how)})
    elif part == "clock":
        figures("crash", {"clocks set": clock_set_back(chain, stage, work)})
    elif not short:
        disks = in_mount_namespace(Path(__file__), ["--full-disk"])
        if disks is None:
            print("crash: full disk: left out, a tmpfs may not be mounted here")
        else:
            assert disks.returncode == 0, disks.stderr
            print(disks.stdout, end="")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--full-disk", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    preload()
    warm_up()
    with tempfile.TemporaryDirectory(prefix="irl-torture-") as name:
        work = Path(name)
        if options.full_disk:
            figures("full disk", full_disk(Chain(work, CHEAP), "train-maxent", work, 4))
            return
        begin = time.monotonic()
        chain = Chain(work, CHEAP) if options.short else Chain(work)
        for part in options.part:
            attack(part, chain, work, options.short)
        figures("crash", {"seconds": round(time.monotonic() - begin)})


if __name__ == "__main__":
    main()
