"""Missing steps as job arrays: few arrays, and no step waits for one that it does not need."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from irlcli.experiments.cluster.arrays import Array, job_arrays


def table(rows=2, runs=3):
    """Experts, demonstrations, rewards, retrained policies and their returns, as in a table."""
    needs = {}
    for row in range(rows):
        needs |= {f"{row}.expert.{i}": () for i in range(2)}
        needs[f"{row}.demos"] = (f"{row}.expert.0", f"{row}.expert.1")
        for run in range(runs):
            reward = f"{row}.{run}"
            needs[reward] = (f"{row}.demos",)
            needs[f"{reward}.transfer"] = (reward,)
            needs[f"{reward}.returns"] = (f"{reward}.transfer", reward)
            needs[f"{reward}.expert-by-reward"] = (reward, f"{row}.expert.0")
    return needs


def started_after(arrays):
    """For each step, what must have ended before Slurm starts it.

    A single step is submitted as a plain job, which has no elements that ``aftercorr`` could match.
    """
    after = {}
    for number, array in enumerate(arrays):
        after |= {name: set(array.after) for name in array.names}
        if array.matching is not None:
            matched = arrays[array.matching].names
            assert array.matching < number, f"{array} is submitted before what it matches"
            assert 2 <= len(array.names) <= len(matched), f"{array} matches {matched}"
            for name, need in zip(array.names, matched, strict=False):
                after[name].add(need)
    return after


def closure(needs):
    found = {}
    for name, listed in needs.items():
        found[name] = set(listed).union(*(found.get(need, set()) for need in listed))
    return found


def test_a_table_has_an_array_per_level_and_row_where_elements_do_not_match():
    arrays = job_arrays(table())
    first, demos, *rest = arrays
    assert len(first.names) == 4 and first.after == ()
    assert demos.after == ("0.expert.0", "0.expert.1") and demos.names == ("0.demos",)
    rewards = [array for array in arrays if array.names[0] in ("0.0", "1.0")]
    assert [(len(a.names), len(a.after), a.matching) for a in rewards] == [(3, 1, None)] * 2
    transfers = [array for array in arrays if "transfer" in array.names[0]]
    assert [arrays[a.matching] for a in transfers] == rewards
    assert len(rest) == 1 + 2 + 2 + 2 + 2


def test_one_step_is_no_array_that_others_could_match():
    assert job_arrays({"a": (), "b": ("a",)}) == [Array(("a",)), Array(("b",), ("a",))]


def test_jobs_that_exist_already_are_waited_for():
    assert job_arrays({"b": ("a",), "c": ("a",)}) == [Array(("b", "c"), ("a",))]


def test_arrays_are_no_longer_than_slurm_takes():
    arrays = job_arrays({str(i): () for i in range(25)}, most=10)
    assert [len(array.names) for array in arrays] == [10, 10, 5]


@st.composite
def plans(draw):
    names = [f"s{i}" for i in range(draw(st.integers(0, 14)))]
    return {
        name: tuple(
            draw(st.lists(st.sampled_from(names[:i]), max_size=3, unique=True)) if i else ()
        )
        for i, name in enumerate(names)
    }


@given(plans())
def test_each_step_waits_for_exactly_what_it_needs(needs):
    arrays = job_arrays(needs)
    after = started_after(arrays)
    assert sorted(after) == sorted(needs)
    assert closure(after) == closure(needs)
