"""The discriminator's penalties on Colored MNIST's structure reproduce the published order."""

import numpy as np
import pytest
import torch

from irlcli.controls.classifier import Networks, Schedule, accuracy, train
from irlcli.controls.cued_labels import UNIT_TESTS, coloured_digits, permuted, unit_test
from irlcli.controls.methods import LabelMethod
from irlcli.penalties import PENALTIES

SEEDS = range(10)
SCHEDULE = Schedule(500, 100, 5e-3)


def drawn(strengths, seeds=SEEDS):
    """40 samples of each label: enough for exact shares."""
    return coloured_digits(seeds, 40, 0.25, strengths)


def unseen(method):
    """Accuracy where the colour agrees with the opposite label, for each of ten seeds."""
    networks = train(drawn((0.9, 0.8)), method, SCHEDULE, 16, SEEDS)
    return accuracy(networks, drawn((0.1,)))[:, 0]


def test_the_shares_are_exact():
    samples = drawn((0.9, 0.8))
    signs = torch.tensor([-1.0, 1.0])[:, None]
    agrees = samples == signs[..., None]
    assert torch.allclose(agrees[..., 0].float().mean(-1), torch.tensor(0.75))
    colour = agrees[..., 1].float().mean(-1)
    assert torch.allclose(colour, torch.tensor([[0.9], [0.8]]).expand(10, 2, 2))


@pytest.mark.parametrize("name", ["irmv1", "vrex", "iga"])
def test_an_invariance_penalty_ends_at_the_invariant_optimum(name):
    """0.75, the share of the labels that the digit agrees with (Arjovsky et al. 2019, Sec. 5.2)."""
    assert torch.allclose(unseen(LabelMethod(name, 1e4)), torch.tensor(0.75))


@pytest.mark.parametrize(
    "method",
    [
        LabelMethod(),
        LabelMethod("l2", 1e-2),
        LabelMethod("input-gradient", 0.1),
        LabelMethod("group-dro", 100.0),
        LabelMethod(dropout=0.5),
        LabelMethod("vrex", 1.0, shuffled=True),
    ],
    ids=str,
)
def test_what_seeks_no_invariance_fails_where_the_colour_turns(method):
    assert unseen(method).max() < 0.5


def test_shuffled_labels_do_not_find_the_digit():
    """With few samples shuffled groups still differ by chance, so some runs move."""
    assert unseen(LabelMethod("irmv1", 1e4, shuffled=True)).mean() < 0.5


@pytest.mark.parametrize("name", [n for n, p in PENALTIES.items() if "airl" in p.learners])
def test_runs_do_not_affect_each_other(name):
    samples, seeds = drawn((0.9, 0.8), [3, 4]), [3, 4]
    short = Schedule(12, 2, 1e-2)
    both = train(samples, LabelMethod(name, 2.0), short, 4, seeds)
    for r, seed in enumerate(seeds):
        alone = train(samples[r : r + 1], LabelMethod(name, 2.0), short, 4, [seed])
        for one, other in zip(both.layers, alone.layers, strict=True):
            assert torch.allclose(one[r], other[0], atol=1e-5)


def test_a_penalty_of_the_parameters_that_is_not_registered_as_additive_fails(monkeypatch):
    """Without its parameters it would be zero, and the control would report that it has no effect."""
    monkeypatch.setitem(PENALTIES, "l2", PENALTIES["l2"]._replace(additive=False))
    with pytest.raises(TypeError):
        train(drawn((0.9,), [0]), LabelMethod("l2", 2.0), Schedule(4, 2, 1e-2), 0, [0])


def test_ties_count_half():
    networks = Networks(2, 0, [0])
    with torch.no_grad():
        networks.layers[0].zero_()
    assert accuracy(networks, drawn((0.9,), [0])).tolist() == [[0.5]]


@pytest.mark.parametrize("name", UNIT_TESTS)
def test_the_oracle_passes_a_unit_test_that_erm_fails(name):
    trained, held_out = unit_test(UNIT_TESTS[name], SEEDS, 200)
    found = []
    for samples in (trained, permuted(trained.numpy(), SEEDS)):
        networks = train(samples, LabelMethod(), Schedule(500, 0, 1e-2), 0, SEEDS)
        found.append(accuracy(networks, held_out).mean().item())
    erm, oracle = found
    assert erm < 0.62 and oracle > 0.9


def test_permuted_inputs_tell_nothing_of_the_label():
    (samples,) = permuted(unit_test(UNIT_TESTS["example 2"], [0], 4000)[0].numpy(), [0])
    means = samples[..., 5:].mean((0, 2, 3))
    assert np.allclose(means, means.mean(), atol=0.03)
