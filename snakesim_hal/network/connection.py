"""How SnakeSIM opens Zenoh: the endpoint of a robot's network, the settings, and the number of receiving threads.

Without a router of its own, all loopback sessions of a robot connect to its HAL host: the host listens (mode
`router`), and everything else connects to it (mode `client`). Zenoh peers do not forward for one another unless gossip
introduces them, and gossip is off here. With `--router` the host too is a client of the lab's router.
"""

import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT, require_loopback_up
from snakesim_hal.network.image_connection import set_if_default
from snakesim_hal.network.session_file import SessionFile
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES

ENVELOPE_BYTES = 4096  # room around a payload for its key, its encoding and the numbers of an image

# Every session has these settings, and its session file cannot change them.
REQUIRED_SETTINGS: dict[str, Any] = {
    "scouting/delay": 0,
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    "transport/shared_memory/enabled": False,
    "listen/exit_on_failure": True,
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 1.5},
}

# A session file may have other values for its own network, such as a longer lease on a bad link.
DEFAULT_SETTINGS: dict[str, Any] = {
    # Connections that stay silent are closed after a second, and many of them are allowed.
    "transport/unicast/accept_timeout": 1000,
    "transport/unicast/accept_pending": 1000,
    "transport/unicast/max_sessions": 4000,
    "transport/link/tx/lease": 2000,
    # A subscriber that does not read loses samples after 0.1 ms (Zenoh's default is 1 ms), so that ten of them hardly
    # delay a writer. With less, bursts to good subscribers are lost: at 0 ms, two thirds of six express messages in a
    # row.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100,
}

# Closing a frozen subscriber blocks a receiving thread of Zenoh, and by default it has two: three subscribers that
# froze together blocked the controller's commands for long enough to end its lease.
ROUTER_RECEIVING_THREADS = 16
# A client reads one connection; with two threads each message would wake both. With Zenoh's `handover: app` no thread
# is woken, but a full image link then ends the lease of control.
CLIENT_RECEIVING_THREADS = 1
# Environment variable that sets the number of Zenoh's threads.
ZENOH_RUNTIME_VARIABLE = "ZENOH_RUNTIME"

_environment_lock = threading.Lock()
_requested_thread_counts: list[int] = []  # receiving threads of each session that is being opened


@dataclass(frozen=True)
class ConnectionSettings:
    """How a process connects to the robot's network."""

    endpoint: str = DEFAULT_ENDPOINT
    namespace: str | None = None  # None: the whole network, for tools that search for robots
    listen: bool = False  # True: listen on the endpoint; False: connect to it
    insecure: bool = False  # True: listen even where other machines can connect
    max_bytes: int = MAX_PAYLOAD_BYTES  # of a payload; longer ones cost neither memory nor time
    session: SessionFile | None = None  # how to connect; `endpoint` is then the first one in it

    @staticmethod
    def from_session_file(
        session: SessionFile, namespace: str | None = None
    ) -> "ConnectionSettings":
        """Return the link that a session file describes.

        Raises:
            ConfigError: The file is for another namespace.
        """
        return ConnectionSettings(
            session.endpoints[0], session.resolve_namespace(namespace), session=session
        )


def open_zenoh(
    connection: ConnectionSettings,
    connect_timeout_s: float,
    edit_config: Callable[[zenoh.Config], None] | None = None,
) -> zenoh.Session:
    """Open a session of Zenoh with the settings that SnakeSIM needs.

    Args:
        connection: Endpoint, and whether to connect to it or listen on it.
        connect_timeout_s: Time in s within which a client must be connected.
        edit_config: Function that edits the settings of this session just before it is opened. None to keep them.

    Raises:
        NotConnectedError: The endpoint does not answer, or cannot be listened on.
        RefusedError: The endpoint is on loopback, and that interface is down.
    """
    if connection.session is None:  # a session file may name other endpoints, too
        require_loopback_up(connection.endpoint)
    zenoh.init_log_from_env_or("off")
    config = _build_config(connection, connect_timeout_s)
    if edit_config is not None:
        edit_config(config)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _make_connection_error(connection, error) from error


def _build_config(connection: ConnectionSettings, connect_timeout_s: float) -> zenoh.Config:
    """Return the settings of a session file, if there is one, with the settings of every session on top."""
    config = _build_base_config(connection)
    settings = {**REQUIRED_SETTINGS, "connect/timeout_ms": round(connect_timeout_s * 1000)}
    if connection.namespace is not None:
        settings["namespace"] = connection.namespace
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    size_limit = {"transport/link/rx/max_message_size": connection.max_bytes + ENVELOPE_BYTES}
    set_if_default(config, DEFAULT_SETTINGS | size_limit)
    return config


def _build_base_config(connection: ConnectionSettings) -> zenoh.Config:
    """Return the settings of the session file; without one, Zenoh's defaults with the link's endpoint alone."""
    if connection.session is not None:
        return zenoh.Config.from_json5(connection.session.text)
    endpoints = json.dumps([connection.endpoint])
    config = zenoh.Config()
    if connection.listen:
        config.insert_json5("mode", json.dumps("router"))
        config.insert_json5("listen/endpoints", endpoints)
        config.insert_json5("connect/endpoints", "[]")
    else:
        config.insert_json5("mode", json.dumps("client"))
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("connect/endpoints", endpoints)
    return config


def _make_connection_error(
    connection: ConnectionSettings, error: zenoh.ZError
) -> NotConnectedError:
    """Return the error that explains to a user why Zenoh could not open the session."""
    if connection.listen:
        return NotConnectedError(
            f"cannot listen on {connection.endpoint}: {str(error).split(' at /')[0]}. Another run may hold the port; "
            f"choose one with --endpoint tcp/127.0.0.1:PORT",
            code="network/port-in-use",
        )
    if connection.session is not None:
        return NotConnectedError(
            f"nothing on {', '.join(connection.session.endpoints)} lets {connection.session.path} in: no router runs "
            f"there, or it does not accept the certificate; set RUST_LOG=zenoh=warn for details",
            code="certificate/rejected",
        )
    return NotConnectedError(
        f"nothing listens on {connection.endpoint}; start a run or a router there first",
        code="network/nothing-listens",
    )


@contextmanager
def limit_receiving_threads(count: int) -> Iterator[None]:
    """Limit the number of Zenoh's receiving threads in this process while the context opens a session.

    The number is passed by an environment variable, which is removed when the last session has been opened, so that
    child processes do not inherit it. If the user has set the variable, it remains unchanged. Any number of threads may
    open sessions at the same time. Zenoh reads the variable when the first session is opened.

    Args:
        count: Number of receiving threads.
    """
    with _environment_lock:
        is_set_by_user = ZENOH_RUNTIME_VARIABLE in os.environ and not _requested_thread_counts
        if not is_set_by_user:
            _requested_thread_counts.append(count)
            os.environ.setdefault(ZENOH_RUNTIME_VARIABLE, f"(rx: (worker_threads: {count}))")
    try:
        yield
    finally:
        if not is_set_by_user:
            with _environment_lock:
                _requested_thread_counts.remove(count)
                if not _requested_thread_counts:
                    del os.environ[ZENOH_RUNTIME_VARIABLE]
