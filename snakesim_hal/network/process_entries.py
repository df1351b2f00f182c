"""Entries of all processes on a robot's network. The host compares them before it arms.

Threads: Zenoh's threads call `_on_token` and `_store_entry`; the host's thread calls the public methods.
"""

import os
import secrets
import socket
import time
from collections.abc import Collection
from importlib.metadata import version
from typing import NamedTuple

from snakesim_hal.base.errors import WireError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.shared_settings import shared_settings
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Arrival, Publisher
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import VERSIONS, Process

HOST = "host"
MAX_ENTRIES = 256
MAX_NAMED = 3  # differences in the text of a refusal
NOT_SET = "not set"


def own_entry(name: str, config: RunConfig | None = None) -> Process:
    """Return the entry of this process; config: of its run, None if it uses none."""
    return Process(
        name=name,
        machine=socket.gethostname()[:64] or "unnamed",
        user=get_user_name(),
        pid=os.getpid(),
        version=version("snakesim"),
        started_unix_s=round(time.time()),
        settings={} if config is None else shared_settings(config),
        messages={message.__name__: number for message, number in VERSIONS.items()},
    )


def show_process(session: Session, entry: Process) -> Publisher[Process]:
    """Publish an entry for as long as the session lives.

    The liveliness token is declared first, so that a host waits for the entry.

    Returns:
        The publisher, for later changes.
    """
    key = keys.process_key(entry.name, secrets.token_hex(4))
    session.declare_token(key)
    shown = session.latched_publisher(key, Process)
    shown.put(entry)
    return shown


def find_differences(one: Process, other: Process) -> list[str]:
    """Return the differences between two processes of one robot as texts, with values in the order of the arguments."""
    found = [
        f"`{key}` is {value} on {describe_place(one)}, {other_value} on {describe_place(other)}"
        for key, value, other_value in _differing_settings(one, other)
    ]
    found += [
        f"message {name} has version {one.messages[name]} on {describe_place(one)}, {other.messages[name]} on "
        f"{describe_place(other)}"
        for name in _differing_messages(one, other)
    ]
    return found


def _differing_settings(one: Process, other: Process) -> list[tuple[str, str, str]]:
    """Return the keys whose values differ, each with both values. A process may use only some sections."""
    sections = {_section(key) for key in one.settings} & {_section(key) for key in other.settings}
    differing: list[tuple[str, str, str]] = []
    for key in dict.fromkeys((*one.settings, *other.settings)):
        value = one.settings.get(key, NOT_SET)
        other_value = other.settings.get(key, NOT_SET)
        if _section(key) in sections and value != other_value:
            differing.append((key, value, other_value))
    return differing


def _section(key: str) -> str:
    return key.partition(".")[0]


def _differing_messages(one: Process, other: Process) -> list[str]:
    """Return the messages that both processes know in different versions."""
    return [name for name in one.messages if name in other.messages and one.messages[name] != other.messages[name]]


def _describe_conflict(entry: Process, own: Process) -> str:
    """Return the keys in which a process differs from this one and what to do; empty if there are none."""
    settings = _differing_settings(entry, own)
    named = [f"`{key}` = {value} (here {own_value})" for key, value, own_value in settings]
    named += [
        f"message {name} version {entry.messages[name]} (here {own.messages[name]})"
        for name in _differing_messages(entry, own)
    ]
    if not named:
        return ""
    listed = ", ".join(named[:MAX_NAMED])
    if len(named) > MAX_NAMED:
        listed += f" and {len(named) - MAX_NAMED} more, which `snakesim status` lists"
    return f"{describe_place(entry)} differs from this host in {listed}; {_describe_remedy(entry, own)}"


def _describe_remedy(entry: Process, own: Process) -> str:
    """Return what to do about different settings, or different versions, of two processes."""
    if _differing_messages(entry, own):
        return "install one version of SnakeSIM on both machines"
    keys_in_conflict = [key for key, _, _ in _differing_settings(entry, own)]
    if keys_in_conflict == ["clock_mode"]:
        return f"start {entry.name} again with --clock-mode {own.settings['clock_mode']}"
    return f"start host and {entry.name} with equal files, --set and --clock-mode"


def describe_place(entry: Process) -> str:
    """Return the machine, name and id of a process as text."""
    return f"{entry.machine} ({entry.name}, process {entry.pid})"


class _Compared(NamedTuple):
    """Two entries that have been compared."""

    entry: Process
    own: Process
    conflict: str  # empty: they fit


class ProcessEntries:
    """The entries of all processes that are present now."""

    def __init__(self, session: Session) -> None:
        """Subscribe to entries, also to those that were published before."""
        self._session = session
        self._decoder = Decoder(Process)
        self._entries: dict[str, Process] = {}
        self._alive: set[str] = set()
        self._compared: dict[str, _Compared] = {}  # only of known services, so there are few
        session.on_alive(self._on_token, keys.PROCESS_ALL)
        session.on_latched_arrival(keys.PROCESS_ALL, self._store_entry)

    def find_problems(self, own: Process, names: Collection[str]) -> list[str]:
        """Return the reasons, as texts, why a process cannot work together with the processes of these names."""
        problems = [f"{process} has not published its settings yet" for process in self.unpublished(names)]
        for key, entry in self._published(names).items():
            conflict = self._find_conflict(key, entry, own) if entry is not None else ""
            if conflict:
                problems.append(conflict)
        return problems

    def _find_conflict(self, key: str, entry: Process, own: Process) -> str:
        """Return what `_describe_conflict` returns. Each entry is compared once, although every status asks for it."""
        compared = self._compared.get(key)
        if compared is None or compared.entry is not entry or compared.own is not own:
            compared = _Compared(entry, own, _describe_conflict(entry, own))
            self._compared[key] = compared
        return compared.conflict

    def unpublished(self, names: Collection[str]) -> list[str]:
        """Return the present processes of these names that have not published their entry yet."""
        return [keys.parse_service(key) for key, entry in self._published(names).items() if entry is None]

    def _published(self, names: Collection[str]) -> dict[str, Process | None]:
        """Return the entry of each present process of these names by its key; None: it is not published yet."""
        published: dict[str, Process | None] = {}
        for key in sorted(self._alive.copy()):
            name = keys.parse_service(key).rpartition("-")[0]
            if name in names:
                entry = self._entries.get(key)
                is_own = entry is not None and entry.name == name
                published[key] = entry if is_own else None
        return published

    def waits(self) -> dict[str, list[str]]:
        """Return the keys that each present process waits for, by its name."""
        entries = [self._entries[key] for key in sorted(self._alive.copy()) if key in self._entries]
        return {entry.name: entry.waits_for for entry in entries if entry.waits_for}

    def _on_token(self, key: str, present: bool) -> None:
        if present and len(self._alive) < MAX_ENTRIES:
            self._alive.add(key)
        elif not present:
            self._alive.discard(key)  # the entry stays: if only the link was cut, it is not sent again

    def _store_entry(self, arrival: Arrival) -> None:
        """Store an entry. If there are too many, entries of vanished processes make room; else it is dropped."""
        if len(self._entries) >= MAX_ENTRIES and arrival.key not in self._entries:
            for key in self._entries.keys() - self._alive:
                self._entries.pop(key, None)
            if len(self._entries) >= MAX_ENTRIES:
                return
        try:
            self._entries[arrival.key] = arrival.decode(self._decoder)
        except WireError as error:
            self._session.rejected[error.reason] += 1
