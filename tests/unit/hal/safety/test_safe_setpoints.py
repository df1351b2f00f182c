"""Only the command limiter creates `SafeSetpoints`, so that the type checker proves that all setpoints are limited."""

import ast
from pathlib import Path

REPOSITORY = Path(__file__).parents[4]
# `no_limiter.py` serves simulated robots whose environment has no limits.
ALLOWED_FILES = {"snakesim_hal/safety/limiter.py", "snakesim/environments/no_limiter.py"}


def find_files_that_create_safe_setpoints() -> set[str]:
    """Return the files with a call of `SafeSetpoints(...)` in all packages that a robot runs."""
    files: set[str] = set()
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
                files.add(str(path.relative_to(REPOSITORY)))
    return files


def test_only_the_limiter_creates_setpoints_for_a_backend() -> None:
    assert find_files_that_create_safe_setpoints() <= ALLOWED_FILES
