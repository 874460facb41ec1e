"""How the soak draws numbers and keys."""

import math
from typing import Any

import annotated_types
import numpy as np
from pydantic import BaseModel

Rng = np.random.Generator
Part = dict[str, Any]


def whole(model: type[BaseModel], **keys: Any) -> Part:
    """One part of a scenario. Every key of the schema must be drawn; None leaves it out."""
    unknown = model.model_fields.keys() ^ keys.keys()
    assert not unknown, f"the soak and the schema's {model.__name__} differ in the keys {sorted(unknown)}"
    return {name: value for name, value in keys.items() if value is not None}


def chance(rng: Rng, probability: float) -> bool:
    return bool(rng.random() < probability)


def between(rng: Rng, least: float, most: float) -> float:
    """Uniform, to four decimals."""
    return round(float(rng.uniform(least, most)), 4)


def spread(rng: Rng, least: float, most: float) -> float:
    """Log-uniform, to four digits."""
    return float(f"{math.exp(rng.uniform(math.log(least), math.log(most))):.4g}")


def one_of(rng: Rng, *values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def some(rng: Rng, probability: float, value: Any) -> Any:
    """The value or None. The value has been drawn in either case."""
    return value if chance(rng, probability) else None


def most_of(model: type[BaseModel], key: str) -> float:
    """The largest number that the schema accepts for a key."""
    [most] = [bound.le for bound in model.model_fields[key].metadata if isinstance(bound, annotated_types.Le)]
    assert isinstance(most, int | float)
    return float(most)
