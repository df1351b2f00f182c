"""How many connections the console keeps, in total and of one user, and which one is closed for another. Pure.

A connection first waits until its request is complete. Then it is answered, or handed off to the pages' server. Both
kinds have limits, so that no number of connections fills the file table that a stop needs as well.
"""

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

KeyT = TypeVar("KeyT", bound=Hashable)

RESERVED_FILES = 64  # for everything else that the console opens: images, recordings, terminals of joint steps
MIN_FILES = 8  # for connections, however few files are free


@dataclass(frozen=True, kw_only=True)
class ConnectionLimits:
    """The maximum number of connections of each kind. One user cannot use up the connections of all."""

    # Requests that are not complete yet; a browser opens some connections ahead of need.
    waiting: int = 256
    waiting_of_user: int = 160
    # Handed off: each page has one connection, and a few more while it loads; 64 pages may be open.
    pages: int = 160
    pages_of_user: int = 112
    # Requests that wait for the result of a stop.
    asking: int = 64


def choose_limits(open_files: int, free_files: int) -> ConnectionLimits:
    """Return limits that leave RESERVED_FILES of the free files for other uses.

    Args:
        open_files: How many files this process may have open.
        free_files: How many files it may still open.

    Returns:
        The default limits, or the same limits scaled down if there are too few files.
    """
    defaults = ConnectionLimits()
    needed = defaults.waiting + defaults.pages + defaults.asking
    available = max(free_files - RESERVED_FILES, open_files // 8, MIN_FILES)
    if available >= needed:
        return defaults
    scale = available / needed

    def scale_down(number: int) -> int:
        return max(1, int(number * scale))

    return ConnectionLimits(
        waiting=scale_down(defaults.waiting),
        waiting_of_user=scale_down(defaults.waiting_of_user),
        pages=scale_down(defaults.pages),
        pages_of_user=scale_down(defaults.pages_of_user),
        asking=scale_down(defaults.asking),
    )


@dataclass
class _Entry:
    user: int
    since_s: float


@dataclass
class PendingRequests(Generic[KeyT]):
    """The connections whose request is not complete, oldest first."""

    limits: ConnectionLimits
    _entries: dict[KeyT, _Entry] = field(default_factory=dict[KeyT, _Entry])
    _user_counts: Counter[int] = field(default_factory=Counter[int])

    def __len__(self) -> int:
        """Return how many connections there are."""
        return len(self._entries)

    def __contains__(self, key: KeyT) -> bool:
        """Return whether a connection is one of them."""
        return key in self._entries

    def add(self, key: KeyT, user: int, now_s: float) -> KeyT | None:
        """Add a connection, and remove another one if there are too many.

        Returns:
            The connection that was removed, which the caller has to close: the oldest one of this user if the user has
            too many, else the oldest one of the user with the most connections. None if there was room.
        """
        evicted = None
        if self._user_counts[user] >= self.limits.waiting_of_user:
            evicted = self.oldest(user)
        elif len(self._entries) >= self.limits.waiting:
            ((busiest_user, _),) = self._user_counts.most_common(1)
            evicted = self.oldest(busiest_user)
        if evicted is not None:
            self.remove(evicted)
        self._entries[key] = _Entry(user, now_s)
        self._user_counts[user] += 1
        return evicted

    def oldest(self, user: int | None = None) -> KeyT | None:
        """Return the oldest connection of a user, or of all users; None if there is none."""
        for key, entry in self._entries.items():
            if user is None or entry.user == user:
                return key
        return None

    def remove(self, key: KeyT) -> int:
        """Remove a connection, and return its user."""
        entry = self._entries.pop(key)
        self._user_counts[entry.user] -= 1
        if not self._user_counts[entry.user]:
            del self._user_counts[entry.user]
        return entry.user

    def list_older_than(self, before_s: float) -> list[KeyT]:
        """Return the connections that were added before a time, oldest first."""
        older: list[KeyT] = []
        for key, entry in self._entries.items():
            if entry.since_s >= before_s:
                break
            older.append(key)
        return older

    def list_all(self) -> list[KeyT]:
        """Return all connections, oldest first."""
        return list(self._entries)


def why_no_page(users: Counter[int], user: int, limits: ConnectionLimits) -> str | None:
    """Return the reason why a user gets no further connection to the pages; None if the user gets one.

    Args:
        users: How many connections to the pages each user has open.
        user: The user who wants another one.
        limits: The limits to apply.
    """
    if users.total() >= limits.pages:
        return f"more than {limits.pages} connections are open; close some pages"
    if users[user] >= limits.pages_of_user:
        return f"more than {limits.pages_of_user} connections of one user are open; close some pages"
    return None
