"""HTML pages that need nothing else: templates of this package, figures inside."""

import base64
from functools import partial
from pathlib import Path
from typing import Any

from gcs.views.console import ms_text, number_text


def rendered(template: str, **values: Any) -> str:
    """A page of this package, with the filters `ms`, `number` and `percent`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=PackageLoader("gcs.views", "."), autoescape=select_autoescape(["j2"]), undefined=StrictUndefined
    )
    environment.filters |= {
        "ms": partial(ms_text, form=".2f"),
        "number": number_text,
        "percent": percent_text,
    }
    return environment.get_template(template).render(**values)


def percent_text(value: float | None, form: str = "+.3%") -> str:
    return number_text(value, form)


def data_uri(png: Path) -> str:
    """A picture as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png.read_bytes()).decode("ascii")
