"""Many processes at once: work is done once, artefacts are seen whole, and none in use is
collected.

    python tests/torture/concurrency.py [--short]
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from harness import HERE, SMOKE, Child, figures, irl, must, preload, seeded, warm_up

if TYPE_CHECKING:
    from irlcli.store import Artefact, KeyRecord, Scratch, Store

KEYS = 6
FILES = {"reward.pt": 40_000, "nested/table.parquet": 9_000}


def content(key: int, name: str) -> bytes:
    return bytes([key]) * FILES[name]


def compute(store: Store, record: KeyRecord, scratch: Scratch) -> Artefact:
    output = scratch.new_output()
    (output / "nested").mkdir()
    for name in FILES:
        (output / name).write_bytes(content(record.parameters["key"], name))
    return store.publish(record, output, {"command": ["irl"]}).artefact


def fill(root: Path, keys: Iterable[int]) -> None:
    """Publish artefacts in a store to copy from."""
    from irlcli.store import KeyRecord, Store

    store = Store(root)
    store.create()
    for key in keys:
        record = KeyRecord("train-airl", 1, {"key": key}, {})
        with store.working_on(record.key, wait=False) as scratch:
            compute(store, record, scratch)


def asker(root: Path, seed: int, rounds: int) -> None:
    """Ask for random artefacts as the runner does: find, copy or compute each."""
    from irlcli.store import KeyRecord, Store
    from irlcli.store.sources import find_in, open_sources

    sources = open_sources([root.parent / "zoo"], print)
    random = seeded()
    random.seed(seed)
    for _ in range(rounds):
        store = Store(root)
        key = random.randrange(KEYS)
        record = KeyRecord("train-airl", 1, {"key": key}, {})
        with store.in_use(wait=True):
            found = store.find(record.key)
            if found is None:
                with store.working_on(record.key, wait=True) as scratch:
                    found = store.find(record.key)
                    if found is None:
                        elsewhere = find_in(sources, record.key)
                        if elsewhere is not None:
                            found = store.adopt(*elsewhere).artefact
                        else:
                            found = compute(store, record, scratch)
                        with open(root.parent / "made", "a") as log:
                            log.write(f"{key}\n")
            for name in FILES:
                assert store.open(found, name).read_bytes() == content(key, name)
            if key < 2 and random.random() < 0.2:
                store.set_name(f"name-{key}", found)
                assert store.resolve(f"name-{key}/reward.pt").artefact == found
        # gc can only run while no process uses the store.
        time.sleep(random.expovariate(1 / 0.05))


def contents(root: Path) -> list[tuple[str, int]]:
    return sorted((str(path), path.lstat().st_mtime_ns) for path in root.rglob("*"))


def until_told(work: Callable[[], None], root: Path) -> None:
    while not (root.parent / "stop").exists():
        work()


def collector(root: Path) -> None:
    from irlcli.errors import Busy
    from irlcli.store import Store

    def work() -> None:
        try:
            removed, _ = Store(root).collect(0.0)
        except Busy:
            return
        with open(root.parent / "collected", "a") as log:
            log.write("".join(f"{a.manifest.record.parameters['key']}\n" for a in removed))
        time.sleep(0.01)

    until_told(work, root)


def checker(root: Path) -> None:
    """Verify everything again and again."""
    from irlcli.store import Store

    def work() -> None:
        store = Store(root)
        with store.in_use(wait=True):
            assert store.verify(store.ids()).damaged == {}
            index = store.index()
            for name in store.names().values():
                assert name in index.artefacts
        # Again without the lock, as on file systems without flock.
        store.garbage(0.0)
        store.stale_work(0.0)
        assert store.verify(store.ids()).damaged == {}
        time.sleep(0.05)

    until_told(work, root)


def fork(work: Callable[[], None]) -> int:
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(code)
    return pid


def store_alone(work: Path, rounds: int) -> dict[str, int]:
    """Run eight askers, two collectors and two checkers on one store."""
    from irlcli.store import Store

    root = work / "runs"
    Store(root).create()
    fill(work / "zoo", range(KEYS // 2))
    before = contents(work / "zoo")
    others = [fork(lambda: collector(root)) for _ in range(2)]
    others += [fork(lambda: checker(root)) for _ in range(2)]
    askers = [fork(lambda seed=seed: asker(root, seed, rounds)) for seed in range(8)]
    assert [os.waitpid(pid, 0)[1] for pid in askers] == [0] * 8
    (work / "stop").touch()
    assert [os.waitpid(pid, 0)[1] for pid in others] == [0] * 4
    made = Counter((work / "made").read_text().split())
    collected = Counter((work / "collected").read_text().split())
    for key, count in made.items():
        # Made or copied once, and once more for each time that it was collected.
        assert count - collected[key] in (0, 1), (key, made, collected)
    store = Store(root)
    assert store.verify(store.ids()).damaged == {}
    assert list((root / ".quarantine").iterdir()) == []
    assert contents(work / "zoo") == before
    return {
        "requests": 8 * rounds,
        "artefacts made or copied": made.total(),
        "artefacts collected": collected.total(),
        "artefacts at the end": len(store.ids()),
    }


def commands_at_once(work: Path, processes: int) -> dict[str, int]:
    """Run overlapping commands at once, with gc, verify and ls beside them."""
    from irlcli.store import Store

    root = work / "commands"
    lander = ["--env", "lunar-lander", "--set", "expert.total_steps=2048"]
    lines = [
        ["collect-experts", *lander, "--intervention", "bounce=0.1,0.5"],
        ["collect-experts", *lander, "--intervention", "bounce=0.5,0.9"],
        ["evaluate", "--expert", *lander, "--ood", "bounce=0.9", "--episodes", "1"],
        ["collect-experts", *lander, "--intervention", "bounce=0.1,0.5"],
    ]
    smoke = [argument for argument in SMOKE if argument != "--quiet"]
    children = [
        Child(root, [*lines[i % len(lines)], *smoke, "--name", f"name-{i}"])
        for i in range(processes)
    ]
    beside = 0
    while not all(child.ended() for child in children):
        collected = irl(root, "gc", "--delete", "--grace-days", "0")
        assert collected.code in (0, 75), collected.err
        must(irl(root, "verify"))
        must(irl(root, "ls", "--json"))
        beside += 1
    ended = [must(child.wait()) for child in children]
    runs = Counter(label for e in ended for label in re.findall(r"^RUN (.*)$", e.err, re.M))
    # Three experts, two datasets, one evaluation: each was computed by one process only.
    assert len(runs) == 6 and set(runs.values()) == {1}, runs
    assert len(set(ended[0].out.split() + ended[3].out.split())) == 1
    must(irl(root, "gc", "--delete", "--grace-days", "0"))
    store = Store(root)
    assert len(store.ids()) == 6 and store.verify(store.ids()).damaged == {}
    return {"processes": processes, "stages run": runs.total(), "gc, verify and ls beside": beside}


def table_rows(work: Path) -> dict[str, int]:
    """Run LunarLander's rows of Table 1 with eight jobs, twice; the second run computes nothing."""
    from irlcli.store import Store

    root = work / "rows"
    line = [sys.executable, "-m", "irlcli", "run", "table1", "--rows", "lunar-lander"]
    line += ["--until", "returns", "--seeds", "0", "--methods", "erm,irm", "--jobs", "8"]
    line += ["--profile", "smoke", "--store", str(root)]
    environment = {**os.environ, "LD_PRELOAD": "", "PYTHONPATH": str(HERE.parent.parent)}
    before: list[str] = []
    for _ in range(2):
        done = subprocess.run(line, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        store = Store(root)
        assert store.verify(store.ids()).damaged == {}
        assert before in ([], store.ids())
        before = store.ids()
    assert "RUN " not in done.stderr
    return {"artefacts of three rows": len(before)}


def main() -> None:
    short = "--short" in sys.argv
    preload()
    signal.alarm(300 if short else 3600)  # ends a deadlock
    if not short:
        warm_up()
    with tempfile.TemporaryDirectory(prefix="irl-torture-") as name:
        work = Path(name)
        begin = time.monotonic()
        figures("concurrency", store_alone(work, 100 if short else 1000))
        if not short:
            figures("concurrency", commands_at_once(work, 8))
            figures("concurrency", table_rows(work))
        figures("concurrency", {"seconds": round(time.monotonic() - begin)})


if __name__ == "__main__":
    main()
