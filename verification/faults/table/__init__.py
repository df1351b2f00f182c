"""Declares every row of the fault table, in the order of the page. Each module declares related faults."""

from verification.faults.row import FaultHeading, FaultRow
from verification.faults.table import commands, drives, inputs_and_time, network, processes

HEADINGS: tuple[FaultHeading, ...] = (
    processes.CONTROLLER_STOPS,
    processes.HOST_STOPS,
    drives.DRIVE_FAILS,
    processes.ROUTER_RESTARTS,
    network.NETWORK_CUT,
    commands.TWO_CONTROLLERS,
    commands.COMMANDS_OUT_OF_TIME,
    commands.INVALID_COMMANDS,
    drives.JOINT_MODULE_FAILS,
    inputs_and_time.STREAM_STOPS,
    drives.JOINT_IS_ISOLATED,
    drives.BUS_FAILS,
    inputs_and_time.WALL_CLOCK_STEPS,
    inputs_and_time.SLOW_SIMULATOR,
    inputs_and_time.SIMULATION_DIVERGES,
    network.SLOW_CONSUMER,
    network.STOP_UNDER_ATTACK,
    processes.SECOND_RUN,
    processes.HOST_RESTARTS,
)

ROWS: dict[str, FaultRow] = {row.name: row for heading in HEADINGS for row in heading.rows}
