"""Faults of joint modules, of drives, and of buses."""

from verification.faults.row import DRIVE_TYPES, FaultHeading, FaultRow
from verification.faults.rows import drives, modules
from verification.faults.table.row_kinds import (
    NO_BUS,
    NO_WATCHDOG,
    bus_row,
    drive_row,
    isolated_row,
    joint_row,
    sensor_row,
)

DRIVE_FAILS = FaultHeading(
    fault="drives of every type: the host is frozen for 1 s, a drive is silent, restarts or is too hot, or the bus is "
    "lost",
    expected="the drives stop by themselves, and the fault names the joint. No drive is enabled again before reset "
    "and arming",
    deadline="a watchdog, 100 ms; at 50 Hz (T = 20 ms) for the driver 3 T, and 100 ms for what drives report by "
    "themselves",
    rows=(
        FaultRow(
            name="drive_host_frozen",
            fault="host: SIGSTOP for 1 s, then SIGCONT",
            expected="every drive off by its own watchdog; each stop a fault that names its joint; none enabled again",
            deadline=f"off {drives.OFF_MS:.0f} ms after the signal; enabled again: none before reset and arming",
            limit=0.0,
            unit="drives enabled again",
            measures={**dict.fromkeys(DRIVE_TYPES, drives.host_frozen), "feetech": NO_WATCHDOG},
            environment="namespaces",
        ),
        drive_row(
            "drive_silent",
            "a drive is silent",
            "mute",
            4,
            "three questions without an answer",
            {"others": ["drive_silent"], "can": ["module_silent"]},
        ),
        drive_row(
            "drive_restarted",
            "a drive restarts",
            "reboot",
            4,
            "it is silent meanwhile",
            {"others": ["drive_silent", "drive_not_armed"], "can": ["module_restarted"]},
        ),
        drive_row(
            "drive_overheated",
            "a drive's winding is too hot",
            "overheat",
            8,
            "drives report errors ten times a second, or one of them a period is asked",
            {"others": ["drive_fault"], "can": ["module_overheat"]},
        ),
        drive_row(
            "drive_bus_lost",
            "the bus is cut for 0.3 s",
            "cut",
            3,
            "as for every bus",
            {"others": ["interface_down"], "can": ["interface_down"]},
        ),
    ),
)

JOINT_MODULE_FAILS = FaultHeading(
    fault="a joint module is silent, restarts, repeats its last value, or sends a wrong counter",
    expected="the fault names the joint, and all joints stop",
    deadline="50 ms; restart: one frame",
    rows=(
        joint_row("joint_silent", "mute", "module_silent"),
        joint_row("joint_frozen", "freeze", "module_frozen"),
        joint_row("joint_restarted", "reboot", "module_restarted"),
        joint_row("joint_wrong_counter", "counter", "wrong_counter"),
        joint_row("joint_bad_checksum", "checksum", "bad_checksum"),
        sensor_row("robot_joint_silent", "a joint is silent, by a whole robot", "mute"),
        sensor_row(
            "robot_joint_frozen", "a joint repeats its last value, by a whole robot", "freeze"
        ),
        sensor_row(
            "robot_joint_wrong",
            "a joint's angle is suddenly off by 0.5 rad, by a whole robot",
            "wrong",
        ),
        sensor_row("robot_joint_nan", "a joint's angle is no number, by a whole robot", "nan"),
    ),
)

JOINT_IS_ISOLATED = FaultHeading(
    fault="one joint fails, and the robot file allows for it (`max_isolated_joints = 1`)",
    expected="that joint is disabled, and the others continue",
    deadline="50 ms",
    rows=(
        isolated_row("isolated_silent", "a joint is silent", "mute"),
        isolated_row("isolated_frozen", "a joint repeats its last value", "freeze"),
        isolated_row("isolated_wrong", "a joint's angle is suddenly off by 0.5 rad", "wrong"),
        isolated_row("isolated_nan", "a joint's angle is no number", "nan"),
    ),
)

BUS_FAILS = FaultHeading(
    fault="the bus has a fault: bus-off, error-passive, transmit queue full, interface down, receive overflow, "
    "babbling node, duplicate id",
    expected="the robot stops with a fault, and recovers only to disarmed. A duplicate id is refused at arming",
    deadline="2-3 T; flood 100 ms",
    rows=(
        bus_row("bus_off", "the controller leaves the bus", "bus_off", "bus_off"),
        bus_row("bus_error_passive", "more than 127 errors", "error_passive", "error_passive"),
        bus_row("bus_queue_full", "the transmit queue stays full", "full", "bus_stuck"),
        bus_row("bus_interface_down", "the interface goes down", "cut", "interface_down"),
        bus_row("bus_receive_overflow", "received frames get lost", "overflow", "receive_overflow"),
        bus_row("bus_babbling", "a node floods the bus", "babble", "module_babbling", 100.0),
        bus_row(
            "bus_duplicate",
            "a second node with the same id appears",
            "duplicate",
            "duplicate_node",
            100.0,
        ),
        FaultRow(
            name="bus_duplicate_at_start",
            fault="two nodes with the same id are there when the host opens the bus",
            expected="refused, with the joint and both serials; nothing is enabled",
            deadline="before anything is enabled",
            limit=0.0,
            unit="modules enabled",
            measures={"sim": NO_BUS, "can": modules.twice_at_start},
        ),
    ),
)
