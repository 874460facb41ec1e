"""Reader of JSON models of linear loops with delays, as for `gcs margin`, in one of these forms::

    {"A0": [[..]], "A1": [[..]]}                                   x'(t) = A0 x(t) + A1 x(t - tau)
    {"terms": [{"A": [[..]], "delay": 0.1}, {"A": [[..]], "delay": "2*tau"}, ...]}   x'(t) = sum A x(t - delay)
    {"A": [[..]], "B": [[..]], "K": [[..]], "hold": true}          x' = A x + B u, u = K x sampled and held: any period
    {"A": [[..]], "B": [[..]], "K": [[..]], "hold": true, "period": 0.02}      the same every 0.02 s, tau late
    {"A": [[..]], "B": [[..]], "C": [[..]]}                        x' = A x + B u, y = C x, u(t) = -y(t - tau)
    {"num": [..], "den": [..]}                                     the same of y = num/den u, highest power first

A delay is a number of seconds, a multiple of one unknown ("tau", "2*tau", "tau/3", "1.5*tau"), or a sum of both
("0.1 + tau"). Multiples are exact decimal fractions: "0.1*tau" is exactly a tenth.
"""

import gc
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from math import isfinite, isnan
from typing import Any, NoReturn

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.margin.open_loop import feedback_of_matrices, feedback_of_polynomials

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_MULTIPLE = re.compile(
    rf"(?:(?P<before>{_NUMBER})\s*\*\s*)?(?P<name>[A-Za-z_]\w*)"
    rf"(?:\s*\*\s*(?P<after>{_NUMBER}))?(?:\s*/\s*(?P<divisor>{_NUMBER}))?"
)
_PLAIN = re.compile(_NUMBER)
# a plus sign that is not part of an exponent
_PLUS = re.compile(r"(?<![0-9.][eE])\+")
_FORMS = (
    ("A0", "A1"),
    ("terms",),
    ("A", "B", "K", "hold"),
    ("A", "B", "K", "hold", "period"),
    ("A", "B", "C"),
    ("A", "B", "C", "D"),
    ("num", "den"),
)
_DELAY_WANTED = 'a number of seconds >= 0 or a multiple of the unknown, such as "tau" or "2*tau"'
# squares and products of the largest entries do not overflow; the square of a product of two least ones is still normal
_LARGEST, _LEAST = 1e30, 1e-60
# strings that stand for runs of zeros, longest first; a zero byte does not occur in hand-written models
_ZEROS = {"\0 512 zeros": 512, "\0 64 zeros": 64, "\0 8 zeros": 8}
# longer texts are truncated in messages
_SHOWN = 60


@dataclass(frozen=True)
class Term:
    """The term A x(t - fixed_s - multiple * unknown); `matrix` is A (n, n) in 1/s."""

    matrix: FloatArray
    fixed_s: float
    multiple: Fraction


@dataclass(frozen=True)
class DelayModel:
    """x'(t) = sum of the terms; `unknown` is the name of the unknown delay, empty if all delays are numbers."""

    terms: tuple[Term, ...]
    unknown: str


@dataclass(frozen=True)
class HeldModel:
    """x' = A x + B u with u = K x sampled and held; A (n, n), B (n, p), K (p, n).

    The unknown is the delay of u if the period is given, otherwise the period.
    """

    A: FloatArray
    B: FloatArray
    K: FloatArray
    period_s: float | None = None


def parse_model(text: str) -> DelayModel | HeldModel:
    """The model that `text` describes.

    BadModelError names in one line the key, what was read and what was wanted.

    >>> model = parse_model('{"terms": [{"A": [[-1]], "delay": "0.1 + 2*tau"}]}')
    >>> model.unknown, model.terms[0].fixed_s, model.terms[0].multiple
    ('tau', 0.1, Fraction(2, 1))
    """
    if not isinstance(text, str):
        raise BadModelError(f"the model: read {type(text).__name__}, wanted JSON as a string")
    data = _parsed(text)
    if not isinstance(data, dict):
        _bad("the model", data, 'an object, as {"A0": [[..]], "A1": [[..]]}')
    keys = _form(data)
    if keys == ("terms",):
        return _terms_model(data["terms"])
    if keys == ("A0", "A1"):
        now = _square("A0", data["A0"])
        return _pair(now, _square("A1", data["A1"], size=len(now)))
    if keys == ("num", "den"):
        return _pair(*feedback_of_polynomials(*(_polynomial(key, data[key]) for key in keys)))
    if "C" in keys:
        return _pair(*feedback_of_matrices(*(_matrix(key, data[key]) for key in keys)))
    return _held_model(data)


