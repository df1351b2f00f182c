"""The type checker proves that a backend gets limited setpoints only if nothing else creates that type."""

import ast
from pathlib import Path

REPOSITORY = Path(__file__).parents[4]
# Simulated robots whose environment was asked for without limits.
MAY_CREATE = {"snakesim_hal/safety/limiter.py", "snakesim/environments/no_limiter.py"}


def files_that_create_safe_setpoints() -> set[str]:
    """The files with a call of `SafeSetpoints(...)` in all packages that a robot runs."""
    found: set[str] = set()
    for path in REPOSITORY.glob("snakesim*/**/*.py"):
        if path.is_relative_to(REPOSITORY / "snakesim_testing"):
            continue
        text = path.read_text()
        if "SafeSetpoints(" not in text:  # parsing all files takes seconds
            continue
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func).split(".")[-1] == "SafeSetpoints"
            ):
                found.add(str(path.relative_to(REPOSITORY)))
    return found


def test_only_the_limiter_creates_setpoints_for_a_backend() -> None:
    assert files_that_create_safe_setpoints() <= MAY_CREATE
