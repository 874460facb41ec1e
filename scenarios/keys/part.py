"""Building blocks of every part of a scenario: the base class, and numbers with bounds.

Numbers are bounded where the messages (single precision) and the clocks (nanoseconds) can still tell them apart.
"""

from typing import Annotated, Literal, LiteralString

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import PydanticCustomError

from scenarios.networks import LARGEST_ID, MOST_IN_NETWORK, wire_id

MOST = 1e6
Number = Annotated[float, Field(ge=-MOST, le=MOST)]
Position = tuple[Number, Number]
Speed = Annotated[float, Field(ge=-1e4, le=1e4)]
Velocity = tuple[Speed, Speed]
Positive = Annotated[float, Field(gt=0, le=MOST)]
NotNegative = Annotated[float, Field(ge=0, le=MOST)]
Factor = Annotated[float, Field(ge=1, le=1000)]
Headroom = Annotated[float, Field(ge=-1000, lt=1)]
Rate = Annotated[float, Field(ge=1, le=500)]
Probability = Annotated[float, Field(ge=0, le=1)]
Flavour = Literal["ardupilot", "px4"]
Fault = tuple[str, object, str]
"""A fault of a scenario: its key, what was read, and what was wanted."""
HELD_SHARE = 0.99
"""With `control.execute_at`: the fraction of set-points that arrive before they are due."""
PREDICTION_MAX_S = 10.0
"""Longest loop delay that the station predicts over."""


def _in_a_network(system_id: int) -> int:
    if not 1 <= wire_id(system_id) <= MOST_IN_NETWORK:
        raise PydanticCustomError("system_id", "system_id")
    return system_id


SystemId = Annotated[int, Field(ge=1, le=LARGEST_ID), AfterValidator(_in_a_network)]


def one_fault(kind: LiteralString, **context: float) -> WrapValidator:
    """One fault for a key of several types, where pydantic reports one per type. `scenarios.places` words it."""

    def validated(value: object, validate: ValidatorFunctionWrapHandler) -> object:
        try:
            return validate(value)
        except ValidationError as error:
            raise PydanticCustomError(kind, kind, context) from error

    return WrapValidator(validated)


Prediction = Annotated[
    Literal["off", "measured"] | Annotated[float, Field(gt=0, le=PREDICTION_MAX_S)],
    one_fault("prediction", most=PREDICTION_MAX_S),
]


class Part(BaseModel):
    """Base of every part of a scenario: unknown keys, wrong types, NaN and infinities are refused.

    The docstring under a key is its description in `scenario.schema.json` and in the reference of the documentation.
    """

    # pydantic's use_attribute_docstrings would read the sources at each start, which takes longer than all the rest of
    # the schema; docs.generate.keys does so when it is needed
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
