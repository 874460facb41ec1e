"""Key files of MAVLink 2 signing: 32 secret bytes that only their owner may read."""

import hashlib
import os
import secrets
import stat
from pathlib import Path

KEY_BYTES = 32
LEAST_PASSPHRASE = 12
_MOST_BYTES = 1024


class KeyFileError(Exception):
    """A key file, or its file of timestamps, cannot be used. The text names the file but shows no contents."""


class Key:
    """The secret key. Printing and logging hide it, and it cannot be pickled."""

    __slots__ = ("secret",)

    def __init__(self, secret: bytes) -> None:
        assert len(secret) == KEY_BYTES
        self.secret = secret

    def __repr__(self) -> str:
        return "Key(hidden)"

    def __reduce__(self) -> str:
        raise TypeError("a key is not written down")


def read_key(file: Path) -> Key:
    """The key in a file, in one of the three common forms.

    32 raw bytes, as pymavlink takes them; 64 hexadecimal digits, as `make_key` writes them; or one line of text, a
    passphrase whose SHA-256 is the key, as in MAVProxy, Mission Planner and QGroundControl. Raises KeyFileError if it
    cannot be read, holds none of these, belongs to another user, or others have access.
    """
    try:
        with file.open("rb") as opened:
            status = os.fstat(opened.fileno())
            data = opened.read(_MOST_BYTES + 1) if stat.S_ISREG(status.st_mode) else b""
    except OSError as error:
        raise KeyFileError(f"{file}: {error.strerror}, wanted a key file; `gcs key FILE` makes one") from None
    if status.st_uid != os.geteuid():
        raise KeyFileError(f"{file}: read a file of user {status.st_uid}, wanted one of your own")
    permissions = stat.S_IMODE(status.st_mode)
    if permissions & ~0o600:
        raise KeyFileError(f"{file}: read permissions {permissions:04o}, wanted 0600: chmod 600 {file}")
    return Key(_secret(data, file))


def _secret(data: bytes, file: Path) -> bytes:
    try:
        text = data.decode().strip()
    except UnicodeDecodeError:
        text = ""
    if not (text.isprintable() and text):  # 32 random bytes are text in only 1 of 10^14 cases
        if len(data) == KEY_BYTES:
            return data
    elif len(text) == 2 * KEY_BYTES and all(digit in "0123456789abcdefABCDEF" for digit in text):
        return bytes.fromhex(text)
    elif len(text) >= LEAST_PASSPHRASE and len(data) <= _MOST_BYTES:
        return hashlib.sha256(text.encode()).digest()
    wanted = f"32 bytes, 64 hexadecimal digits, or a passphrase of {LEAST_PASSPHRASE} characters or more in one line"
    raise KeyFileError(f"{file}: read {len(data)} bytes that are no key, wanted {wanted}")


def make_key(file: Path) -> None:
    """Write a new random key, as hexadecimal digits, to a new file.

    Raises KeyFileError if the file exists, or cannot be written.
    """
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise KeyFileError(f"{file}: exists already, wanted a new file: a key is never overwritten") from None
    except OSError as error:
        raise KeyFileError(f"{file}: {error.strerror}, wanted a file that can be written") from None
    with os.fdopen(descriptor, "w") as opened:
        os.fchmod(descriptor, 0o600)  # whatever the umask
        opened.write(secrets.token_hex(KEY_BYTES) + "\n")
