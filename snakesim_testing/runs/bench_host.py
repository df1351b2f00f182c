"""Writes a folder with a robot, a scenario and a custom backend, and runs a HAL host in it."""

import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from snakesim_hal.model.files import SHIPPED_FILES_DIR
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import SNAKESIM_COMMAND, make_environment
from snakesim_testing.runs.in_process_command import snakesim


def write_lab_folder(
    folder: Path, joint_count: int, scenario: str, files: Mapping[str, str]
) -> Path:
    """Write a robot with fewer joints than `planar13`, its scenario, and further files into a folder.

    Args:
        folder: Gets the files: `snake.toml` with the robot, `bench.toml` with the scenario, and `files`.
        joint_count: Number of joints of the robot.
        scenario: Text of the scenario.
        files: Texts of further files, by their names.

    Returns:
        The folder.
    """
    planar13 = (SHIPPED_FILES_DIR / "robots" / "planar13.toml").read_text()
    robot = planar13.replace("modules = 13", f"modules = {joint_count}")
    for name, text in {"snake.toml": robot, "bench.toml": scenario, **files}.items():
        (folder / name).write_text(text)
    return folder


@contextmanager
def running_bench_host(home: Path, backend: str) -> Iterator[str]:
    """Run a HAL host of the scenario bench.toml, disarmed, until the end of the context.

    Args:
        home: Folder with the scenario, in which the host runs.
        backend: Name of its backend.

    Yields:
        The endpoint of its network, once it answers.
    """
    endpoint = find_free_endpoint()
    arguments = ("start", "host", "bench.toml", "--backend", backend, "--endpoint", endpoint)
    with subprocess.Popen(
        [*SNAKESIM_COMMAND, *arguments],
        cwd=home,
        env=make_environment(home),
        stdin=subprocess.DEVNULL,
    ) as process:
        try:
            wait_until(
                lambda: snakesim("status", "--endpoint", endpoint, cwd=home).code == 0, "the host"
            )
            yield endpoint
        finally:
            process.terminate()
