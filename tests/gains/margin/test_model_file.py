"""The JSON model of `gcs margin`: what it means, and that any mistake in it is named in one line."""

import json
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.core.errors import BadModelError
from gains.margin.model_file import DelayModel, HeldModel, parse_model


def delays_of(text: str) -> tuple[float, Fraction, str]:
    model = parse_model(f'{{"terms": [{{"A": [[1]], "delay": {text}}}]}}')
    assert isinstance(model, DelayModel)
    [term] = model.terms
    return term.fixed_s, term.multiple, model.unknown


def test_pair_is_one_delay_called_tau() -> None:
    model = parse_model('{"A0": [[1, 2], [3, 4]], "A1": [[0, -1.5], [1e-3, 0]]}')
    assert isinstance(model, DelayModel)
    assert model.unknown == "tau"
    assert [term.multiple for term in model.terms] == [0, 1]
    assert model.terms[1].matrix.tolist() == [[0.0, -1.5], [1e-3, 0.0]]


@pytest.mark.parametrize(
    ("text", "fixed_s", "multiple", "unknown"),
    [
        ("0", 0.0, 0, ""),
        ("0.1", 0.1, 0, ""),
        ('"tau"', 0.0, 1, "tau"),
        ('"2*tau"', 0.0, 2, "tau"),
        ('" 2 * h "', 0.0, 2, "h"),
        ('"h*2"', 0.0, 2, "h"),
        ('"tau/3"', 0.0, Fraction(1, 3), "tau"),
        ('"0.1*tau"', 0.0, Fraction(1, 10), "tau"),
        ('"1.5e1*tau/2"', 0.0, Fraction(15, 2), "tau"),
        ('"0.1 + tau"', 0.1, 1, "tau"),
        ('"1e+2 + tau*1.5E+1"', 100.0, 15, "tau"),
        ('"tau + 0.5*tau"', 0.0, Fraction(3, 2), "tau"),
        ('"0*tau"', 0.0, 0, "tau"),
    ],
)
def test_delays_are_seconds_and_exact_multiples(
    text: str, fixed_s: float, multiple: int | Fraction, unknown: str
) -> None:
    assert delays_of(text) == (fixed_s, multiple, unknown)


def test_held_loop_keeps_its_matrices() -> None:
    model = parse_model('{"A": [[0, 1], [0, 0]], "B": [[0], [1]], "K": [[-1, -2]], "hold": true}')
    assert isinstance(model, HeldModel)
    assert np.array_equal(model.K, [[-1.0, -2.0]])


