"""What commands cost as the store grows; the cost of a hit must not grow.

python tests/torture/growth.py [--short]
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from harness import HERE, figures

_FAMILY = 4  # length of a chain of artefacts made from one another
_HIT = (
    *("evaluate", "--idle", "--env", "lunar-lander", "--intervention", "bounce=0.9"),
    *("--profile", "smoke", "--episodes", "1", "--name", "hit"),
)


def fill(root: Path, wanted: int) -> str:
    """Publish until the store has ``wanted`` artefacts; returns the id of the last one."""
    from irlcli.store import KeyRecord, Store

    store = Store(root)
    store.create()
    parent = None
    have = len(store.ids())
    while have < wanted:
        inputs = {} if have % _FAMILY == 0 or parent is None else {"reward": parent}
        parameters = {"env": "lunar-lander", "settings": ["bounce=0.9"], "seed": have}
        record = KeyRecord("train-airl", 2, parameters, inputs)
        with store.working_on(record.key, wait=False) as scratch:
            output = scratch.new_output()
            (output / "reward.pt").write_bytes(b"%d" % have)
            artefact = store.publish(record, output, {"command": ["irl", "train-airl"]}).artefact
        parent = artefact.output("reward.pt").sha256
        if have % 10 == 9:
            store.set_name(f"name-{have}", artefact)
        have += 1
        last = artefact.id
    return last


def run(root: Path, *arguments: str) -> tuple[float, int, str]:
    """Seconds of processor time, peak memory [MiB] and stdout of a command in a new process."""
    line = [sys.executable, "-m", "irlcli", *arguments, "--store", str(root)]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(line, stdout=log, stderr=subprocess.PIPE, cwd=HERE.parent.parent)
        errors = process.stderr.read().decode()
        process.stderr.close()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0, errors
        log.seek(0)
        return used.ru_utime + used.ru_stime, used.ru_maxrss >> 10, log.read().decode()


def calls(root: Path, *arguments: str) -> dict[str, int]:
    """System calls of a command on paths in the store, by name, counted with strace."""
    line = ["strace", "-f", "-qq", "-y", "-o", "/dev/stdout", "-e", "trace=%file,%desc"]
    line += [sys.executable, "-B", "-m", "irlcli", *arguments, "--store", str(root)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=HERE.parent.parent)
    assert done.returncode == 0, done.stderr
    found: dict[str, int] = {}
    for row in done.stdout.splitlines():
        call = re.match(r"(?:\d+ +)?(\w+)\(", row)
        if call and str(root) in row:
            found[call[1]] = found.get(call[1], 0) + 1
    return found


_AUDIT = """
import sys
seen = {{}}
def audit(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and arguments:
        if str(arguments[0]).startswith({root!r}):
            seen[event] = seen.get(event, 0) + 1
sys.addaudithook(audit)
sys.argv = ["irl", *{arguments!r}]
from irlcli.cli.main import main
try:
    main()
finally:
    print("SEEN", sorted(seen.items()))
"""


def opened(root: Path, *arguments: str) -> str:
    """Numbers of files that Python opens and directories that it lists in the store."""
    code = _AUDIT.format(root=str(root), arguments=[*arguments, "--store", str(root)])
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=HERE.parent.parent
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def main() -> None:
    short = "--short" in sys.argv
    sizes = (10, 200) if short else (100, 1_000, 10_000)
    shared_memory = Path("/dev/shm")
    place = shared_memory if shared_memory.is_dir() and os.access(shared_memory, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="irl-torture-", dir=place) as name:
        root = Path(name) / "runs"
        run(root, *_HIT)
        hits, traces, shows = set(), set(), set()
        for size in sizes:
            begin = time.process_time()
            before = len([p for p in root.iterdir() if p.name[0] != "."])
            last = fill(root, size)
            filled = (time.process_time() - begin) / max(1, size - before)
            hits.add(opened(root, *_HIT))
            shows.add(opened(root, "show", last, "--json").splitlines()[-1])
            if shutil.which("strace") is not None:
                traces.add(str(sorted(calls(root, *_HIT).items())))
            if not short:
                costs = {
                    # The median of three: other work on the machine makes seconds longer.
                    text: "{:.2f} s, {} MiB".format(
                        *sorted(run(root, *text.split())[:2] for _ in range(3))[1]
                    )
                    for text in (
                        "ls",
                        f"show {last}",
                        "show hit",
                        " ".join(_HIT),
                        f"lineage {last}",
                        "verify --quick",
                        "verify",
                        "gc",
                    )
                }
                costs = {text.replace(last, "ID"): cost for text, cost in costs.items()}
                figures(
                    f"growth, {size} artefacts", {"ms to publish": round(1e3 * filled, 1), **costs}
                )
        # Equal for all sizes: a hit lists no directory and opens no other artefact's files.
        assert len(hits) == 1 and "listdir" not in str(hits) and "scandir" not in str(hits), hits
        assert len(shows) == 1, shows
        assert len(traces) <= 1, traces
        figures(
            "growth",
            {
                "a hit opens": hits.pop(),
                "a hit calls": traces.pop() if traces else "unknown: there is no strace",
                "peak memory of this script [MiB]": resource.getrusage(
                    resource.RUSAGE_SELF
                ).ru_maxrss
                >> 10,
            },
        )


if __name__ == "__main__":
    main()
