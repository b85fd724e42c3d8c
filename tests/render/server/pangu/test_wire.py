"""Numbers and texts on PANGU's wire: the vectors of the facts sheet."""

import numpy as np
import pytest
from tests.render.server.pangu.words import DOUBLES, FLOATS, doubles, floats

from perilune_render.server.pangu import wire


@pytest.mark.parametrize(("value", "word"), FLOATS.items())
def test_floats_are_those_of_the_facts(value, word):
    assert wire.float_bytes([value]).hex() == word
    assert wire.floats_from(bytes.fromhex(word))[0] == np.float32(value)
    assert floats(value) == word


@pytest.mark.parametrize(("value", "word"), DOUBLES.items())
def test_doubles_are_those_of_the_facts(value, word):
    assert wire.double_bytes([value]).hex() == word
    assert wire.doubles_from(bytes.fromhex(word))[0] == value
    assert doubles(value) == word


def test_texts_are_those_of_the_facts():
    assert wire.text_bytes("abc").hex() == "000461626300"
    assert wire.text_bytes("abcd").hex() == "0006616263640000"


def test_numbers_that_a_client_cannot_read_are_never_sent():
    assert wire.floats_from(wire.float_bytes([np.inf, -1e300])).tolist() == [np.finfo("f4").max, -np.finfo("f4").max]
    for wrong in (wire.float_bytes, wire.double_bytes):
        with pytest.raises(ValueError, match="sent"):
            wrong([np.nan])
