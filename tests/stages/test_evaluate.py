"""What an evaluation writes."""

import pandas as pd
import pytest

from irlcli.store import read_json


def test_the_summary_has_the_statistics_of_the_episodes(smoke_store):
    made = smoke_store.path / smoke_store.evaluation
    episodes = pd.read_parquet(made / "episodes.parquet")
    (found,) = read_json(made / "summary.json")["settings"]
    returns = episodes["true_return"]
    assert found["episodes"] == len(episodes) == 3
    assert found["mean_return"] == pytest.approx(returns.mean())
    # Of a sample: the squares are divided by n - 1.
    squares = ((returns - returns.mean()) ** 2).sum()
    assert found["std_return"] == pytest.approx((squares / 2) ** 0.5)
    assert found["mean_length"] == pytest.approx(episodes["length"].mean())
    assert found["terminated"] == episodes["terminated"].mean()
