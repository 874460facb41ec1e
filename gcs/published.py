"""Base class of the records that users read as JSON, in files and from commands with --json."""

import json
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

SCHEMA_VERSION = 1
"""`schema_version` of all JSON. It grows when a field is removed or changes its meaning, not when one is added."""


def json_text(fields: Mapping[str, Any], default: Callable[[Any], Any] | None = None) -> str:
    """Indented JSON that begins with the schema version; `default` is passed to `json.dumps`."""
    return json.dumps({"schema_version": SCHEMA_VERSION, **fields}, indent=2, allow_nan=False, default=default)


class Published(BaseModel):
    """A frozen record. Its JSON contains only the fields that were set, under their own names."""

    model_config = ConfigDict(frozen=True)

    def to_dict(self) -> dict[str, Any]:
        """The record as plain types, ready for JSON."""
        return self.model_dump(mode="json", exclude_unset=True)

    def to_json(self) -> str:
        """The record as indented JSON."""
        return json_text(self.to_dict())
