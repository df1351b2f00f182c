"""Rows of the same kind, which differ in the fault and in its measurement, but not in what is expected."""

from collections.abc import Sequence
from functools import partial

from snakesim_hal.model.fault_kinds import FAULT_KINDS
from verification.faults.row import DRIVE_TYPES, Backend, Environment, FaultRow, Measure
from verification.faults.rows import attacks, drives, guest, isolation, modules, streams

PERIOD_MS = 10.0  # of the control cycle
LEASE_MS = 50.0
STOP_MS = 200.0  # from the request of an emergency stop to safe setpoints
WATCHDOG_MS = 100.0  # of a joint module
GUEST_WATCHDOG_MS = WATCHDOG_MS + 1000.0 / guest.RATE_HZ  # where heartbeats show the module's time
ROUTER_KILLS = 50
MAX_FLOOD_MS = 100.0  # to the stop mode, where a node floods the bus or has the id of another

# Deadlines, expected reactions and units that several rows have.
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


def both(measure: Measure) -> dict[Backend, Measure | str]:
    """Return the measurements of a row that is measured in the same way on the simulator and on CAN."""
    return {"sim": measure, "can": measure}


def lease_row(
    name: str,
    fault: str,
    measure: Measure,
    *,
    min_trials: int = 0,
    environment: Environment = "here",
    more_ms: float = 0.0,
) -> FaultRow:
    """Return a row about a stream of commands that stops. more_ms: until the fault begins, after its request."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="safe stop by the lease, lease freed, fault latched",
        deadline=WITHIN_LEASE,
        limit=LEASE_MS + PERIOD_MS + more_ms,
        unit="ms",
        measures=both(measure),
        environment=environment,
        min_trials=min_trials,
    )


def watchdog_row(
    name: str, fault: str, measure: Measure, limit_ms: float, environment: Environment = "here"
) -> FaultRow:
    """Return a row about joint modules that get no setpoints any more.

    Args:
        name: of the row.
        fault: of the host, in words.
        measure: how it is measured.
        limit_ms: more than WATCHDOG_MS where a module's time is known only from its heartbeats.
        environment: where it is measured.
    """
    uncertainty = ""
    if limit_ms > WATCHDOG_MS:
        uncertainty = f", which a listener can tell to {limit_ms - WATCHDOG_MS:.0f} ms"
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


def joint_row(name: str, kind: str, fault_name: str) -> FaultRow:
    """Return a row about a joint module on CAN. fault_name: what the driver reports."""
    return FaultRow(
        name=name,
        fault=f"a joint module: {FAULT_KINDS['joint'][kind].description}",
        expected=NAMES_JOINT,
        deadline="50 ms from right after the module's last good answer to the stop mode on the bus",
        limit=50.0,
        unit="ms",
        measures={"sim": NO_MODULES, "can": partial(modules.at_host, kind, fault_name)},
    )


def injected_row(name: str, fault: str, expected: str, measure: Measure) -> FaultRow:
    """Return a row about a fault that the injector of a whole robot causes on request, with any backend."""
    return FaultRow(
        name=name,
        fault=fault,
        expected=expected,
        deadline="50 ms; and the injector takes the request at the host's next tick (10 ms)",
        limit=60.0,
        unit="ms",
        measures=both(measure),
    )


def sensor_row(name: str, fault: str, kind: str) -> FaultRow:
    """Return a row about a joint's sensor of any backend."""
    return injected_row(name, fault, NAMES_JOINT, partial(modules.through_robot, kind))


def isolated_row(name: str, fault: str, kind: str) -> FaultRow:
    """Return a row about one failing joint of a robot that continues without it."""
    expected = "fault names the joint, it alone is disabled, the others continue, and a reset enables it again"
    return injected_row(name, fault, expected, partial(isolation.set_aside, kind))


def bus_row(
    name: str, fault: str, kind: str, fault_name: str, limit_ms: float = 3 * PERIOD_MS
) -> FaultRow:
    """Return a row about a CAN bus. fault_name: what the driver reports."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="fault, group to safe stop, recovers only to disarmed",
        deadline=f"{limit_ms:.0f} ms to the stop mode on the bus",
        limit=limit_ms,
        unit="ms",
        measures={"sim": NO_BUS, "can": partial(modules.at_host, kind, fault_name)},
    )


def drive_row(
    name: str,
    fault: str,
    kind: str,
    limit_periods: int,
    reason: str,
    fault_names: dict[str, Sequence[str]],
) -> FaultRow:
    """Return a row about a drive of every type, or about its bus.

    Args:
        name: of the row.
        fault: in words.
        kind: of the injected fault.
        limit_periods: deadline in control periods.
        reason: why the deadline is so long.
        fault_names: what the driver of joint modules ("can") and those of drives ("others") may report.
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
        measures=dict.fromkeys(DRIVE_TYPES, partial(drives.at_host, kind, fault_names)),
    )


def consumer_row(name: str, fault: str, measure: Measure) -> FaultRow:
    """Return a row about a process that reads from the robot's network, and is slow."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="no control cycle is missed because of it, the robot continues",
        deadline=WITHOUT_CONSUMER,
        limit=2.0,
        unit="more missed cycles",
        measures=both(measure),
    )


def stream_row(name: str, key: str, max_age_ms: float) -> FaultRow:
    """Return a row about a stream without which the controller holds. max_age_ms: of the scenario's `max_age`."""
    return FaultRow(
        name=name,
        fault=f"{key}: all of it is lost",
        expected="the push ends, every joint holds its position, control/state names the stream; continues when it is "
        "back",
        deadline=f"{max_age_ms:.0f} ms, which is how old it may be, and a tick (10 ms) of injector, control and host",
        limit=max_age_ms + 3 * PERIOD_MS,
        unit="ms",
        measures=both(partial(streams.withheld, key)),
    )


def stop_row(name: str, fault: str, measure: Measure) -> FaultRow:
    """Return a row about an emergency stop during an attack on the network."""
    return FaultRow(
        name=name,
        fault=fault,
        expected="every joint is made safe at once, the stop is latched and confirmed to the client that requested it",
        deadline=f"{STOP_MS:.0f} ms from the request to the setpoints",
        limit=STOP_MS,
        unit="ms",
        measures=both(measure),
    )


def flood_row(name: str, fault: str, flood: str) -> FaultRow:
    """Return a row about an emergency stop under one flood of `attacks.FLOODS`."""
    return stop_row(name, fault, partial(attacks.stopped_under, flood))
