"""Makes rows of the same kind. They differ in the fault and its measurement, but have the same expected reaction."""

from collections.abc import Sequence
from functools import partial

from snakesim_hal.model.fault_kinds import FAULT_KINDS
from verification.faults.row import DRIVE_TYPES, Backend, Environment, FaultRow, Measure
from verification.faults.rows import attacks, drives, guest, isolation, modules, streams

PERIOD_MS = 10.0  # of the control cycle, written T in the table
LEASE_MS = 50.0
STOP_MS = 200.0  # from the request of an emergency stop to safe setpoints
WATCHDOG_MS = 100.0  # of a joint module
# A guest knows a module's time only from its heartbeats, one in each period.
GUEST_WATCHDOG_MS = WATCHDOG_MS + 1000.0 / guest.RATE_HZ
ROUTER_KILLS = 50
MAX_FLOOD_MS = 100.0  # to the stop mode, if a node floods the bus or has the id of another node

# Deadlines, expected reactions and units of several rows.
WITHIN_LEASE = "lease, 50 ms after the last good command, and acted on within the period (10 ms)"
WITHOUT_CONSUMER = (
    "2 more in a window than in the worst one before it came: as many are missed "
    "without it, now and then"
)
NAMES_JOINT = "fault names the joint, group to safe stop, latched"
FRAMES_THROUGH = "messages got through"

# Why a row does not apply to the simulator.
NO_BUS = "a simulator has no bus"
NO_MODULES = "a simulator has no modules; what its sensors can do is in the rows by a whole robot"
NO_WATCHDOG = (
    "these servos have no watchdog: they hold their last angle until the driver runs again"
)
NO_MODULES_LEFT = (
    "the simulator is in the host's process: without a host nothing is there that could move"
)


def apply_to_sim_and_can(measure: Measure) -> dict[Backend, Measure | str]:
    """Return the measures of a row that is measured in the same way on the backends sim and can."""
    return {"sim": measure, "can": measure}


def make_lease_row(
    name: str,
    fault: str,
    measure: Measure,
    *,
    min_trials: int = 0,
    environment: Environment = "here",
    more_ms: float = 0.0,
) -> FaultRow:
    """Return a row about a stream of commands that stops.

    Args:
        name: Name of the row.
        fault: Description of the fault.
        measure: How the row is measured.
        min_trials: Number of trials in a complete table, if more than usual.
        environment: Where the row is measured.
        more_ms: Time from the request of the fault to its beginning.
    """
    return FaultRow(
        name=name,
        fault=fault,
        expected="safe stop by the lease, lease freed, fault latched",
        deadline=WITHIN_LEASE,
        limit=LEASE_MS + PERIOD_MS + more_ms,
        unit="ms",
        measures=apply_to_sim_and_can(measure),
        environment=environment,
        min_trials=min_trials,
    )


def make_watchdog_row(
    name: str, fault: str, measure: Measure, limit_ms: float, environment: Environment = "here"
) -> FaultRow:
    """Return a row about joint modules that get no setpoints any more.

    Args:
        name: Name of the row.
        fault: Description of the fault of the host.
        measure: How the row is measured.
        limit_ms: Deadline. More than WATCHDOG_MS if a module's time is known only from its heartbeats.
        environment: Where the row is measured.
    """
    uncertainty = ""
    if limit_ms > WATCHDOG_MS:
        uncertainty = f", which a listener can determine to {limit_ms - WATCHDOG_MS:.0f} ms"
    return FaultRow(
        name=name,
        fault=fault,
        expected="every module stops by itself, motor off, latched",
        deadline=f"100 ms after the last setpoint, in the module's own time{uncertainty}",
        limit=limit_ms,
        unit="ms",
        measures={"sim": NO_MODULES_LEFT, "can": measure},
        environment=environment,
    )


def make_joint_row(name: str, kind: str, fault_name: str) -> FaultRow:
    """Return a row about a joint module on CAN. fault_name: name that the driver must report."""
    return FaultRow(
        name=name,
        fault=f"a joint module: {FAULT_KINDS['joint'][kind].description}",
        expected=NAMES_JOINT,
        deadline="50 ms from right after the module's last good answer to the stop mode on the bus",
        limit=50.0,
        unit="ms",
        measures={
            "sim": NO_MODULES,
            "can": partial(modules.measure_injected_fault, kind, fault_name),
        },
    )


