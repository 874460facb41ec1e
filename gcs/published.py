"""Records whose fields users read: in JSON files, and in what commands print with --json."""

import json
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

SCHEMA_VERSION = 1
"""`schema_version` of all JSON: it grows when a field changes its meaning or goes, not when one is added."""


def json_text(fields: Mapping[str, Any], default: Callable[[Any], Any] | None = None) -> str:
    """JSON over several lines, the schema's version first; `default` as of `json.dumps`."""
    return json.dumps({"schema_version": SCHEMA_VERSION, **fields}, indent=2, allow_nan=False, default=default)


class Published(BaseModel):
    """A frozen record. In JSON it has the fields that were set, under their names."""

    model_config = ConfigDict(frozen=True)

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return self.model_dump(mode="json", exclude_unset=True)

    def to_json(self) -> str:
        """JSON over several lines."""
        return json_text(self.to_dict())
