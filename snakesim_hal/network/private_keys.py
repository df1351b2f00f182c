"""Private keys that a Zenoh file names: whether every user of this computer may read them."""

import json
import stat
from functools import cache
from pathlib import Path

import zenoh

from snakesim_hal.base.terminal import print_stderr

_NAMED = ("connect_private_key", "listen_private_key")  # below transport/link/tls


def readable_by_all(key: Path) -> str:
    """What is wrong with who may read a private key, and the way out; empty when nothing is."""
    try:
        mode = stat.S_IMODE(key.stat().st_mode)
    except OSError:
        return ""
    if not mode & stat.S_IROTH:
        return ""
    return f"{key}: every user of this computer may read this private key (mode {mode:o}); chmod 600 {key}"


def warn_of_readable_keys(settings: zenoh.Config) -> None:
    """Say on stderr which keys everybody may read. It refuses nothing: a stop must get through."""
    for name in _NAMED:
        named = json.loads(settings.get_json(f"transport/link/tls/{name}"))
        if isinstance(named, str):
            _warn(Path(named))


@cache  # a command may read its file twice
def _warn(key: Path) -> None:
    if wrong := readable_by_all(key):
        print_stderr(f"snakesim: warning: {wrong}, and renew it: snakesim deploy certs --rotate")