def make_injected_row(name: str, fault: str, expected: str, measure: Measure) -> FaultRow:
    """Return a row about a fault that the host injects on request, with any backend."""
    return FaultRow(
        name=name,
        fault=fault,
        expected=expected,
        deadline="50 ms; and the injector takes the request at the host's next tick (10 ms)",
        limit=60.0,
        unit="ms",
        measures=apply_to_sim_and_can(measure),
    )


def make_sensor_row(name: str, fault: str, kind: str) -> FaultRow:
    """Return a row about a failing sensor of a joint, with any backend."""
    return make_injected_row(
        name, fault, NAMES_JOINT, partial(modules.measure_failing_sensor, kind)
    )


def make_isolated_row(name: str, fault: str, kind: str) -> FaultRow:
    """Return a row about one failing joint of a robot that continues without it."""
    expected = "fault names the joint, it alone is disabled, the others continue, and a reset enables it again"
    return make_injected_row(name, fault, expected, partial(isolation.measure_isolated_joint, kind))


def make_bus_row(
    name: str, fault: str, kind: str, fault_name: str, limit_ms: float = 3 * PERIOD_MS
) -> FaultRow:
    """Return a row about a CAN bus. fault_name: name that the driver must report."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="fault, group to safe stop, recovers only to disarmed",
        deadline=f"{limit_ms:.0f} ms to the stop mode on the bus",
        limit=limit_ms,
        unit="ms",
        measures={"sim": NO_BUS, "can": partial(modules.measure_injected_fault, kind, fault_name)},
    )


def make_drive_row(
    name: str,
    fault: str,
    kind: str,
    limit_periods: int,
    reason: str,
    fault_names: dict[str, Sequence[str]],
) -> FaultRow:
    """Return a row about a drive of every type, or about its bus.

    Args:
        name: Name of the row.
        fault: Description of the fault.
        kind: Kind of the injected fault.
        limit_periods: Deadline in control periods.
        reason: Why the deadline is so long.
        fault_names: Names that the driver of joint modules ("can") and those of drives ("others") may report.
    """
    limit_ms = limit_periods * drives.PERIOD_MS
    return FaultRow(
        name=name,
        fault=fault,
        expected="fault, which names the joint if it is one; every motor off after the braking; none on again before "
        "the reset",
        deadline=f"{limit_ms:.0f} ms to the stop mode: {reason}",
        limit=limit_ms,
        unit="ms",
        measures=dict.fromkeys(
            DRIVE_TYPES, partial(drives.measure_injected_fault, kind, fault_names)
        ),
    )


def make_consumer_row(name: str, fault: str, measure: Measure) -> FaultRow:
    """Return a row about a process that reads the robot's streams, and cannot keep up."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="no control cycle is missed because of it, the robot continues",
        deadline=WITHOUT_CONSUMER,
        limit=2.0,
        unit="more missed cycles",
        measures=apply_to_sim_and_can(measure),
    )


def make_stream_row(name: str, key: str, max_age_ms: float) -> FaultRow:
    """Return a row about a stream without which the controller holds. max_age_ms: `max_age` in the scenario."""
    return FaultRow(
        name=name,
        fault=f"{key}: all of it is lost",
        expected="the push ends, every joint holds its position, control/state names the stream; continues when it is "
        "back",
        deadline=f"{max_age_ms:.0f} ms, which is how old it may be, and a tick (10 ms) of injector, control and host",
        limit=max_age_ms + 3 * PERIOD_MS,
        unit="ms",
        measures=apply_to_sim_and_can(partial(streams.measure_lost_stream, key)),
    )


def make_stop_row(name: str, fault: str, measure: Measure) -> FaultRow:
    """Return a row about an emergency stop during an attack on the network."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="every joint is made safe at once, the stop is latched and confirmed to the client that requested it",
        deadline=f"{STOP_MS:.0f} ms from the request to the setpoints",
        limit=STOP_MS,
        unit="ms",
        measures=apply_to_sim_and_can(measure),
    )


def make_flood_row(name: str, fault: str, flood_name: str) -> FaultRow:
    """Return a row about an emergency stop under a flood. flood_name: key of `attacks.FLOODS`."""
    return make_stop_row(name, fault, partial(attacks.measure_stop_under_flood, flood_name))
