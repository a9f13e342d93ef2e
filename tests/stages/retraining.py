"""What tests of retraining share."""

import os
import signal

from irlcli.store import Store


def common(store):
    return ["--store", str(store), "--profile", "smoke", "--quiet"]


def made(store, done):
    assert done.code == 0, done.err
    return Store(store).resolve(done.out.strip().rpartition("/")[2]).artefact


def interrupt(trainer, count, monkeypatch):
    """Send this process a SIGINT in the ``count``-th round; the rounds that ``trainer`` ran."""
    original, rounds = trainer.train_round, []

    def interrupted(self, index, source):
        rounds.append(index)
        if len(rounds) == count:
            os.kill(os.getpid(), signal.SIGINT)
        return original(self, index, source)

    monkeypatch.setattr(trainer, "train_round", interrupted)
    return rounds
