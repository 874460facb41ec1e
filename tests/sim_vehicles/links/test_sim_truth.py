"""The truth log: what is written is read back, whatever happened to the writer."""

import resource
import signal
import struct
from pathlib import Path

import pytest

from sim_vehicles.links.truth import ACTED, CORRUPTED, DTYPE, DUPLICATE, LINK_UP, SAMPLED, Row, TruthLog, read_truth

ROWS: list[Row] = [
    (SAMPLED, 1, 2**32 - 1, 10, 10, 10, 0, 0),
    (ACTED, 9250, 0, 2**62, 5, -7, 0, 0),
    (LINK_UP, 3, 32, 30, 10, 29, DUPLICATE | CORRUPTED, 7),
]


def write(path: Path, rows: list[Row]) -> None:
    log = TruthLog(path)
    for row in rows:
        log.add(row)
    log.close()


def test_what_is_recorded_is_read_back(tmp_path: Path) -> None:
    write(tmp_path / "truth", ROWS * 1000)
    assert [tuple(row) for row in read_truth(tmp_path / "truth").tolist()] == ROWS * 1000


def test_a_log_from_before_there_were_networks_is_read(tmp_path: Path) -> None:
    rows = [(kind, system_id % 256, *row) for kind, system_id, *row in ROWS]
    (tmp_path / "truth").write_bytes(b"UAVTRUE2" + b"".join(struct.pack("<BBIqqqBq", *row) for row in rows))
    assert read_truth(tmp_path / "truth").tolist() == rows


def test_what_is_left_out_of_a_record_is_zero(tmp_path: Path) -> None:
    write(tmp_path / "truth", [ROWS[0][:6]])
    assert read_truth(tmp_path / "truth").tolist() == [ROWS[0]]


def test_a_flushed_batch_survives_without_close(tmp_path: Path) -> None:
    log = TruthLog(tmp_path / "truth")
    log.add(ROWS[0])
    log.flush()
    log.add(ROWS[1])
    assert read_truth(tmp_path / "truth").tolist() == ROWS[:1]
    log.close()


@pytest.mark.parametrize("kept", [0, 1, 7])
def test_a_log_cut_off_at_its_beginning_holds_nothing(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "truth"
    write(path, ROWS)
    path.write_bytes(path.read_bytes()[:kept])
    assert read_truth(path).tolist() == []
    write(path, ROWS[:1])
    assert read_truth(path).tolist() == ROWS[:1]


@pytest.mark.parametrize("cut", range(1, DTYPE.itemsize))
def test_a_record_cut_in_two_is_left_out_and_overwritten(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "truth"
    write(path, ROWS)
    path.write_bytes(path.read_bytes()[:-cut])
    assert read_truth(path).tolist() == ROWS[:2]
    write(path, ROWS[:1])
    assert read_truth(path).tolist() == ROWS[:2] + ROWS[:1]


def test_a_full_disk_loses_records_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "truth"
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        log = TruthLog(path)
        log.add(ROWS[0])
        log.flush()
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + DTYPE.itemsize + 5, limit[1]))
        for row in ROWS:  # room for one of them and a piece of the second
            log.add(row)
        log.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)
    log.add(ROWS[2])
    log.close()
    assert log.lost == 2
    assert read_truth(path).tolist() == [ROWS[0], ROWS[0], ROWS[2]]


def test_another_file_is_neither_read_nor_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("something that matters to someone")
    with pytest.raises(ValueError, match=r"notes\.txt"):
        read_truth(path)
    with pytest.raises(ValueError, match=r"notes\.txt"):
        TruthLog(path)
    assert path.read_text() == "something that matters to someone"