def test_held_loop_may_state_its_period() -> None:
    model = parse_model('{"A": [[0]], "B": [[1]], "K": [[-1]], "hold": true, "period": 0.02}')
    assert isinstance(model, HeldModel)
    assert model.period_s == 0.02


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "line 1: read nothing, wanted JSON"),
        ('{"A0": [[1]],', "line 1: read '{\"A0\": [[1]],', wanted JSON"),
        ('{"A0": [[1]],\n', "line 2: read nothing more, wanted JSON"),
        ('{"A0":\r\n [[1,,2]],\n', "line 2: read '[[1,,2]],', wanted JSON"),
        ("[]", "the model: read [], wanted an object"),
        ("{}", "read the keys none; wanted A0, A1; or terms; or A, B, K, hold; or A, B, K, hold, period"),
        ('{"A0": [[1]]}', "read the keys A0; wanted A0, A1"),
        ('{"A0": [[1]], "A1": [[1]], "A2": [[1]]}', "'A2': read an unknown key, wanted A0, A1"),
        ('{"A0": [[1]], "A0": [[1]], "A1": [[1]]}', "A0: read twice, wanted once"),
        ('{"A0": [[1, 2], [3]], "A1": [[1]]}', "A0: read rows of [1, 2] numbers, wanted rows of equal length"),
        ('{"A0": [[1, 2]], "A1": [[1]]}', "A0: read 1x2, wanted a square matrix"),
        ('{"A0": [[1]], "A1": [[1, 2], [3, 4]]}', "A1: read 2x2, wanted 1x1 to match the first matrix"),
        ('{"A0": [], "A1": [[1]]}', "A0: read [], wanted a matrix as a list of rows"),
        ('{"A0": [[]], "A1": [[1]]}', "A0: read [[]], wanted at least one number in a row"),
        ('{"A0": 3, "A1": [[1]]}', "A0: read 3, wanted a matrix as a list of rows"),
        ('{"A0": [["a"]], "A1": [[1]]}', "A0, row 1, column 1: read 'a', wanted a finite number"),
        ('{"A0": [[null]], "A1": [[1]]}', "A0, row 1, column 1: read null, wanted a finite number"),
        ('{"A0": [[true]], "A1": [[1]]}', "A0, row 1, column 1: read true, wanted a finite number"),
        ('{"A0": [[1]], "A1": [[NaN]]}', "A1, row 1, column 1: read NaN, wanted a finite number"),
        ('{"A0": [[1, 1], [1, -Infinity]], "A1": [[1]]}', "A0, row 2, column 2: read a number beyond 1e308, wanted"),
        ('{"A0": [[1e999]], "A1": [[1]]}', "A0, row 1, column 1: read a number beyond 1e308, wanted a finite number"),
        ('{"A0": [[1e300]], "A1": [[1]]}', "A0, row 1, column 1: read 1e+300, wanted a finite number, up to 1e+30"),
        ('{"terms": [{"A": [[1]], "delay": "1e31 + tau"}]}', "term 1, delay: read 1e+31, wanted a number of seconds"),
        ('{"terms": []}', "terms: read [], wanted a list of"),
        ('{"terms": [{"A": [[1]]}]}', "term 1: read 'A', wanted the keys A, delay"),
        ('{"terms": [{"A": [[1]], "delay": -0.1}]}', "term 1, delay: read -0.1, wanted a number of seconds >= 0"),
        ('{"terms": [{"A": [[1]], "delay": "-tau"}]}', "term 1, delay: read '-tau', wanted a number of seconds"),
        ('{"terms": [{"A": [[1]], "delay": "tau/0"}]}', "term 1, delay: read 'tau/0', wanted a number of seconds"),
        ('{"terms": [{"A": [[1]], "delay": "0.1"}]}', "term 1, delay: read '0.1', wanted a number of seconds"),
        ('{"terms": [{"A": [[1]], "delay": "tau*h"}]}', "term 1, delay: read 'tau*h', wanted a number of seconds"),
        (
            '{"terms": [{"A": [[1]], "delay": "tau"}, {"A": [[1]], "delay": "h"}]}',
            "term 2, delay: read 'h', wanted multiples of one unknown, which is 'tau'",
        ),
        ('{"A": [[1]], "B": [[1]], "K": [[1]], "hold": false}', "hold: read false, wanted true"),
        ('{"A": [[1]], "B": [[1]], "K": [[1, 2]], "hold": true}', "K: read 1x2, wanted 1x1: u = K x"),
        ('{"A": [[1]], "B": [[1], [2]], "K": [[1]], "hold": true}', "B: read 2x1, wanted 1 rows to match A"),
        (
            '{"A": [[1]], "B": [[1]], "K": [[1]], "hold": true, "period": 0}',
            "period: read 0, wanted a positive number of seconds",
        ),
        (
            '{"A": [[1]], "B": [[1]], "K": [[1]], "hold": true, "period": "tau"}',
            "period: read 'tau', wanted a positive number of seconds",
        ),
        ('{"A0": [[5e-324]], "A1": [[1]]}', "A0, row 1, column 1: read 5e-324, wanted a finite number, 0 or at least"),
        ('{"terms": [{"A": [[1]], "delay": "1e-90*tau"}]}', "term 1, delay: read '1e-90*tau', wanted a number of"),
        ("[" * 100_000, "read lists within lists too deep to follow"),
        ('{"A0": [[1' + "0" * 5000 + ']], "A1": [[1]]}', "wanted finite numbers"),
        ('{"A0": [[1' + "0" * 400 + ']], "A1": [[1]]}', "A0, row 1, column 1: read a number of 401 digits"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(text: str, line: str) -> None:
    with pytest.raises(BadModelError) as caught:
        parse_model(text)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["A0", "A1", "A", "B", "K", "hold", "terms", "delay"]), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(json_values)
def test_any_json_is_a_model_or_a_named_mistake(value: object) -> None:
    try:
        mistake = ""
        parse_model(json.dumps(value))
    except BadModelError as error:
        mistake = str(error)
    # the one line must say what would have been right
    assert mistake == "" or "wanted" in mistake


@given(st.text(max_size=40))
def test_any_text_is_a_model_or_a_named_mistake(text: str) -> None:
    with pytest.raises(BadModelError, match="wanted"):
        parse_model(text)
