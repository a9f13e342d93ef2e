"""Two AIRL jobs side by side against one: does a second core give a second job's worth of work?

One and two jobs alternate in blocks within this run, so that other load affects both alike.
Run by ``make bench``.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time

JOB = [sys.executable, "-m", "benchmarks.airl", "--rounds", "2", "--env"]


def main() -> None:
    """Print jobs per minute with one and with two at a time, and their median ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="lunar-lander")
    parser.add_argument("--blocks", type=int, default=3)
    arguments = parser.parse_args()
    rates: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(arguments.blocks):
        for jobs in rates:
            started = time.perf_counter()
            running = [
                subprocess.Popen([*JOB, arguments.env], stdout=subprocess.DEVNULL)
                for _ in range(jobs)
            ]
            if any(process.wait() for process in running):
                raise SystemExit("a job failed")
            rates[jobs].append(60.0 * jobs / (time.perf_counter() - started))
    ratios = [two / one for one, two in zip(rates[1], rates[2], strict=True)]
    for jobs, found in rates.items():
        each = ", ".join(f"{rate:.1f}" for rate in found)
        print(f"{arguments.env}, {jobs} at a time: {each} jobs a minute")
    print(f"two against one: {statistics.median(ratios):.2f} times the work (median)")


if __name__ == "__main__":
    main()
