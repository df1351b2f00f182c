"""Reads which mutants change nothing that a test could notice, from a file that explains each of them."""

import tomllib
from pathlib import Path


def read_explained(path: Path) -> set[str]:
    """Return every mutant that a file such as `equivalent.toml` explains: lists of mutants by their reason."""
    mutants_by_reason: dict[str, list[str]] = tomllib.loads(path.read_text(encoding="utf-8"))
    return {text for mutants in mutants_by_reason.values() for text in mutants}
