"""The vehicles' own record of a flight, looked up one record at a time."""

from gcs.runs.grade import Truth


def instants(truth: Truth, kind: int) -> dict[tuple[int, int], int]:
    """The first instant (ns) recorded for each (system id, time_boot_ms) in the records of a kind."""
    own = truth[truth["kind"] == kind][::-1]  # reversed: the first of several records is then kept
    return {(system_id, key): time_ns for system_id, key, time_ns in own[["system_id", "key", "time_ns"]].tolist()}
