"""Checks whether every user of this computer may read the private keys that a Zenoh file names."""

import json
import stat
from functools import cache
from pathlib import Path

import zenoh

from snakesim_hal.base.terminal import print_stderr

_NAMED = ("connect_private_key", "listen_private_key")  # below transport/link/tls


def check_permissions(key: Path) -> str:
    """Return a text if every user may read a private key, with the remedy; else an empty text."""
    try:
        mode = stat.S_IMODE(key.stat().st_mode)
    except OSError:
        return ""
    if not mode & stat.S_IROTH:
        return ""
    return f"{key}: every user of this computer may read this private key (mode {mode:o}); chmod 600 {key}"


def warn_of_readable_keys(settings: zenoh.Config) -> None:
    """Warn on stderr of keys that every user may read. It refuses nothing, because a stop must get through."""
    for name in _NAMED:
        named = json.loads(settings.get_json(f"transport/link/tls/{name}"))
        if isinstance(named, str):
            _warn(Path(named))


@cache  # a command may read its file twice
def _warn(key: Path) -> None:
    problem = check_permissions(key)
    if problem:
        print_stderr(f"snakesim: warning: {problem}, and renew it: snakesim lab certs --rotate")
