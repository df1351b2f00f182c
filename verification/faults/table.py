"""Every row of the fault table, in its order. The fault, what is expected, the deadline, and how it is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from snakesim_hal.model.fault_kinds import KINDS
from snakesim_hal.wire import keys
from verification.faults.row import DRIVE_TYPES, Backend, Measure, Place, Row
from verification.faults.rows import (
    attacks,
    commands,
    consumers,
    controller,
    drives,
    guest,
    isolation,
    modules,
    network,
    simulator,
    streams,
)

LEASE_MS, PERIOD_MS = 50.0, 10.0
WITHIN_LEASE = "lease, 50 ms after the last good command, and acted on within the period (10 ms)"
ROUTERS = 50  # times that it dies
NO_BUS = "a simulator has no bus"
NO_MODULES = "a simulator has no modules; what its sensors can do is in the rows by a whole robot"
NO_MODULES_LEFT = "the simulator is in the host's process: without a host nothing is there that could move"
IN_GUEST_MS = 100.0 + 1000.0 / guest.RATE_HZ  # where heartbeats tell the module's time
STOP_MS = 200.0
WITHOUT_IT = "2 more in a window than in the worst one before it came: as many are missed without it, now and then"
PASSED = "messages got through"


@dataclass(frozen=True)
class Heading:
    """A row as the table asks for it; it may need several measurements."""

    fault: str
    expected: str
    deadline: str
    rows: tuple[Row, ...]


def both(measure: Measure) -> dict[Backend, Measure | str]:
    """Measured in the same way on both."""
    return {"sim": measure, "can": measure}


def lease_row(
    name: str, fault: str, measure: Measure, least: int = 0, place: Place = "here", more_ms: float = 0.0
) -> Row:
    """A row of a stream that stops."""
    return Row(
        name,
        fault,
        "safe stop by the lease, lease freed, fault latched",
        WITHIN_LEASE,
        LEASE_MS + PERIOD_MS + more_ms,
        "ms",
        both(measure),
        place,
        least=least,
    )


def watchdog_row(name: str, fault: str, measure: Measure, limit_ms: float, place: Place = "here") -> Row:
    """Modules that are left alone. Where a listener tells their time from their heartbeats, it may be a little off."""
    reported = f", which a listener can tell to {limit_ms - 100:.0f} ms" if limit_ms > 100 else ""
    return Row(
        name,
        fault,
        "every module stops by itself, motor off, latched",
        f"100 ms after the last setpoint, in the module's own time{reported}",
        limit_ms,
        "ms",
        {"sim": NO_MODULES_LEFT, "can": measure},
        place,
    )


def joint_row(name: str, kind: str, what: str) -> Row:
    """A joint module on CAN."""
    about = KINDS["joint"][kind].description
    return Row(
        name,
        f"a joint module: {about}",
        "fault names the joint, group to safe stop, latched",
        "50 ms from right after the module's last good answer to the stop mode on the bus",
        50.0,
        "ms",
        {"sim": NO_MODULES, "can": partial(modules.at_host, kind, what)},
    )


def asked_row(name: str, fault: str, expected: str, measure: Measure) -> Row:
    """What a joint of any backend can do, asked of the injector of a whole robot."""
    deadline = "50 ms; and the injector takes the request at the host's next tick (10 ms)"
    return Row(name, fault, expected, deadline, 60.0, "ms", both(measure))


def sensor_row(name: str, fault: str, kind: str) -> Row:
    """What any backend's sensors can do."""
    expected = "fault names the joint, group to safe stop, latched"
    return asked_row(name, fault, expected, partial(modules.through_robot, kind))


def isolated_row(name: str, fault: str, kind: str) -> Row:
    """One joint fails, and the robot may lose one."""
    expected = "fault names the joint, it alone is disabled, the others continue, and a reset enables it again"
    return asked_row(name, fault, expected, partial(isolation.set_aside, kind))


def bus_row(name: str, fault: str, kind: str, what: str, limit_ms: float = 3 * PERIOD_MS) -> Row:
    """A bus on CAN."""
    return Row(
        name,
        fault,
        "fault, group to safe stop, recovers only to disarmed",
        f"{limit_ms:.0f} ms to the stop mode on the bus",
        limit_ms,
        "ms",
        {"sim": NO_BUS, "can": partial(modules.at_host, kind, what)},
    )


