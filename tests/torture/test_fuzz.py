"""The short form of fuzz.py: mutated inputs are accepted, or refused with an error of our own.

The long form follows coverage: ``make torture``.
"""

from __future__ import annotations

import os
import random

import pytest
from fuzz import TARGETS, Coverage, mutate
from hypothesis import given, settings
from hypothesis import strategies as st

from irlcli.errors import IrlError
from irlcli.interventions import parse_settings


@pytest.fixture(scope="module", params=sorted(TARGETS))
def target(request, tmp_path_factory):
    before = os.getcwd()
    yield TARGETS[request.param](tmp_path_factory.mktemp("fuzz"))
    os.chdir(before)


def test_the_initial_inputs_are_read(target):
    """Mutation starts from at least one valid input per target."""
    taken = []
    for data in target.seeds:
        try:
            target.read(data)
            taken.append(data)
        except IrlError:
            continue
    assert taken


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), rounds=st.integers(1, 3))
def test_mutated_inputs_are_accepted_or_refused(target, seed, rounds):
    rng = random.Random(seed)
    data = rng.choice(target.seeds)
    for _ in range(rounds):
        data = mutate(data, target.seeds, rng)
    try:
        target.read(data)
    except IrlError as error:
        assert str(error) and error.exit_code in (2, 3, 4)


def test_coverage_sees_which_lines_an_input_reaches():
    with Coverage() as sound:
        parse_settings("lunar-lander", "bounce=0.5")
    with Coverage() as again:
        parse_settings("lunar-lander", "bounce=0.5")
    with Coverage() as other, pytest.raises(IrlError):
        parse_settings("lunar-lander", "bounce=much")
    assert sound.steps and sound.steps == again.steps
    assert other.steps - sound.steps
