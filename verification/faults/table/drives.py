"""Rows about joint modules, drives and buses."""

from verification.faults.row import DRIVE_TYPES, FaultHeading, FaultRow
from verification.faults.rows import drives, modules
from verification.faults.table.row_kinds import (
    MAX_FLOOD_MS,
    NO_BUS,
    NO_WATCHDOG,
    make_bus_row,
    make_drive_row,
    make_isolated_row,
    make_joint_row,
    make_sensor_row,
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
            deadline=f"off {drives.MAX_OFF_DELAY_MS:.0f} ms after the signal; "
            "enabled again: none before reset and arming",
            limit=0.0,
            unit="drives enabled again",
            measures={
                **dict.fromkeys(DRIVE_TYPES, drives.measure_frozen_host),
                "feetech": NO_WATCHDOG,
            },
            environment="namespaces",
        ),
        make_drive_row(
            "drive_silent",
            "a drive is silent",
            kind="mute",
            limit_periods=4,
            reason="three questions without an answer",
            fault_names={"others": ["drive_silent"], "can": ["module_silent"]},
        ),
        make_drive_row(
            "drive_restarted",
            "a drive restarts",
            kind="reboot",
            limit_periods=4,
            reason="it is silent meanwhile",
            fault_names={
                "others": ["drive_silent", "drive_not_armed"],
                "can": ["module_restarted"],
            },
        ),
        make_drive_row(
            "drive_overheated",
            "a drive's winding is too hot",
            kind="overheat",
            limit_periods=8,
            reason="drives report errors ten times a second, or the host reads one of them in each period",
            fault_names={"others": ["drive_fault"], "can": ["module_overheat"]},
        ),
        make_drive_row(
            "drive_bus_lost",
            "the bus is cut for 0.3 s",
            kind="cut",
            limit_periods=3,
            reason="as for every bus",
            fault_names={"others": ["interface_down"], "can": ["interface_down"]},
        ),
    ),
)

JOINT_MODULE_FAILS = FaultHeading(
    fault="a joint module is silent, restarts, repeats its last value, or sends a wrong counter",
    expected="the fault names the joint, and all joints stop",
    deadline="50 ms; restart: one frame",
    rows=(
        make_joint_row("joint_silent", kind="mute", fault_name="module_silent"),
        make_joint_row("joint_frozen", kind="freeze", fault_name="module_frozen"),
        make_joint_row("joint_restarted", kind="reboot", fault_name="module_restarted"),
        make_joint_row("joint_wrong_counter", kind="counter", fault_name="wrong_counter"),
        make_joint_row("joint_bad_checksum", kind="checksum", fault_name="bad_checksum"),
        make_sensor_row("robot_joint_silent", "a joint is silent, by a whole robot", kind="mute"),
        make_sensor_row(
            "robot_joint_frozen", "a joint repeats its last value, by a whole robot", kind="freeze"
        ),
        make_sensor_row(
            "robot_joint_wrong",
            "a joint's angle is suddenly off by 0.5 rad, by a whole robot",
            kind="wrong",
        ),
        make_sensor_row(
            "robot_joint_nan", "a joint's angle is no number, by a whole robot", kind="nan"
        ),
    ),
)

JOINT_IS_ISOLATED = FaultHeading(
    fault="one joint fails, and the robot file allows for it (`max_isolated_joints = 1`)",
    expected="that joint is disabled, and the others continue",
    deadline="50 ms",
    rows=(
        make_isolated_row("isolated_silent", "a joint is silent", kind="mute"),
        make_isolated_row("isolated_frozen", "a joint repeats its last value", kind="freeze"),
        make_isolated_row(
            "isolated_wrong", "a joint's angle is suddenly off by 0.5 rad", kind="wrong"
        ),
        make_isolated_row("isolated_nan", "a joint's angle is no number", kind="nan"),
    ),
)

BUS_FAILS = FaultHeading(
    fault="the bus has a fault: bus-off, error-passive, transmit queue full, interface down, receive overflow, "
    "babbling node, duplicate id",
    expected="the robot stops with a fault, and recovers only to disarmed. A duplicate id is refused at arming",
    deadline="2-3 T; flood 100 ms",
    rows=(
        make_bus_row(
            "bus_off", "the controller leaves the bus", kind="bus_off", fault_name="bus_off"
        ),
        make_bus_row(
            "bus_error_passive",
            "more than 127 errors",
            kind="error_passive",
            fault_name="error_passive",
        ),
        make_bus_row(
            "bus_queue_full", "the transmit queue stays full", kind="full", fault_name="bus_stuck"
        ),
        make_bus_row(
            "bus_interface_down", "the interface goes down", kind="cut", fault_name="interface_down"
        ),
        make_bus_row(
            "bus_receive_overflow",
            "received frames get lost",
            kind="overflow",
            fault_name="receive_overflow",
        ),
        make_bus_row(
            "bus_babbling",
            "a node floods the bus",
            kind="babble",
            fault_name="module_babbling",
            limit_ms=MAX_FLOOD_MS,
        ),
        make_bus_row(
            "bus_duplicate",
            "a second node with the same id appears",
            kind="duplicate",
            fault_name="duplicate_node",
            limit_ms=MAX_FLOOD_MS,
        ),
        FaultRow(
            name="bus_duplicate_at_start",
            fault="two nodes with the same id are there when the host opens the bus",
            expected="refused, with the joint and both serials; nothing is enabled",
            deadline="before anything is enabled",
            limit=0.0,
            unit="modules enabled",
            measures={"sim": NO_BUS, "can": modules.measure_duplicate_at_start},
        ),
    ),
)
