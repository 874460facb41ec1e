"""Records whose fields users read: in JSON files, and in what commands print with --json."""

import json
from typing import Any

from pydantic import BaseModel, ConfigDict


class Published(BaseModel):
    """A frozen record. In JSON it has the fields that were set, under their names."""

    model_config = ConfigDict(frozen=True)

    def to_dict(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return self.model_dump(mode="json", exclude_unset=True)

    def to_json(self) -> str:
        """JSON over several lines."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)