def drive_row(
    name: str, fault: str, kind: str, limit_periods: int, why: str, others: Sequence[str], modules_say: Sequence[str]
) -> Row:
    """A drive of every type, or its bus. others, modules_say: what drivers of drives and of joint modules name it."""
    limit_ms = limit_periods * drives.PERIOD_MS
    measure = partial(drives.at_host, kind, {"can": modules_say, "others": others})
    return Row(
        name,
        fault,
        "fault, which names the joint if it is one; every motor off after the braking; none on again before the reset",
        f"{limit_ms:.0f} ms to the stop mode: {why}",
        limit_ms,
        "ms",
        dict.fromkeys(DRIVE_TYPES, measure),
    )


def consumer_row(name: str, fault: str, measure: Measure) -> Row:
    """Somebody who listens."""
    expected = "no control cycle is missed because of it, the robot goes on"
    return Row(name, fault, expected, WITHOUT_IT, 2.0, "more missed cycles", both(measure))


def stream_row(name: str, key: str, oldest_ms: float) -> Row:
    """A stream without which the controller holds. oldest_ms: what the scenario's `max_age` comes to."""
    return Row(
        name,
        f"{key}: all of it is lost",
        "the push ends, every joint holds its position, control/state names the stream; continues when it is back",
        f"{oldest_ms:.0f} ms, which is how old it may be, and a tick (10 ms) of injector, control and host",
        oldest_ms + 3 * PERIOD_MS,
        "ms",
        both(partial(streams.withheld, key)),
    )


def flood_row(name: str, fault: str, flood: str) -> Row:
    """An emergency stop under a flood of `attacks.FLOODS`."""
    return stop_row(name, fault, partial(attacks.stopped_under, flood))


def stop_row(name: str, fault: str, measure: Measure) -> Row:
    """An emergency stop while somebody attacks the network."""
    expected = "every joint is made safe at once, the stop is latched and confirmed to who asked"
    return Row(name, fault, expected, f"{STOP_MS:.0f} ms from asking to the setpoints", STOP_MS, "ms", both(measure))