def with_short_zeros(text: str) -> str:
    """The text of a model, or part of it, with each run of zeros replaced by one string.

    `parse_model` reads both. With many states, reading zeros would take most of its time.
    """
    for name, count in _ZEROS.items():
        for zero in (" 0.0,", " 0,"):
            text = text.replace(count * zero, f" {json.dumps(name)},")
    return text


def _pair(now: FloatArray, late: FloatArray) -> DelayModel:
    return DelayModel((Term(now, 0.0, Fraction(0)), Term(late, 0.0, Fraction(1))), "tau")


def _polynomial(key: str, value: Any) -> FloatArray:
    """Coefficients as a matrix of one row; MATLAB writes them so."""
    if not isinstance(value, list) or not value:
        _bad(key, value, "coefficients as a list, [1, 2, 3]")
    return _matrix(key, value if isinstance(value[0], list) else [value])


def _parsed(text: str) -> Any:
    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in items]
        for key in keys:
            if keys.count(key) > 1:
                raise BadModelError(f"{key}: read twice, wanted once")
        return dict(items)

    # the garbage collector would scan the rows over and over in vain: numbers form no cycles
    collecting = gc.isenabled()
    gc.disable()
    try:
        return json.loads(with_short_zeros(text), object_pairs_hook=pairs)
    except json.JSONDecodeError as error:
        line = text.split("\n")[error.lineno - 1].strip()
        read = f"read {_shown(line)}" if line else "read nothing more" if text.strip() else "read nothing"
        raise BadModelError(f"line {error.lineno}: {read}, wanted JSON ({error.msg})") from None
    except RecursionError:
        raise BadModelError("read lists within lists too deep to follow, wanted a model") from None
    except BadModelError:
        raise
    # Python refuses to convert numbers of thousands of digits
    except ValueError as error:
        raise BadModelError(f"{error}; wanted finite numbers") from None
    finally:
        if collecting:
            gc.enable()


def _form(data: dict[str, Any]) -> tuple[str, ...]:
    """The keys of the form that matches the data exactly."""
    known = {key for form in _FORMS for key in form}
    for key in data:
        if key not in known:
            raise BadModelError(f"{_shown(key)}: read an unknown key, wanted {_forms()}")
    for form in _FORMS:
        if set(form) == set(data):
            return form
    read = ", ".join(data) or "none"
    raise BadModelError(f"read the keys {read}; wanted {_forms()}")


def _forms() -> str:
    return "; or ".join(", ".join(form) for form in _FORMS)


def _terms_model(terms: Any) -> DelayModel:
    if not isinstance(terms, list) or not terms:
        _bad("terms", terms, 'a list of {"A": [[..]], "delay": ..}')
    read: list[Term] = []
    unknown = ""
    for i, term in enumerate(terms):
        where = f"term {i + 1}"
        if not isinstance(term, dict) or set(term) != {"A", "delay"}:
            _bad(where, ", ".join(term) if isinstance(term, dict) else term, "the keys A, delay")
        matrix = _square(f"{where}, A", term["A"], size=len(read[0].matrix) if read else None)
        fixed_s, multiple, name = _delay(f"{where}, delay", term["delay"])
        if name and unknown and name != unknown:
            _bad(f"{where}, delay", term["delay"], f"multiples of one unknown, which is {unknown!r}")
        unknown = unknown or name
        read.append(Term(matrix, fixed_s, multiple))
    return DelayModel(tuple(read), unknown)


def _held_model(data: dict[str, Any]) -> HeldModel:
    if data["hold"] is not True:
        _bad("hold", data["hold"], "true: u = K x sampled and held")
    A = _square("A", data["A"])
    B = _matrix("B", data["B"])
    if len(B) != len(A):
        raise BadModelError(f"B: read {_size(B)}, wanted {len(A)} rows to match A")
    K = _matrix("K", data["K"])
    if K.shape != B.shape[::-1]:
        raise BadModelError(f"K: read {_size(K)}, wanted {B.shape[1]}x{len(A)}: u = K x")
    period_s = None
    if "period" in data:
        period_s = _finite("period", data["period"], "a positive number of seconds")
        if not period_s > 0.0:
            _bad("period", data["period"], "a positive number of seconds")
    return HeldModel(A, B, K, period_s)


def _square(key: str, value: Any, size: int | None = None) -> FloatArray:
    matrix = _matrix(key, value)
    if matrix.shape[0] != matrix.shape[1]:
        raise BadModelError(f"{key}: read {_size(matrix)}, wanted a square matrix")
    if size is not None and len(matrix) != size:
        raise BadModelError(f"{key}: read {_size(matrix)}, wanted {size}x{size} to match the first matrix")
    return matrix


