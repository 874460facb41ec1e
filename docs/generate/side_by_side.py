"""Figures that compare this station with other tools, and one worker with many."""

from docs.generate.blocks import table
from docs.generate.runner import Runner

PEERS = "gcs bench scenarios/triangle5.toml --peers"
CLUSTER = "gcs bench scenarios/chain3.toml --cluster 10000 --seconds 1"
_CORES, _EFFICIENCY, _MAP = 1000, 0.9, 100_000


def peers(runner: Runner) -> str:
    """A row for each figure that is compared, and the peers that were skipped."""
    found = runner.json(PEERS)
    rows = [
        (
            row["peer"],
            row["work"],
            row["unit"],
            *("" if row[name] is None else f"{row[name]:.3g}" for name in ("ours", "theirs", "ratio")),
        )
        for row in found["rows"]
    ]
    head = ("peer", "work", "unit", "ours", "theirs", "theirs / ours")
    lines = [f"{skipped['peer']}: {skipped['why']}." for skipped in found["skipped"]]
    return "\n\n".join([table(head, rows), *lines, f"Load of the machine: {found['load_average']:.1f}."])


def tick_ratio(runner: Runner) -> str:
    """A ratio that shows on any machine how fast the station is."""
    found = runner.json("gcs bench scenarios/triangle5.toml --vehicles 250")
    return (
        f"A whole station tick of {found['vehicles']} vehicles takes **{found['tick_over_parse']:.1f} times** as long "
        "as pymavlink takes to parse their LOCAL_POSITION_NED alone."
    )


def cluster(runner: Runner) -> str:
    """What a map costs on Dask, and what that means for many cores."""
    found = runner.json(CLUSTER)
    trial_s, central_s, overhead_s = found["trial_s"], found["central_s"], max(0.0, found["worker_overhead_s"])
    rows = [
        ("efficiency", f"{found['efficiency']:.2f} with {found['workers']} workers, {found['trials']:,} trials"),
        ("a trial", f"{trial_s:.3f} s for a flight of {found['seconds']:g} s"),
        ("its worker beside the flight", f"{1e3 * overhead_s:.2f} ms"),
        ("scheduler and client, in one process", f"{1e3 * central_s:.2f} ms"),
        ("sent there, sent back", f"{found['trial_bytes']:.0f} bytes, {found['outcome_bytes']:.0f} bytes"),
    ]
    least_s = _EFFICIENCY * _CORES * central_s
    traffic = (found["trial_bytes"] + found["outcome_bytes"]) / central_s
    many = min(1.0, trial_s / max(trial_s + overhead_s, _CORES * central_s))
    return (
        f"{table(('a map on Dask', 'measured'), rows)}\n\n"
        f"On paper, for {_CORES:,} cores: scheduler and client pass on {1.0 / central_s:.0f} trials a second, "
        f"{traffic / 1e6:.1f} MB/s. They keep {found['cores_served']:.0f} cores busy with trials of this length, so "
        f"{_CORES:,} cores would reach an efficiency of {many:.2f}, and a map of {_MAP:,} trials takes at least "
        f"{_MAP * central_s:.0f} s on any number of cores. For an efficiency of {_EFFICIENCY:g} a trial must take "
        f"{least_s:.2f} s or more."
    )
