"""Canonical JSON and digests. Keys and ids depend on these bytes, so they must never change."""

import hashlib
import json
import math
from collections import OrderedDict
from enum import IntEnum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.store import KeyRecord, canonical_json, content_digest, digest, file_digest
from irlcli.store.manifest import Output

SCALARS = st.none() | st.booleans() | st.integers() | st.text()
SCALARS |= st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20
)


def typed(value):
    """``value`` with its types: True == 1 == 1.0 in Python, but they differ in a key."""
    if isinstance(value, dict):
        return {key: typed(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [typed(item) for item in value]
    return (type(value).__name__, repr(value))


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({}, b"{}"),
        ([], b"[]"),
        ("", b'""'),
        (None, b"null"),
        (True, b"true"),
        (1, b"1"),
        (1.0, b"1.0"),
        (-0.0, b"-0.0"),
        (0.1, b"0.1"),
        (1e-5, b"1e-05"),
        (1e16, b"1e+16"),
        (5e-324, b"5e-324"),
        (2**70, b"1180591620717411303424"),
        ((1, 2), b"[1,2]"),
        ({"b": 1, "a": [True, None]}, b'{"a":[true,null],"b":1}'),
        ({"B": 1, "a": 2}, b'{"B":1,"a":2}'),
        ('é\n"\\/', b'"\\u00e9\\n\\"\\\\/"'),
        ("\U0001f600", b'"\\ud83d\\ude00"'),
        ("\ud800", b'"\\ud800"'),
    ],
)
def test_golden_bytes(value, expected):
    assert canonical_json(value) == expected
    assert digest(value) == hashlib.sha256(expected).hexdigest()


def test_golden_digests():
    """A change of these literals would orphan every existing artefact."""
    assert digest({}) == "44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a"
    record = KeyRecord("transfer", 1, {"seed": 0, "lr": 1e-5}, {"reward": "0" * 64})
    text = (
        '{"inputs":{"reward":"' + "0" * 64 + '"},"parameters":{"lr":1e-05,"seed":0},'
        '"schema":1,"stage":"transfer","stage_version":1}'
    )
    assert record.key == hashlib.sha256(text.encode()).hexdigest()
    assert record.key == "8321a6dda436c2f3245c509de5505429adabfc5aeddc3e68f3957936aa6569c2"


@given(VALUES)
def test_round_trip_keeps_value_and_types(value):
    data = canonical_json(value)
    assert typed(json.loads(data)) == typed(value)
    assert canonical_json(json.loads(data)) == data
    assert data.isascii()


@given(st.dictionaries(st.text(), SCALARS), st.randoms(use_true_random=False))
def test_key_order_never_matters(value, random):
    items = list(value.items())
    random.shuffle(items)
    assert canonical_json({"x": dict(items)}) == canonical_json({"x": value})


@given(VALUES, VALUES)
def test_equal_bytes_mean_equal_values(one, other):
    assert (canonical_json(one) == canonical_json(other)) == (typed(one) == typed(other))


def test_bool_int_float_and_text_are_distinct():
    forms = [True, 1, 1.0, "1", [1], {"1": 1}, False, 0, 0.0, None, "", "null"]
    assert len({digest(v) for v in forms}) == len(forms)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: [0, x], lambda x: {"a": {"b": (x,)}}])
def test_numbers_that_equal_nothing_are_refused(bad, wrap):
    with pytest.raises(ValueError, match="cannot be part of a key"):
        canonical_json(wrap(bad))


def test_refusal_names_the_place():
    with pytest.raises(ValueError, match=r"\$\.airl\.rates\[1\] is nan"):
        canonical_json({"airl": {"rates": [0.1, math.nan]}})


@pytest.mark.parametrize("key", [1, 1.5, True, None, ("a",), b"a"])
def test_keys_other_than_strings_are_refused(key):
    """json.dumps would print 1 and True as the strings "1" and "true"."""
    with pytest.raises(TypeError, match="not a string"):
        canonical_json({"outer": {key: 0}})


class Colour(IntEnum):
    RED = 1


class Text(str):
    pass


@pytest.mark.parametrize(
    "value", [b"x", {1, 2}, object(), 1j, Colour.RED, Text("x"), OrderedDict(a=1), range(3)]
)
def test_types_without_a_canonical_encoding_are_refused(value):
    with pytest.raises(TypeError, match="no canonical encoding"):
        canonical_json([value])


def test_numpy_numbers_are_refused():
    """np.float64 is a float to isinstance, but keys must not depend on how numpy prints it."""
    numpy = pytest.importorskip("numpy")
    for value in (numpy.float64(1), numpy.int64(1), numpy.bool_(True)):
        with pytest.raises(TypeError):
            canonical_json(value)


@given(st.binary(max_size=4096))
def test_file_digest_is_sha256(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "digested"
    path.write_bytes(data)
    assert file_digest(path) == hashlib.sha256(data).hexdigest()


def test_file_digest_of_more_than_one_chunk(tmp_path):
    data = bytes(range(256)) * 5000  # 1.28 MB, read in pieces of 1 MiB
    (tmp_path / "f").write_bytes(data)
    assert file_digest(tmp_path / "f") == hashlib.sha256(data).hexdigest()


def test_content_digest_ignores_order_but_nothing_else():
    a, b = Output("a", 1, "0" * 64), Output("b", 1, "1" * 64)
    assert content_digest([a, b]) == content_digest([b, a])
    others = [[a], [b], [a._replace(path="b"), b._replace(path="a")], [a._replace(size=2), b]]
    assert len({content_digest(o) for o in [[a, b], *others]}) == 5


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "evaluate"},
        {"stage_version": 2},
        {"parameters": {"seed": 1}},
        {"parameters": {"seed": 0.0}},
        {"parameters": {"seed": False}},
        {"parameters": {}},
        {"inputs": {"reward": "1" * 64}},
        {"inputs": {"policy": "0" * 64}},
        {"inputs": {}},
    ],
)
def test_every_part_of_a_record_changes_its_key(change):
    record = KeyRecord("transfer", 1, {"seed": 0}, {"reward": "0" * 64})
    assert record._replace(**change).key != record.key
