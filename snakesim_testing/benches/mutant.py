"""One backend that breaks the contract in one way."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from snakesim_testing.contract.bench import DrivesOf, Mute


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """A broken backend, and the clauses that have to notice it."""

    name: str
    backend: Any
    breaks: tuple[str, ...]  # names of the clauses
    mute: Mute
    drives: DrivesOf


def name_clauses(clauses: Iterable[str]) -> tuple[str, ...]:
    """Return the names of test functions from those of clauses."""
    return tuple(f"test_{clause}" for clause in clauses)
