"""YAML 1.2 of configuration files and --set: scalars of the core schema, no forms of YAML 1.1."""

import math
import time

import pytest
import yaml as yaml_1_1
from hypothesis import given, settings
from hypothesis import strategies as st

from perilune_shared.config.resolve import parse_setting
from perilune_shared.config.yaml_text import parse_yaml, to_yaml_text
from perilune_shared.errors import UserError

# Specification 1.2.2, section 10.3.2, and values that version 1.1 reads differently.
SCALARS = [
    ("1:30", "1:30"),
    ("012", 12),
    ("0o14", 12),
    ("0x1F", 31),
    ("0b1", "0b1"),
    ("1_000", "1_000"),
    ("off", "off"),
    ("yes", "yes"),
    ("n", "n"),
    ("True", True),
    ("false", False),
    ("~", None),
    ("null", None),
    ("", None),
    ("1e-4", 1e-4),
    ("2E5", 2e5),
    ("1.5e3", 1500.0),
    (".5", 0.5),
    ("1.", 1.0),
    ("+3", 3),
    ("-.inf", -math.inf),
    ("2024-01-17", "2024-01-17"),
    ("<<", "<<"),
    ("'12'", "12"),
    ('"true"', "true"),
]


@pytest.mark.parametrize(("text", "value"), SCALARS)
def test_scalars_of_the_core_schema(text, value):
    for found in (
        parse_yaml(f"a: {text}", "")["a"],
        parse_yaml(f"{{b: {text}, c: 1}}", "")["b"],
        parse_setting(f"detect.a={text}")[1],
    ):
        assert found == value and type(found) is type(value)


def test_nan_is_a_number_of_the_core_schema():
    assert math.isnan(parse_yaml(".nan", ""))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: 1\nb: 2\na: 3", "got the key 'a' twice at line 3, expected each key once"),
        ("{a: {b: 1, b: 1}}", "the key 'b' twice"),
        ("a: 1\n'a': 3", "the key 'a' twice"),
        ("a: &x [1]\nb: *x", "an alias or anchor (x)"),
        ("a: &x 1", "an alias or anchor"),
        ("*x", "an alias or anchor"),
        ("!!python/object:os.system {}", "a tag"),
        ("a: !!str 1", "a tag"),
        ("!local [1]", "a tag"),
        ("{!!int a: 1}", "a tag"),
        ("%YAML 1.1\n---\na: 012", "a directive"),
        ("%TAG ! tag:x,2000:\n---\na: 1", "a directive"),
        ("a: 1\n---\na: 2", "a second document"),
        ("? [a]\n: 1", "a key that is not text"),
        ("? {a: 1}\n: 1", "a key that is not text"),
        ("{low:5,high:9}", "'low:5' without a value at line 1, expected a space after the colon: {low: 5}"),
        ("a: {b: 1", "not YAML"),
        ("a: b: c", "not YAML"),
        ("a:\n\tb: 1", "not YAML"),
        ("a: @x", "not YAML"),
        ("\x00", "not YAML"),
        ("\ud800", "not YAML"),
        ("9" * 5000, "not YAML"),
        ("[" * 90_000, "more than 20 levels"),
        ("{a: " * 1000, "more than 20 levels"),
        ("- " * 1000, "more than 20 levels"),
        ("a" * 100_001, "100001 characters"),
    ],
)
def test_refused_yaml_gives_one_line(text, expected):
    start = time.process_time()
    with pytest.raises(UserError) as caught:
        parse_yaml(text, "c.yaml")
    message = str(caught.value)
    assert message.startswith("c.yaml: ") and expected in message and "\n" not in message and len(message) < 400
    assert time.process_time() - start < 10


@settings(max_examples=50)
@given(st.text(alphabet="ab:{}[],-&*!|>'\"%@`#?~. 01\n\t\\", max_size=60) | st.text(max_size=30))
def test_any_text_gives_plain_data_or_a_user_error(text):
    try:
        data = parse_yaml(text, "")
    except UserError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(data, None | dict | list | str | bool | int | float)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**15), 10**15) | st.floats(allow_nan=False) | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.from_regex(r"[a-z_]{1,9}", fullmatch=True), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=50)
@given(st.dictionaries(st.from_regex(r"[a-z_]{1,9}", fullmatch=True), PLAIN, max_size=3))
def test_written_yaml_reads_back(data):
    assert parse_yaml(to_yaml_text(data), "") == data or data == {}


def test_readers_of_version_1_1_read_the_same_text():
    texts = ["off", "1:30", "012", "yes", "2024-01-17", "1e5", "=", "<<", "a: b", "y", "null", "plain words", "other"]
    data = {"texts": texts, "nested": [{"split": "train", "path": "images/*.parquet"}]}
    assert yaml_1_1.safe_load(to_yaml_text(data)) == data
