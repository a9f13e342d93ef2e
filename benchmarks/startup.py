"""The cost of a command before it does any work, against importing typer and rich.

Counted in instructions by ``valgrind --tool=callgrind``, which repeats to within a percent on a
busy machine, where seconds do not. The budget of ``irl --help`` and of a cache hit is 1.5 times
``import typer, rich``. The last column leaves out what starting Python costs.

Run with ``python -m benchmarks.startup``; needs valgrind.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence

BUDGET = 1.5
HIT = [
    *("evaluate", "--random", "--env", "lunar-lander", "--intervention", "bounce=0.9"),
    *("--profile", "smoke", "--quiet", "--json", "--store"),
]


def main() -> None:
    """Print the instructions of ``irl --help``, ``irl ls`` and a cache hit, and their ratios."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    bare = instructions("pass")
    base = instructions("import typer, rich")
    print(f"{'command':20}{'10^6 instructions':>18}{'x base':>8}{'x base, less Python':>21}")
    with tempfile.TemporaryDirectory() as store:
        for name, cost in {
            "import typer, rich": base,
            "irl --help": instructions(_irl(["--help"])),
            "a cache hit": instructions(_irl([*HIT, store])),
            "irl ls": instructions(_irl(["ls", "--store", store])),
        }.items():
            ratio = cost / base
            late = "" if ratio <= BUDGET else "  over budget"
            less = (cost - bare) / (base - bare)
            print(f"{name:20}{cost / 1e6:18.1f}{ratio:8.2f}{less:21.2f}{late}")


def _irl(arguments: list[str]) -> str:
    """The code of the console script ``irl``, run on ``arguments``."""
    return (
        f"import sys; sys.argv = {['irl', *arguments]!r}\nfrom irlcli.cli.main import main; main()"
    )


def instructions(code: str) -> int:
    """Instructions of a Python process that runs ``code``, the second time it is run.

    The first time it may compile modules, and compute what is then a hit.
    """
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment)
    return counted(["-c", code], environment)


def counted(arguments: Sequence[str], environment: Mapping[str, str]) -> int:
    """Instructions of ``python ARGUMENTS``, counted by callgrind."""
    callgrind = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null"]
    done = subprocess.run(
        [*callgrind, sys.executable, *arguments],
        check=True,
        capture_output=True,
        text=True,
        env={**environment, "PYTHONHASHSEED": "0"},
    )
    (count,) = re.findall(r"Collected : (\d+)", done.stderr)
    return int(count)


if __name__ == "__main__":
    main()
