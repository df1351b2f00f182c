"""The robots of this user on this computer: tools find every running HAL here, whatever its port.

Each run keeps a small file, locked for as long as its process lives; the kernel releases the lock however it dies.
An emergency stop reads them first of all, so this imports little.
"""

import contextlib
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from snakesim_hal.network.session import ConnectionSettings


@dataclass(frozen=True, kw_only=True)
class LocalRobot:
    """A robot whose HAL host runs, or is starting, on this computer."""

    namespace: str
    robot: str
    backend: str
    endpoint: str  # Zenoh endpoint
    stop_host: str  # of its stop port
    stop_port: int
    config: str | None = None  # file with the effective configuration of its run, if that is known
    pid: int  # of the responsible process: `snakesim run`, or a host that was started on its own
    session: str = ""  # path of the session file by which it has joined a lab; empty: without one

    @staticmethod
    def from_connection(
        connection: "ConnectionSettings",
        robot: str,
        backend: str,
        stop_port: socket.socket,
        config: str | None = None,
    ) -> "LocalRobot":
        """Return the entry of a robot for which this process is responsible."""
        stop_host, port = stop_port.getsockname()[:2]
        return LocalRobot(
            namespace=connection.namespace or robot,
            robot=robot,
            backend=backend,
            endpoint=connection.endpoint,
            stop_host=stop_host,
            stop_port=port,
            pid=os.getpid(),
            session=str(connection.session.path) if connection.session else "",
            config=config,
        )


def get_state_folder() -> Path:
    """Return the folder of state that outlives a run.

    It is `$XDG_STATE_HOME/snakesim`, by default `~/.local/state/snakesim`.
    """
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "snakesim"


def get_robot_state_folder(robot: str, backend: str, hardware: str) -> Path:
    """Return the folder of one robot's state, such as its emergency stop. It is the same in every run."""
    name = "-".join(filter(None, (robot, backend, hardware)))
    return (
        get_state_folder()
        / "robots"
        / "".join(c if c.isalnum() or c in "-_+." else "_" for c in name)
    )


@contextlib.contextmanager
def register_robot(robot: LocalRobot) -> Iterator[str | None]:
    """Register a robot for command-line tools on this computer while the context lasts.

    The robot is described in a file that is named after the process id. A lock on the open file shows that the process
    still runs.

    Args:
        robot: Entry to write.

    Yields:
        None if the robot is registered. If the file cannot be written, the reason why tools will not find the robot.
    """
    path = _get_live_folder() / f"{robot.pid}.json"
    consequence = "`snakesim status` and `estop` find this run only with --endpoint"
    problem = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        yield f"{path}: {error.strerror}; {consequence}"
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        os.write(descriptor, json.dumps(asdict(robot)).encode())
    except OSError as error:
        problem = f"{path}: {error.strerror}; {consequence}"
    try:
        yield problem
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


def list_local_robots() -> list[LocalRobot]:
    """Return every robot whose process lives, sorted by file name. Removes the files of ended processes."""
    found: list[LocalRobot] = []
    for path in sorted(_get_live_folder().glob("*.json")) if _get_live_folder().is_dir() else []:
        with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                if _is_locked(handle):
                    found.append(_decode_robot(os.read(handle, 65536)))
                else:
                    path.unlink()
            finally:
                os.close(handle)
    return found


def _decode_robot(text: bytes) -> LocalRobot:
    """Return the robot that a file of the registry describes.

    Raises:
        ValueError: The text is not JSON.
        TypeError: A value is missing, or has a wrong type.
    """
    values = json.loads(text)
    known_values = {
        field.name: values[field.name] for field in fields(LocalRobot) if field.name in values
    }
    robot = LocalRobot(**known_values)
    wrong_fields: list[str] = []
    for field in fields(robot):
        if not isinstance(getattr(robot, field.name), cast(type, field.type)):
            wrong_fields.append(field.name)
    if wrong_fields:
        raise TypeError(f"{', '.join(wrong_fields)} cannot be meant")
    return robot


def _get_live_folder() -> Path:
    return get_state_folder() / "live"


def _is_locked(handle: int) -> bool:
    """Return whether the process that wrote a file still lives: it holds a lock on it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False
