"""Key files: what is a key, who may read it, and that it does not leak."""

import hashlib
import os
import pickle
import stat
import subprocess
import sys
import traceback
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.signing.keys import Key, KeyFileError, make_key, read_key
from scenarios.signing.stamps import Stamps, open_stamps
from tests.support.paths import SCENARIOS
from tests.support.processes import gcs

SECRET = bytes(range(200, 232))


def a_file(folder: Path, data: bytes, mode: int = 0o600) -> Path:
    file = folder / "secret.key"
    file.write_bytes(data)
    file.chmod(mode)
    return file


def test_three_forms_of_a_key_are_read(tmp_path: Path) -> None:
    forms = {
        SECRET: SECRET,
        SECRET.hex().encode() + b"\n": SECRET,
        SECRET.hex().upper().encode(): SECRET,
        b"correct horse battery\n": hashlib.sha256(b"correct horse battery").digest(),
        b"x" * 32: hashlib.sha256(b"x" * 32).digest(),  # text of 32 characters is a passphrase
        b"y" * 31 + b"\n": hashlib.sha256(b"y" * 31).digest(),
        "Schlüssel zum Glück".encode(): hashlib.sha256("Schlüssel zum Glück".encode()).digest(),
    }
    for data, secret in forms.items():
        assert read_key(a_file(tmp_path, data)).secret == secret, data


@given(secret=st.binary(min_size=32, max_size=32).filter(lambda data: any(byte >= 0x80 for byte in data)))
def test_any_32_bytes_that_are_no_text_are_the_key(tmp_path_factory: pytest.TempPathFactory, secret: bytes) -> None:
    try:
        text = secret.decode()
    except UnicodeDecodeError:
        text = ""
    if not text.strip().isprintable() or not text.strip():
        assert read_key(a_file(tmp_path_factory.mktemp("key"), secret)).secret == secret


@pytest.mark.parametrize("data", [b"", b"\n", b"too short", b"\0" * 31, b"\0" * 33, b"a\nb" * 10, b"p" * 2000])
def test_the_error_for_a_bad_key_does_not_show_it(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(KeyFileError, match="wanted 32 bytes, 64 hexadecimal digits, or a passphrase") as caught:
        read_key(a_file(tmp_path, data))
    assert "\n" not in str(caught.value)
    assert not data.strip() or data.strip().decode() not in str(caught.value)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o610, 0o644, 0o666, 0o700])
def test_a_key_that_others_may_read_or_write_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(KeyFileError, match=f"read permissions {mode:04o}, wanted 0600"):
        read_key(a_file(tmp_path, SECRET, mode))


def test_a_folder_and_a_device_are_no_keys(tmp_path: Path) -> None:
    for file in (tmp_path, Path("/dev/zero"), tmp_path / "missing"):
        with pytest.raises(KeyFileError):
            read_key(file)


def test_a_made_key_is_random_private_and_never_written_over(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        make_key(tmp_path / "one")
    finally:
        os.umask(before)
    make_key(tmp_path / "two")
    assert stat.S_IMODE((tmp_path / "one").stat().st_mode) == 0o600
    one = read_key(tmp_path / "one").secret
    assert one != read_key(tmp_path / "two").secret
    with pytest.raises(KeyFileError, match="exists already"):
        make_key(tmp_path / "one")
    assert read_key(tmp_path / "one").secret == one


def test_a_key_does_not_show_itself() -> None:
    key = Key(SECRET)
    try:
        raise RuntimeError(f"{key} {key!r}")
    except RuntimeError as error:
        shown = "".join(traceback.TracebackException.from_exception(error, capture_locals=True).format())
    assert "Key(hidden)" in shown
    assert repr(SECRET) not in shown
    assert SECRET.hex() not in shown
    with pytest.raises(TypeError):
        pickle.dumps(key)


def test_stored_timestamps_return_and_belong_to_one_process(tmp_path: Path) -> None:
    file = tmp_path / "stamps"
    program = (
        "import os, sys; from pathlib import Path; from scenarios.signing.stamps import open_stamps\n"
        "open_stamps(Path(sys.argv[1])).keep(77, 12345); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", program, str(file)], check=False, timeout=60)
    assert killed.returncode == -9
    stamps = open_stamps(file)
    assert stamps.known == {77: 12345}
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    with pytest.raises(KeyFileError, match="another process uses it"):
        open_stamps(file)


def test_a_file_that_holds_no_timestamps_is_left_alone(tmp_path: Path) -> None:
    file = a_file(tmp_path, b"somebody's letter")
    with pytest.raises(KeyFileError, match="read no timestamps"):
        open_stamps(file)
    assert file.read_bytes() == b"somebody's letter"


def test_an_unfinished_entry_is_ignored() -> None:
    stamps = Stamps()
    stamps.keep(5, 100)
    whole = bytes(stamps.memory)
    stamps.keep(6, 200)
    begun = bytearray(whole)
    begun[32:40] = stamps.memory[32:40]  # the timestamp is written before the stream
    assert Stamps(begun).known == {5: 100}


def test_the_command_makes_a_key_and_prints_nothing(tmp_path: Path) -> None:
    file = tmp_path / "formation.key"
    done = gcs("key", file)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(read_key(file).secret) == 32
    again = gcs("key", file)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr == f"{file}: exists already, wanted a new file: a key is never overwritten\n"


@pytest.mark.parametrize("program", ["gcs", "sim_vehicles.drive.cli"])
def test_a_key_that_others_may_read_gives_exit_code_2(tmp_path: Path, program: str) -> None:
    file = a_file(tmp_path, SECRET, 0o644)
    scenario = SCENARIOS / "chain3.toml"
    fly = [*(["fly"] if program == "gcs" else []), str(scenario), "--key", str(file)]
    done = subprocess.run(
        [sys.executable, "-m", program, *fly], capture_output=True, text=True, check=False, timeout=60, cwd=tmp_path
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.endswith(f"{file}: read permissions 0644, wanted 0600: chmod 600 {file}\n")
    assert done.stderr.count("\n") == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["secret.key"]