def _matrix(key: str, value: Any) -> FloatArray:
    if not isinstance(value, list) or not value or not all(isinstance(row, list) for row in value):
        _bad(key, value, "a matrix as a list of rows, [[1, 2], [3, 4]]")
    rows = [_written_out(row) for row in value]
    lengths = {length for *_, length in rows}
    if lengths == {0}:
        _bad(key, value, "at least one number in a row")
    if len(lengths) > 1:
        raise BadModelError(f"{key}: read rows of {sorted(lengths)} numbers, wanted rows of equal length")
    [length] = lengths
    entries = [entry for _, written, _ in rows for entry in written]
    if {int, float}.issuperset(map(type, entries)):
        with suppress(OverflowError):
            numbers = np.array(entries, dtype=np.float64)
            size = np.abs(numbers)
            if np.all((size <= _LARGEST) & ((size >= _LEAST) | (size == 0.0))):
                matrix = np.zeros(len(rows) * length)
                matrix[[i * length + place for i, (places, *_) in enumerate(rows) for place in places]] = numbers
                return matrix.reshape(len(rows), length)
    # some entry is invalid: find it
    for i, (places, written, _) in enumerate(rows):
        for j, entry in zip(places, written, strict=True):
            _finite(f"{key}, row {i + 1}, column {j + 1}", entry, "a finite number")
    raise AssertionError("every entry is a finite number")


def _written_out(row: list[Any]) -> tuple[Sequence[int], list[Any], int]:
    """The positions and values of the entries of a row that are written out, and the length of the row."""
    if str not in set(map(type, row)):
        return range(len(row)), row, len(row)
    places: list[int] = []
    written: list[Any] = []
    place = 0
    for entry in row:
        count = _ZEROS.get(entry, 0) if isinstance(entry, str) else 0
        if not count:
            places.append(place)
            written.append(entry)
        place += count or 1
    return places, written, place


def _finite(key: str, value: Any, wanted: str) -> float:
    # True is an int in Python, but not a number in a model
    if isinstance(value, bool) or not isinstance(value, int | float):
        _bad(key, value, wanted)
    try:
        number = float(value)
    except OverflowError:
        raise BadModelError(f"{key}: read a number of {len(str(value))} digits, wanted {wanted}") from None
    if not isfinite(number):
        # Python reads NaN and Infinity, which are not JSON, and 1e999 as Infinity
        read = "NaN" if isnan(number) else "a number beyond 1e308"
        raise BadModelError(f"{key}: read {read}, wanted {wanted}")
    if abs(number) > _LARGEST:
        _bad(key, value, f"{wanted}, up to {_LARGEST:g}")
    if 0.0 < abs(number) < _LEAST:
        _bad(key, value, f"{wanted}, 0 or at least {_LEAST:g} in size")
    return number


def _delay(key: str, value: Any) -> tuple[float, Fraction, str]:
    """Seconds, multiple, and the name of the unknown (empty if there is none)."""
    if not isinstance(value, str):
        number = _finite(key, value, _DELAY_WANTED)
        if number < 0.0:
            _bad(key, value, _DELAY_WANTED)
        return number, Fraction(0), ""
    fixed_s, multiple, unknown = 0.0, Fraction(0), ""
    for part in (piece.strip() for piece in _PLUS.split(value)):
        match = _MULTIPLE.fullmatch(part)
        if match is None:
            if not _PLAIN.fullmatch(part) or part == value.strip():
                _bad(key, value, _DELAY_WANTED)
            fixed_s += float(part)
            continue
        if unknown and match["name"] != unknown:
            _bad(key, value, f"multiples of one unknown, which is {unknown!r}")
        unknown = match["name"]
        divisor = Fraction(match["divisor"] or 1)
        part_of_it = Fraction(match["before"] or 1) * Fraction(match["after"] or 1)
        if divisor == 0 or (part_of_it and not _LEAST <= part_of_it / divisor <= _LARGEST):
            _bad(key, value, _DELAY_WANTED)
        multiple += part_of_it / divisor
    return _finite(key, fixed_s, _DELAY_WANTED), multiple, unknown


def _size(matrix: FloatArray) -> str:
    return f"{matrix.shape[0]}x{matrix.shape[1]}"


def _bad(key: str, value: Any, wanted: str) -> NoReturn:
    raise BadModelError(f"{key}: read {_shown(value)}, wanted {wanted}")


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    text = repr(text) if isinstance(value, str) else text
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
