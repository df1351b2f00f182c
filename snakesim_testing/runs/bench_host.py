"""A lab's folder with a robot, a scenario and a backend of its own, and the host that it runs there."""

import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from snakesim_hal.model.files import SHIPPED_FILES_DIR
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import SNAKESIM_COMMAND, make_environment
from snakesim_testing.runs.in_process_command import snakesim


def lab_folder(folder: Path, joint_count: int, scenario: str, files: Mapping[str, str]) -> Path:
    """A shorter `planar13` as snake.toml, its bench.toml, and more files by their names."""
    snake = (
        (SHIPPED_FILES_DIR / "robots" / "planar13.toml")
        .read_text()
        .replace("modules = 13", f"modules = {joint_count}")
    )
    for name, text in {"snake.toml": snake, "bench.toml": scenario, **files}.items():
        (folder / name).write_text(text)
    return folder


@contextmanager
def host(home: Path, backend: str) -> Iterator[str]:
    """Run a HAL host of the scenario bench.toml, disarmed, until the end of the context.

    Args:
        home: Folder with the scenario, in which the host runs.
        backend: Name of its backend.

    Yields:
        The endpoint of its network, once it answers.
    """
    endpoint = find_free_endpoint()
    program = [
        *SNAKESIM_COMMAND,
        "start",
        "host",
        "bench.toml",
        "--backend",
        backend,
        "--endpoint",
        endpoint,
    ]
    with subprocess.Popen(
        program, cwd=home, env=make_environment(home), stdin=subprocess.DEVNULL
    ) as process:
        try:
            wait_until(
                lambda: snakesim("status", "--endpoint", endpoint, cwd=home).code == 0, "the host"
            )
            yield endpoint
        finally:
            process.terminate()
