"""How many connections the console keeps, in total and of one user, and which one makes room for another. Pure.

A connection first waits until its request is complete. Then it is answered, or handed on to the pages' server. Both
kinds have limits, so that no number of connections fills the file table that a stop needs as well.
"""

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

KeyT = TypeVar("KeyT", bound=Hashable)


@dataclass(frozen=True, kw_only=True)
class ConnectionLimits:
    """The most connections of each kind. Those of one user leave some for the others."""

    waiting: int = 256  # requests that are not complete yet; a browser opens some connections ahead of need
    waiting_of_user: int = 160
    pages: int = 160  # handed on: each page has one, and a few more while it loads; 64 pages may be open
    pages_of_user: int = 112
    asking: int = 64  # that wait for the result of a stop


RESERVED_FILES = 64  # for everything else that the console opens: images, recordings, terminals of joint steps


def choose_limits(open_files: int, free_files: int) -> ConnectionLimits:
    """Return limits that leave RESERVED_FILES of the free files, for a process that may have `open_files` in all."""
    wanted = ConnectionLimits()
    needed = wanted.waiting + wanted.pages + wanted.asking
    left = max(free_files - RESERVED_FILES, open_files // 8, 8)
    if left >= needed:
        return wanted
    scale = left / needed

    def scaled(number: int) -> int:
        return max(1, int(number * scale))

    return ConnectionLimits(
        waiting=scaled(wanted.waiting),
        waiting_of_user=scaled(wanted.waiting_of_user),
        pages=scaled(wanted.pages),
        pages_of_user=scaled(wanted.pages_of_user),
        asking=scaled(wanted.asking),
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
    _of_user: Counter[int] = field(default_factory=Counter[int])

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._entries)

    def __contains__(self, key: KeyT) -> bool:
        """Whether a connection is one of them."""
        return key in self._entries

    def add(self, key: KeyT, user: int, now_s: float) -> KeyT | None:
        """Add a connection. Returns the one that has to be closed for it, which is not in here any more."""
        evicted = None
        if self._of_user[user] >= self.limits.waiting_of_user:
            evicted = self.oldest(user)
        elif len(self._entries) >= self.limits.waiting:
            evicted = self.oldest(self._of_user.most_common(1)[0][0])
        if evicted is not None:
            self.remove(evicted)
        self._entries[key] = _Entry(user, now_s)
        self._of_user[user] += 1
        return evicted

    def oldest(self, user: int | None = None) -> KeyT | None:
        """Return the oldest one, of a user or of all; None when there is none."""
        return next((key for key, entry in self._entries.items() if user in (None, entry.user)), None)

    def remove(self, key: KeyT) -> int:
        """Remove a connection, and return its user."""
        entry = self._entries.pop(key)
        self._of_user[entry.user] -= 1
        if not self._of_user[entry.user]:
            del self._of_user[entry.user]
        return entry.user

    def list_older_than(self, before_s: float) -> list[KeyT]:
        """Return those that have waited since before a time."""
        late: list[KeyT] = []
        for key, entry in self._entries.items():
            if entry.since_s >= before_s:
                break
            late.append(key)
        return late

    def list_all(self) -> list[KeyT]:
        """Return all of them, oldest first."""
        return list(self._entries)


def why_no_page(users: Counter[int], user: int, limits: ConnectionLimits) -> str | None:
    """Return why a user gets no further connection to the pages, or None. users: of those that are open."""
    if users.total() >= limits.pages:
        return f"more than {limits.pages} connections are open; close some pages"
    if users[user] >= limits.pages_of_user:
        return f"more than {limits.pages_of_user} connections of one user are open; close some pages"
    return None
