"""Where ``airl.plateau_rounds`` would have ended the trainings of a store, and what they earned there.

Reads the metrics of every ``train-airl`` artefact; trains nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from irlcli.labels import describe
from irlcli.learners.stopping import cross_entropies, plateaued
from irlcli.store import Store


def main() -> None:
    """Print one line per training: the share of its budget used, and the students' true returns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("runs"))
    parser.add_argument("--rounds", type=int, default=10, help="airl.plateau_rounds")
    parser.add_argument("--only", default="", help="part of the description, e.g. lunar-lander")
    arguments = parser.parse_args()
    if not arguments.store.is_dir():
        parser.error(f"there is no store at {arguments.store}")
    if arguments.rounds < 1:
        parser.error("--rounds must be at least 1")
    store = Store(arguments.store)
    print(f"{'ends at':>8}{'return there':>14}{'at the end':>12}  training")
    records = [(describe(a.manifest.record), a) for a in store.artefacts()]
    for text, artefact in sorted(records, key=lambda found: (found[0], found[1].id)):
        record = artefact.manifest.record
        if record.stage != "train-airl" or arguments.only not in text:
            continue
        rows = pd.read_parquet(store.open(artefact, "metrics.parquet"))
        airl = record.parameters["airl"]
        first = airl["penalty_warmup_rounds"] + airl["penalty_ramp_rounds"]
        returns = rows.groupby("round")["true_return"].mean()
        end = _end(rows, first, arguments.rounds)
        share = "never" if end is None else f"{end / len(returns):.0%}"
        there = "" if end is None else f"{np.mean(returns[end - arguments.rounds : end]):.0f}"
        last = f"{np.mean(returns[-arguments.rounds :]):.0f}"
        print(f"{share:>8}{there:>14}{last:>12}  {text}")


def _end(rows: pd.DataFrame, first: int, rounds: int) -> int | None:
    """The number of rounds after which the rule holds for the first time."""
    found = cross_entropies(rows.to_dict("records"), first)
    ends = (count for count in range(len(found)) if plateaued(found[:count], rounds))
    end = next(ends, None)
    return None if end is None else first + end


if __name__ == "__main__":
    main()
