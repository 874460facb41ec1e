"""What a summary says about the user's own code."""

from collections.abc import Sequence
from typing import Any

from gcs.control.own_law import BAD, BUDGET_SHARE, CALLS, LAW, OVER
from gcs.control.tick import Event
from gcs.plan.design import Design
from gcs.plan.own_law import code_records
from gcs.runs.refusals import counts_of
from gcs.runs.summary_record import LawRecord
from scenarios.schema import Scenario


def own_code(scenario: Scenario, design: Design, events: Sequence[Event]) -> dict[str, Any]:
    """Fields of a summary; empty for a scenario that names no code."""
    if not scenario.code:
        return {}
    fields: dict[str, Any] = {"code": code_records(scenario)}
    if design.margin_unknown:
        fields["margin_unknown"] = design.margin_unknown
    if counts := counts_of(events, LAW):
        fields["law"] = LawRecord(
            calls=counts[CALLS],
            unusable=counts[BAD],
            over_budget=counts.get(OVER),
            budget_s=BUDGET_SHARE / scenario.rates.control_hz,
        )
    return fields
