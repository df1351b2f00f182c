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
from snakesim_hal.model.shared_settings import collect_shared_settings
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Publisher, ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import VERSIONS, ProcessInfo

HOST = "host"
MAX_ENTRIES = 256
MAX_LISTED_DIFFERENCES = 3  # differences in the text of a refusal
NOT_SET = "not set"


def make_own_entry(name: str, config: RunConfig | None = None) -> ProcessInfo:
    """Return the entry that describes this process to other processes.

    Args:
        name: Role of the process, such as the name of its service.
        config: Configuration of the run. None if the process uses none.
    """
    return ProcessInfo(
        name=name,
        machine=socket.gethostname()[:64] or "unnamed",
        user=get_user_name(),
        pid=os.getpid(),
        version=version("snakesim"),
        started_unix_s=round(time.time()),
        settings={} if config is None else collect_shared_settings(config),
        messages={message.__name__: number for message, number in VERSIONS.items()},
    )


def publish_process_entry(session: Session, entry: ProcessInfo) -> Publisher[ProcessInfo]:
    """Publish an entry for as long as the session lives.

    The liveliness token is declared first, so that a host waits for the entry.

    Returns:
        The publisher, for later changes.
    """
    key = keys.process_key(entry.name, secrets.token_hex(4))
    session.declare_token(key)
    shown = session.declare_latched_publisher(key, ProcessInfo)
    shown.put(entry)
    return shown


def describe_differences(one: ProcessInfo, other: ProcessInfo) -> list[str]:
    """Return the differences between two processes of one robot as texts, with values in the order of the arguments."""
    found = [
        f"`{key}` is {value} on {describe_process(one)}, {other_value} on {describe_process(other)}"
        for key, value, other_value in _find_differing_settings(one, other)
    ]
    found += [
        f"message {name} has version {one.messages[name]} on {describe_process(one)}, {other.messages[name]} on "
        f"{describe_process(other)}"
        for name in _find_differing_messages(one, other)
    ]
    return found


def _find_differing_settings(one: ProcessInfo, other: ProcessInfo) -> list[tuple[str, str, str]]:
    """Return the keys whose values differ, each with both values. A process may use only some sections."""
    sections = {_get_section(key) for key in one.settings} & {
        _get_section(key) for key in other.settings
    }
    differing: list[tuple[str, str, str]] = []
    for key in dict.fromkeys((*one.settings, *other.settings)):
        value = one.settings.get(key, NOT_SET)
        other_value = other.settings.get(key, NOT_SET)
        if _get_section(key) in sections and value != other_value:
            differing.append((key, value, other_value))
    return differing


def _get_section(key: str) -> str:
    return key.partition(".")[0]


def _find_differing_messages(one: ProcessInfo, other: ProcessInfo) -> list[str]:
    """Return the messages that both processes know in different versions."""
    return [
        name
        for name in one.messages
        if name in other.messages and one.messages[name] != other.messages[name]
    ]


def _describe_conflict(entry: ProcessInfo, own: ProcessInfo) -> str:
    """Return a text about the settings and messages in which a process differs from this one, with the remedy.

    The text is empty if nothing differs.
    """
    settings = _find_differing_settings(entry, own)
    differences = [f"`{key}` = {value} (here {own_value})" for key, value, own_value in settings]
    differences += [
        f"message {name} version {entry.messages[name]} (here {own.messages[name]})"
        for name in _find_differing_messages(entry, own)
    ]
    if not differences:
        return ""
    listing = ", ".join(differences[:MAX_LISTED_DIFFERENCES])
    if len(differences) > MAX_LISTED_DIFFERENCES:
        listing += (
            f" and {len(differences) - MAX_LISTED_DIFFERENCES} more, which `snakesim status` lists"
        )
    return f"{describe_process(entry)} differs from this host in {listing}; {_describe_remedy(entry, own)}"


