"""MuJoCo ships no stubs for its compiled module; without this file the type checker takes its names for missing."""

from typing import Any

def __getattr__(name: str) -> Any: ...
