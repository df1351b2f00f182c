"""Writes the files of a robot with four servos on one serial port. Its host and services are separate programs."""

from pathlib import Path

ROBOT = """
extends = "planar13"
name = "row"

[chain]
modules = 4
axes = ["yaw"]
"""
SCENARIO = """
title = "A row of servos, as separate programs"
robot = "./row_robot.toml"
scene = "flat"
controller = "hold"
clock_mode = "realtime"
rate_hz = 25
duration_s = 60
seed = 1

[start]
on_route = false

[services.control]
latency_ticks = 2

[backends.{backend}]
ports = ["{port}"]
watchdog_s = 0.5
"""


def write_servo_row(folder: Path, backend: str, port: str) -> None:
    """Write the scenario `row.toml` and its robot into a folder.

    Args:
        folder: where the programs run.
        backend: driver type of the servos.
        port: name of their serial port.
    """
    (folder / "row_robot.toml").write_text(ROBOT)
    (folder / "row.toml").write_text(SCENARIO.format(backend=backend, port=port))