def _describe_remedy(entry: ProcessInfo, own: ProcessInfo) -> str:
    """Return what to do about different settings, or different versions, of two processes."""
    if _find_differing_messages(entry, own):
        return "install one version of SnakeSIM on both machines"
    keys_in_conflict = [key for key, _, _ in _find_differing_settings(entry, own)]
    if keys_in_conflict == ["clock_mode"]:
        return f"start {entry.name} again with --clock-mode {own.settings['clock_mode']}"
    return f"start host and {entry.name} with equal files, --set and --clock-mode"


def describe_process(entry: ProcessInfo) -> str:
    """Return the machine, name and id of a process as text."""
    return f"{entry.machine} ({entry.name}, process {entry.pid})"


class _EntryComparison(NamedTuple):
    """Two entries that have been compared."""

    entry: ProcessInfo
    own: ProcessInfo
    conflict: str  # empty: they fit


class ProcessEntries:
    """The entries of all processes that are present now."""

    def __init__(self, session: Session) -> None:
        """Subscribe to entries, also to those that were published before."""
        self._session = session
        self._decoder = MessageDecoder(ProcessInfo)
        self._entries: dict[str, ProcessInfo] = {}
        self._alive: set[str] = set()
        # Cache by key; only of known services, so there are few.
        self._comparisons: dict[str, _EntryComparison] = {}
        session.on_token_change(self._on_token, keys.PROCESS_ALL)
        session.on_latched_arrival(keys.PROCESS_ALL, self._store_entry)

    def find_problems(self, own: ProcessInfo, names: Collection[str]) -> list[str]:
        """Return the reasons, as texts, why a process cannot work together with the processes of these names."""
        problems = [
            f"{process} has not published its settings yet" for process in self.unpublished(names)
        ]
        for key, entry in self._find_entries(names).items():
            conflict = self._find_conflict(key, entry, own) if entry is not None else ""
            if conflict:
                problems.append(conflict)
        return problems

    def _find_conflict(self, key: str, entry: ProcessInfo, own: ProcessInfo) -> str:
        """Return the text of `_describe_conflict`. Each entry is compared only once, although every status needs it."""
        comparison = self._comparisons.get(key)
        if comparison is None or comparison.entry is not entry or comparison.own is not own:
            comparison = _EntryComparison(entry, own, _describe_conflict(entry, own))
            self._comparisons[key] = comparison
        return comparison.conflict

    def unpublished(self, names: Collection[str]) -> list[str]:
        """Return the present processes of these names that have not published their entry yet."""
        return [
            keys.parse_service(key)
            for key, entry in self._find_entries(names).items()
            if entry is None
        ]

    def _find_entries(self, names: Collection[str]) -> dict[str, ProcessInfo | None]:
        """Return the entry of each connected process of these names by its key; None for an unpublished entry."""
        entry_by_key: dict[str, ProcessInfo | None] = {}
        for key in sorted(self._alive.copy()):
            name = keys.parse_service(key).rpartition("-")[0]
            if name in names:
                entry = self._entries.get(key)
                is_own = entry is not None and entry.name == name
                entry_by_key[key] = entry if is_own else None
        return entry_by_key

    def waits(self) -> dict[str, list[str]]:
        """Return the keys that each present process waits for, by its name."""
        entries = [self._entries[key] for key in sorted(self._alive.copy()) if key in self._entries]
        return {entry.name: entry.waits_for for entry in entries if entry.waits_for}

    def _on_token(self, key: str, present: bool) -> None:
        """Add or remove a connected process, in Zenoh's thread."""
        if present and len(self._alive) < MAX_ENTRIES:
            self._alive.add(key)
        elif not present:
            # The entry stays: if only the link was cut, it is not sent again.
            self._alive.discard(key)

    def _store_entry(self, arrival: ReceivedSample) -> None:
        """Store an entry, in Zenoh's thread. A full table first drops the entries of processes that have vanished."""
        if len(self._entries) >= MAX_ENTRIES and arrival.key not in self._entries:
            for key in self._entries.keys() - self._alive:
                self._entries.pop(key, None)
            if len(self._entries) >= MAX_ENTRIES:
                return
        try:
            self._entries[arrival.key] = arrival.decode(self._decoder)
        except WireError as error:
            self._session.rejected[error.reason] += 1
