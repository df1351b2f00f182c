"""Describes a backend that breaks the contract in one way, for tests of the contract suite itself."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from snakesim_testing.contract.bench import MakeEmulatedDrives, MuteJoint


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """A broken backend, and the contract tests that must fail on it."""

    name: str
    backend: Any
    breaks: tuple[str, ...]  # names of the contract tests that must fail
    mute_joint: MuteJoint
    make_emulated_drives: MakeEmulatedDrives


def make_test_names(clauses: Iterable[str]) -> tuple[str, ...]:
    """Return the names of contract test functions from their names without `test_`."""
    return tuple(f"test_{clause}" for clause in clauses)
