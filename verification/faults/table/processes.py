"""Rows about processes: the controller, the HAL host, the router, and a second run."""

from verification.faults.row import FaultHeading, FaultRow
from verification.faults.rows import attacks, controller, guest, network
from verification.faults.table.row_kinds import (
    GUEST_WATCHDOG_MS,
    PERIOD_MS,
    ROUTER_KILLS,
    WATCHDOG_MS,
    apply_to_sim_and_can,
    make_lease_row,
    make_watchdog_row,
)

CONTROLLER_STOPS = FaultHeading(
    fault="the controller is killed or frozen (SIGSTOP, busy interpreter)",
    expected="the robot stops, the lease becomes free, and the fault is latched",
    deadline="lease",
    rows=(
        make_lease_row(
            "controller_killed", "control: SIGKILL", controller.measure_killed_controller
        ),
        make_lease_row(
            "controller_frozen", "control: SIGSTOP", controller.measure_frozen_controller
        ),
        make_lease_row(
            "controller_hung",
            "control: interpreter busy, by the injector (which takes the request at the controller's next tick)",
            controller.measure_hanging_controller,
            more_ms=PERIOD_MS,
        ),
    ),
)

HOST_STOPS = FaultHeading(
    fault="the HAL host is killed or frozen",
    expected="the watchdog of each joint module stops it",
    deadline="100 ms",
    rows=(
        make_watchdog_row(
            "host_silent",
            "the host sends nothing any more, at one module",
            guest.measure_silent_host,
            limit_ms=WATCHDOG_MS,
        ),
        make_watchdog_row(
            "host_killed",
            "host: SIGKILL",
            guest.measure_killed_host,
            limit_ms=GUEST_WATCHDOG_MS,
            environment="guest",
        ),
        make_watchdog_row(
            "host_frozen",
            "host: SIGSTOP",
            guest.measure_frozen_host,
            limit_ms=GUEST_WATCHDOG_MS,
            environment="guest",
        ),
    ),
)

ROUTER_RESTARTS = FaultHeading(
    fault="the router is killed and restarts, 50 times",
    expected="if the stream of commands stops, the robot stops. The sessions reconnect, and the robot is not armed "
    "again",
    deadline="lease; 5 s to reconnect",
    rows=(
        make_lease_row(
            "router_restarts",
            "router: SIGKILL, 0.4 s later a new one",
            network.measure_router_restart,
            min_trials=ROUTER_KILLS,
        ),
    ),
)

SECOND_RUN = FaultHeading(
    fault="a second run on a robot's network, or at its endpoint",
    expected="the second run refuses to start, and the robot stays as it is",
    deadline="-",
    rows=(
        FaultRow(
            name="second_run",
            fault="a person disarmed the robot; a second `snakesim run` of its name starts there",
            expected="the second ends with an error that names the robot; nothing is armed",
            deadline="-",
            limit=0.0,
            unit="setpoints not passive",
            measures=apply_to_sim_and_can(attacks.measure_second_run),
        ),
    ),
)

HOST_RESTARTS = FaultHeading(
    fault="the HAL host restarts while the robot moves",
    expected="the robot is disarmed, old commands have no effect, and no joint jumps",
    deadline="before first frame",
    rows=(
        FaultRow(
            name="host_restarts",
            fault="host: SIGKILL while moving, started again",
            expected="boots disarmed, refuses what was streamed before, moves nothing until armed",
            deadline="before the first setpoints: none but passive ones until armed",
            limit=0.0,
            unit="setpoints not passive",
            measures=apply_to_sim_and_can(controller.measure_host_restart),
        ),
    ),
)