HEADINGS: tuple[Heading, ...] = (
    Heading(
        "controller killed; controller frozen (SIGSTOP; busy interpreter)",
        "safe stop, lease freed, latched",
        "lease",
        (
            lease_row("controller_killed", "control: SIGKILL", controller.killed),
            lease_row("controller_frozen", "control: SIGSTOP", controller.frozen),
            lease_row(
                "controller_hung",
                "control: interpreter busy, by the injector (which takes the request at the controller's next tick)",
                controller.suspended,
                more_ms=PERIOD_MS,
            ),
        ),
    ),
    Heading(
        "HAL host killed or frozen",
        "modules' own watchdog",
        "100 ms",
        (
            watchdog_row("host_silent", "the host says nothing any more, at one module", guest.watchdog, 100.0),
            watchdog_row("host_killed", "host: SIGKILL", guest.host_killed, IN_GUEST_MS, "guest"),
            watchdog_row("host_frozen", "host: SIGSTOP", guest.host_frozen, IN_GUEST_MS, "guest"),
        ),
    ),
    Heading(
        "drives of every type: host frozen for 1 s; a drive silent, restarted, too hot; the bus lost",
        "drives stop by themselves; fault names the joint; no drive is enabled again before reset and arming",
        "a watchdog, 100 ms; at 50 Hz (T = 20 ms) for the driver 3 T, and 100 ms for what drives report by themselves",
        (
            Row(
                "drive_host_frozen",
                "host: SIGSTOP for 1 s, then SIGCONT",
                "every drive off by its own watchdog; each stop a fault that names its joint; none enabled again",
                f"off {drives.OFF_MS:.0f} ms after the signal; enabled again: none before reset and arming",
                0.0,
                "drives enabled again",
                dict.fromkeys(DRIVE_TYPES, drives.host_frozen),
                "namespaces",
            ),
            drive_row(
                "drive_silent",
                "a drive says nothing",
                "mute",
                4,
                "three questions without an answer",
                ["drive_silent"],
                ["module_silent"],
            ),
            drive_row(
                "drive_restarted",
                "a drive restarts",
                "reboot",
                4,
                "it is silent meanwhile",
                ["drive_silent", "drive_not_armed"],
                ["module_restarted"],
            ),
            drive_row(
                "drive_overheated",
                "a drive's winding is too hot",
                "overheat",
                8,
                "drives report errors ten times a second, or one of them a period is asked",
                ["drive_fault"],
                ["module_overheat"],
            ),
            drive_row(
                "drive_bus_lost",
                "the bus is cut for 0.3 s",
                "cut",
                3,
                "as for every bus",
                ["interface_down"],
                ["interface_down"],
            ),
        ),
    ),
    Heading(
        "router dies, restarts, 50 times",
        "safe stop if the stream stops; reconnects; no re-arm",
        "lease; 5 s to reconnect",
        (lease_row("router_restarts", "router: SIGKILL, 0.4 s later a new one", network.router_restarts, ROUTERS),),
    ),
    Heading(
        "network cut between controller and robot (namespaces with a veth pair, link down)",
        "safe stop on the robot side",
        "lease",
        (lease_row("network_cut", "link down between host and services", network.network_cut, place="namespaces"),),
    ),
    Heading(
        "two controllers",
        "first wins, typed refusal, zero frames from the second in 100,000 interleavings",
        "at once",
        (
            Row(
                "two_controllers",
                "two writers at one limiter, interleaved by chance",
                "no setpoint and no right for the second",
                "at once: with the call",
                0.0,
                "frames from the second",
                {"both": commands.interleaved},
            ),
            Row(
                "second_controller",
                "a second controller on the network asks for the lease, and commands with other epochs",
                "typed refusal (lease_held), commands refused as wrong_epoch, the first goes on",
                "at once: none applied",
                0.0,
                "frames from the second",
                both(commands.second_controller),
            ),
        ),
    ),
    Heading(
        "stale, replayed, reordered, duplicated, future command",
        "refused",
        "one message",
        (
            Row(
                "out_of_time",
                "commands out of their time, with the right lease epoch",
                "each refused and counted by its reason, the controller's own go on",
                "one message: none applied",
                0.0,
                PASSED,
                both(commands.out_of_time),
            ),
        ),
    ),
    Heading(
        "NaN, infinity, out of range, wrong length, wrong joint order, malformed or huge bytes, unknown version",
        "refused, counted; never an exception out of a callback",
        "one message",
        (
            Row(
                "wrong_in_itself",
                "commands that are wrong in themselves, with the right epoch, sequence and tick",
                "each refused and counted by its reason, the controller's own go on, no process ends",
                "one message: none applied",
                0.0,
                PASSED,
                both(commands.wrong_in_itself),
            ),
        ),
    ),
    Heading(
        "joint module silent, restarted, frozen value, wrong counter",
        "fault names the joint; group to safe stop",
        "50 ms; restart: one frame",
        (
            joint_row("joint_silent", "mute", "module_silent"),
            joint_row("joint_frozen", "freeze", "module_frozen"),
            joint_row("joint_restarted", "reboot", "module_restarted"),
            joint_row("joint_wrong_counter", "counter", "wrong_counter"),
            joint_row("joint_bad_checksum", "checksum", "bad_checksum"),
            sensor_row("robot_joint_silent", "a joint says nothing, by a whole robot", "mute"),
            sensor_row("robot_joint_frozen", "a joint repeats its last value, by a whole robot", "freeze"),
            sensor_row("robot_joint_wrong", "a joint's angle is suddenly off by 0.5 rad, by a whole robot", "wrong"),
            sensor_row("robot_joint_nan", "a joint's angle is no number, by a whole robot", "nan"),
        ),
    ),
    Heading(
        "a stream that control acts on stops: of a sensor, of guidance, of navigation",
        "without joint states: safe stop; without another: the controller holds, and continues when it is back",
        "joints: 30 ms and the lease; others: their `max_age`",
        (
            Row(
                "stream_joints",
                "sensor/joints: all of it is lost",
                "no command on a state that is too old: safe stop by the lease, lease freed, fault latched",
                "30 ms that a state may be old, the lease (50 ms), and a tick (10 ms) of injector, control and host",
                30.0 + LEASE_MS + 3 * PERIOD_MS,
                "ms",
                both(streams.no_joints),
            ),
            stream_row("stream_pose", keys.POSE, 240.0),
            stream_row("stream_contacts", keys.CONTACTS, 240.0),
            stream_row("stream_world", keys.WORLD, 220.0),
            stream_row("stream_trajectory", keys.TRAJECTORY, 840.0),
        ),
    ),
    Heading(
        "one joint fails, and the robot file allows for it (`max_isolated_joints = 1`)",
        "that joint is disabled, the others continue",
        "50 ms",
        (
            isolated_row("isolated_silent", "a joint says nothing", "mute"),
            isolated_row("isolated_frozen", "a joint repeats its last value", "freeze"),
            isolated_row("isolated_wrong", "a joint's angle is suddenly off by 0.5 rad", "wrong"),
            isolated_row("isolated_nan", "a joint's angle is no number", "nan"),
        ),
    ),
    Heading(
        "bus-off, error-passive, transmit queue full, interface down, receive overflow, babbling node, duplicate id",
        "fault; recovers only to disarmed; duplicate refused at arming",
        "2-3 T; flood 100 ms",
        (
            bus_row("bus_off", "the controller leaves the bus", "bus_off", "bus_off"),
            bus_row("bus_error_passive", "more than 127 errors", "error_passive", "error_passive"),
            bus_row("bus_queue_full", "the transmit queue stays full", "full", "bus_stuck"),
            bus_row("bus_interface_down", "the interface goes down", "cut", "interface_down"),
            bus_row("bus_receive_overflow", "received frames get lost", "overflow", "receive_overflow"),
            bus_row("bus_babbling", "a node floods the bus", "babble", "module_babbling", 100.0),
            bus_row("bus_duplicate", "a second node with the same id appears", "duplicate", "duplicate_node", 100.0),
            Row(
                "bus_duplicate_at_start",
                "two nodes with the same id are there when the host opens the bus",
                "refused, with the joint and both serials; nothing is enabled",
                "before anything is enabled",
                0.0,
                "modules enabled",
                {"sim": NO_BUS, "can": modules.twice_at_start},
            ),
        ),
    ),
    Heading(
        "wall clock steps by an hour either way",
        "nothing",
        "-",
        (
            Row(
                "clock_step",
                "the wall clock goes an hour ahead, and back",
                "nothing: no fault, no lease missed",
                "-",
                0.0,
                "faults and stops",
                both(guest.clock_step),
                "guest",
            ),
        ),
    ),
    Heading(
        "simulator slower than real time in lockstep (0.1x)",
        "no false stop",
        "-",
        (
            Row(
                "slow_simulator",
                "the simulator runs at a tenth of real time, in lockstep",
                "no stop, no fault: leases count in simulated time",
                "-",
                0.0,
                "stops and faults",
                both(simulator.slow),
            ),
        ),
    ),
    Heading(
        "simulation diverges",
        "stop, fault, last good state kept",
        "one step",
        (
            Row(
                "simulation_diverges",
                "the simulator's state becomes impossible",
                "stop and fault in the same step; nothing that is no number is published or recorded",
                "one step",
                1.0,
                "steps",
                {"sim": simulator.diverges, "can": "modules on a bus are no simulation that could diverge"},
            ),
        ),
    ),
    Heading(
        "slow subscriber (sleeping callback, full disk at a consumer, frozen process)",
        "only that consumer suffers; zero missed control cycles",
        "-",
        (
            consumer_row("consumer_sleeps", "a consumer's callback sleeps for 0.5 s at every sample", consumers.sleeps),
            consumer_row("consumer_disk_full", "a consumer writes to a disk that is full", consumers.disk_full),
            consumer_row(
                "consumer_frozen", "four readers of everything are frozen (SIGSTOP)", consumers.frozen_readers
            ),
        ),
    ),
    Heading(
        "an emergency stop while the network is flooded, occupied or held up",
        "stopped at once, regardless of traffic",
        f"{STOP_MS:.0f} ms",
        (
            flood_row("stop_half_open", "300 half-open connections", "half_open"),
            flood_row("stop_idle", "1000 sessions that do nothing, or as many as get in", "idle"),
            flood_row("stop_lease_flood", "lease queries, as many as two processes can", "lease"),
            flood_row("stop_sample_flood", "10,000 samples of noise a second on every key", "garbage"),
            flood_row("stop_datagram_flood", "wrong datagrams at the stop port, as many as a thread can", "datagrams"),
            stop_row(
                "stop_readers_leave", "300 readers of everything leave at once", attacks.stopped_while_readers_leave
            ),
        ),
    ),
    Heading(
        "a second run on a robot's network, or at its endpoint",
        "refuses to start; the robot stays as it is",
        "-",
        (
            Row(
                "second_run",
                "a person disarmed the robot; a second `snakesim run` of its name starts there",
                "the second ends with an error that names the robot; nothing is armed",
                "-",
                0.0,
                "setpoints not passive",
                both(attacks.second_run),
            ),
        ),
    ),
    Heading(
        "HAL restarts while moving",
        "boots disarmed; old commands void; no jump",
        "before first frame",
        (
            Row(
                "host_restarts",
                "host: SIGKILL while moving, started again",
                "boots disarmed, refuses what was streamed before, moves nothing until armed",
                "before the first setpoints: none but passive ones until armed",
                0.0,
                "setpoints not passive",
                both(controller.host_restarts),
            ),
        ),
    ),
)

ROWS: dict[str, Row] = {row.name: row for heading in HEADINGS for row in heading.rows}
