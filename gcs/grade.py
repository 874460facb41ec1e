"""What a flight measured of its links, graded against the truth that the emulated links wrote down.

A round trip is that of one TIMESYNC exchange: the request's time in the down link plus the reply's in the up link. A
loop delay is the time from the sampling of the newest state used to the instant at which the set-point computed from it
acts; both are in the truth by the time_boot_ms that the messages bear.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcs.record import TickArray

FloatArray = NDArray[np.float64]
Truth = NDArray[np.void]
"""Records as sim_vehicles.truth.DTYPE lays them out; kinds 1 SAMPLED and 2 ACTED."""

_SAMPLED, _ACTED = 1, 2


def true_loop_delays_s(ticks: TickArray, truth: Truth) -> FloatArray:
    """The true loop delay of each row of ticks, in s; NaN where its set-point never acted or no state is known."""
    sampled, acted = (_instants(truth, kind) for kind in (_SAMPLED, _ACTED))
    out = np.full(len(ticks), np.nan)
    for k in np.flatnonzero(ticks["commanded"]):
        row = ticks[k]
        system_id = int(row["system_id"])
        since_ns = sampled.get((system_id, int(row["sample_boot_ms"])))
        until_ns = acted.get((system_id, int(row["key_ms"])))
        if since_ns is not None and until_ns is not None:
            out[k] = (until_ns - since_ns) * 1e-9
    return out


def _instants(truth: Truth, kind: int) -> dict[tuple[int, int], int]:
    """(System id, time_boot_ms) to the first instant with that key."""
    own = truth[truth["kind"] == kind]
    instants: dict[tuple[int, int], int] = {}
    for system_id, key, time_ns in zip(
        own["system_id"].tolist(), own["key"].tolist(), own["time_ns"].tolist(), strict=True
    ):
        instants.setdefault((system_id, key), time_ns)
    return instants


def graded(measured_s: FloatArray, true_s: FloatArray) -> dict[str, Any]:
    """How far measurements are from the truth; with no sample, the figures are None and not 0."""
    both = np.isfinite(measured_s) & np.isfinite(true_s)
    error_s = np.abs(measured_s - true_s)[both]
    if not error_s.size:
        return {"status": "unknown", "samples": 0, "error_p50_s": None, "error_p99_s": None, "error_max_s": None}
    p50, p99 = np.percentile(error_s, [50, 99]).tolist()
    return {
        "status": "measured",
        "samples": int(error_s.size),
        "error_p50_s": p50,
        "error_p99_s": p99,
        "error_max_s": float(error_s.max()),
    }
