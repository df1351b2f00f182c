"""Checks whether every user of this computer may read the private keys that a Zenoh file names."""

import json
import stat
from functools import cache
from pathlib import Path

import zenoh

from snakesim_hal.base.terminal import print_stderr

PRIVATE_KEY_SETTINGS = ("connect_private_key", "listen_private_key")  # below transport/link/tls


def check_permissions(key: Path) -> str:
    """Return a text with the remedy if every user may read a private key; otherwise an empty text."""
    try:
        mode = stat.S_IMODE(key.stat().st_mode)
    except OSError:
        return ""
    if not mode & stat.S_IROTH:
        return ""
    return f"{key}: every user of this computer may read this private key (mode {mode:o}); chmod 600 {key}"


def warn_about_readable_keys(settings: zenoh.Config) -> None:
    """Warn on stderr about private keys that every user may read. Nothing is refused: a stop must get through."""
    for name in PRIVATE_KEY_SETTINGS:
        key_path = json.loads(settings.get_json(f"transport/link/tls/{name}"))
        if isinstance(key_path, str):
            _warn(Path(key_path))


@cache  # a command may read its file twice
def _warn(key: Path) -> None:
    """Warn about a private key that every user may read, once in the life of this process."""
    problem = check_permissions(key)
    if problem:
        print_stderr(f"snakesim: warning: {problem}, and renew it: snakesim lab certs --rotate")
