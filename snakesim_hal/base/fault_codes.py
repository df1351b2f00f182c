"""The words on the wire for faults and refusals, explained as `error_codes` explains errors.

`FAULT_CODES` has each `Fault.what`. `REFUSAL_CODES` has each `Answer.refusal`, and the reasons by which
`RobotStatus.commands_rejected` counts. `docs/reference/errors.md` is made of them.
"""

from snakesim_hal.base.error_codes import ErrorCode

FAULT_CODES = {
    # --- the host
    "estop": ErrorCode(
        "Emergency stop.",
        "An operator, or an earlier host that was stopped.",
        "Clear it, then arm.",
    ),
    "lease_expired": ErrorCode(
        "The controller's commands did not arrive in time.",
        "The controller is too slow, has ended, or the network delays its commands.",
        "See the controller's log. On a slow network lower `rate_hz`, which makes the lease longer.",
        page="troubleshooting/lease-expired.md",
    ),
    "service_lost": ErrorCode(
        "A service has ended.", "Its process crashed or was killed.", "See its log."
    ),
    "service_stalled": ErrorCode(
        "In lockstep, a service did not answer a tick.",
        "It hangs, or computes for too long.",
        "See its log.",
    ),
    "second_host": ErrorCode(
        "Another host, or another program on the bus, commands this robot.",
        "It was started twice.",
        "End one of them.",
    ),
    "network_held_up": ErrorCode(
        "The network accepts no messages.",
        "It is congested, or under attack.",
        "Check the network and its clients.",
    ),
    "injection_refused": ErrorCode(
        "A planned fault could not be injected.",
        "The backend refused it.",
        "Correct the plan. See the cause.",
    ),
    "backend_failed": ErrorCode(
        "The backend cannot continue.",
        "Its cause is in the fault: a bus, a device or the simulation.",
        "See host.log.",
    ),
    "state_invalid": ErrorCode(
        "A joint state is missing, not finite, or jumps.",
        "A faulty encoder or a loose cable.",
        "Check the joint.",
    ),
    "joint_frozen": ErrorCode(
        "A joint reports the same state although its target moves.",
        "A faulty encoder or drive.",
        "Check the joint.",
    ),
    "sample_late": ErrorCode(
        "A sensor sample came late. This does not stop the robot.",
        "The machine is too slow to render or compute it.",
        "Lower the sensor's rate or resolution.",
        page="troubleshooting/computer-too-slow.md",
    ),
    # --- heat and supply
    "overheated": ErrorCode(
        "A joint is too hot.",
        "High torque for too long.",
        "Wait until it is cooler, then reset the fault.",
    ),
    "leak": ErrorCode(
        "A joint module reports water inside.", "A seal leaks.", "Take the robot out of the water."
    ),
    "undervoltage": ErrorCode(
        "The supply voltage is too low.", "Battery, cable or fuse.", "Charge or check it."
    ),
    "power_unknown": ErrorCode(
        "Supply and heat of a joint are unknown, and ignored.",
        "Its power reports stopped.",
        "Check the joint.",
    ),
    # --- drives
    "drive_silent": ErrorCode(
        "A drive does not answer.",
        "Power, cable, id or bit rate.",
        "Check them, then clear.",
        page="troubleshooting/drive-silent.md",
    ),
    "drive_fault": ErrorCode(
        "A drive reports an error.", "The cause quotes the drive.", "See the drive's manual."
    ),
    "drive_not_armed": ErrorCode(
        "A drive does not follow, or has stopped by itself.",
        "It restarted, or has an error.",
        "Clear, then arm.",
    ),
    "drive_not_ready": ErrorCode(
        "The start-up of a drive failed, or counts no more.",
        "The cause names the step, such as homing.",
        "Correct it, then reset: the start-up begins again.",
    ),
    "safe_torque_off": ErrorCode(
        "The safe-torque-off input of a drive has switched its motor off.",
        "A safety relay or an emergency stop button.",
        "Release it, then reset and arm.",
    ),
    "limit_switch": ErrorCode(
        "A joint has reached a limit switch.",
        "A wrong zero, or a limit outside the travel.",
        "Reset, and move the joint away from it.",
    ),
    "duplicate_node": ErrorCode(
        "Two devices have the same id.",
        "Ids were not changed after delivery.",
        "Give each device its own id.",
    ),
    "unknown_node": ErrorCode(
        "A device on the bus is not in the robot file.",
        "A wrong id or the wrong bus.",
        "Remove it, or correct its id.",
    ),
    "stop_not_sent": ErrorCode(
        "A stop could not be sent to the drives.",
        "The bus failed. Watchdogs stop the drives.",
        "Check the bus.",
    ),
    "no_setpoints": ErrorCode(
        "A bus received no setpoints for one lease period, so that its drives were disabled.",
        "The host was suspended, or is too slow.",
        "Check the load of the computer.",
        page="troubleshooting/computer-too-slow.md",
    ),
    # --- buses
    "interface_down": ErrorCode(
        "A bus went down.",
        "Unplugged, or brought down. On a local bus, no other program is left.",
        "Bring it up, clear, arm.",
    ),
    "bus_off": ErrorCode(
        "The CAN controller left the bus after too many errors.",
        "A short circuit, a wrong bit rate, or a missing terminator.",
        "Correct the wiring, bring the interface down and up, clear, arm.",
    ),
    "error_passive": ErrorCode(
        "A CAN bus has many errors, and is about to fail.",
        "Cables, terminators or bit rate.",
        "Check them.",
    ),
    "restarted": ErrorCode(
        "A CAN controller restarted after bus_off.", "See bus_off.", "Clear and arm."
    ),
    "receive_overflow": ErrorCode(
        "Frames were lost in reception.", "The computer is too slow.", "Lower its load."
    ),
    "bus_stuck": ErrorCode(
        "A CAN bus sends nothing although frames wait.",
        "No node acknowledges: power, cable, bit rate.",
        "Check them.",
    ),
    "bad_checksum": ErrorCode(
        "A joint module sends corrupt states.", "Wiring or firmware.", "Check the module."
    ),
    "wrong_counter": ErrorCode(
        "A joint module answers cycles that were not sent.",
        "Another program commands it.",
        "End that program.",
    ),
    "emergency": ErrorCode(
        "A node on the bus sent an emergency stop.", "Someone stopped it there.", "Clear, then arm."
    ),
    # --- joint modules on CAN
    "module_silent": ErrorCode(
        "A joint module does not answer.",
        "Power, cable or id.",
        "Check them, then clear.",
        page="troubleshooting/drive-silent.md",
    ),
    "module_frozen": ErrorCode(
        "A joint module repeats one answer.", "Its firmware hangs.", "Power-cycle it."
    ),
    "module_babbling": ErrorCode(
        "A joint module floods the bus.", "Its firmware is faulty.", "Power-cycle it."
    ),
    "module_restarted": ErrorCode(
        "A joint module restarted.", "Its supply was interrupted.", "Clear, then arm."
    ),
    "module_not_armed": ErrorCode(
        "A joint module does not arm.", "See the state in the cause.", "Clear, then arm."
    ),
    "module_not_configured": ErrorCode(
        "A joint module did not accept its parameters.",
        "Lost frames, or a restart.",
        "Clear, or power-cycle it.",
    ),
    "module_watchdog": ErrorCode(
        "A joint module got no Sync in time.", "The host is late.", "Check the computer."
    ),
    "module_stream": ErrorCode(
        "A joint module got no setpoints in time.", "The host is late.", "Check the computer."
    ),
    "module_overheat": ErrorCode(
        "A joint module is too hot.", "High torque for too long.", "Let it cool, then clear."
    ),
    "module_leak": ErrorCode(
        "A joint module reports water inside.", "A seal leaks.", "Take it out of the water."
    ),
    "module_voltage": ErrorCode(
        "A joint module's supply is too low or high.", "Battery or cable.", "Check them."
    ),
    "module_sensor": ErrorCode(
        "A joint module's sensor failed.", "Encoder or cable.", "Replace the module."
    ),
    "module_fault": ErrorCode(
        "A joint module is in a fault.", "See its cause.", "Remove the cause, then clear."
    ),
    "module_emergency": ErrorCode(
        "A joint module is stopped.", "An emergency on the bus.", "Clear, then arm."
    ),
}

REFUSAL_CODES = {
    # --- commands and other samples
    "no_lease": ErrorCode(
        "The command lease is not held.", "It expired, or was never acquired.", "Acquire it."
    ),
    "wrong_epoch": ErrorCode(
        "The command is of another lease.", "Another controller took it.", "Acquire it again."
    ),
    "replayed": ErrorCode(
        "The sequence number is not new.", "A repeated or reordered command.", "Count it up."
    ),
    "from_the_future": ErrorCode(
        "The command answers a later tick.", "A wrong tick.", "Copy it from the state."
    ),
    "stale": ErrorCode(
        "The command answers a state that is too old.", "A slow controller.", "Compute faster."
    ),
    "wrong_layout": ErrorCode(
        "The command is for another joint layout.", "Another robot file.", "Read the description."
    ),
    "wrong_length": ErrorCode(
        "A list has the wrong length.", "Another number of joints.", "Read the description."
    ),
    "wrong_mode": ErrorCode(
        "A joint does not have this mode.", "See the description.", "Use another mode."
    ),
    "not_finite": ErrorCode(
        "A target is NaN or infinite.", "A division by zero.", "Check the controller."
    ),
    "before_arming": ErrorCode(
        "The command is of an earlier arm session.",
        "It was sent before the robot was armed.",
        "Send the next one.",
    ),
    "unknown_message": ErrorCode(
        "The sample is another message.", "A wrong encoding.", "See schemas/keys.md."
    ),
    "unknown_version": ErrorCode(
        "The message has another version.", "Two versions of SnakeSIM.", "Update one."
    ),
    "malformed": ErrorCode(
        "The sample cannot be decoded, or is out of bounds.", "A wrong value.", "Correct it."
    ),
    "unknown_key": ErrorCode("There is no such key.", "A misspelled key.", "See schemas/keys.md."),
    "no_rotation": ErrorCode(
        "A quaternion does not have norm 1.", "Not normalized.", "Normalize it."
    ),
    "no_path": ErrorCode(
        "A trajectory has too few points.", "Planning failed.", "Send at least two points."
    ),
    # --- requests
    "lease_held": ErrorCode(
        "Another controller holds the lease.", "Two controllers.", "End one, or raise priority."
    ),
    "not_holder": ErrorCode(
        "The lease of this epoch is not yours.", "It has changed hands.", "Acquire it again."
    ),
    "not_ready": ErrorCode(
        "A condition for arming is not met.",
        "The answer lists it.",
        "Correct it, then arm.",
        page="troubleshooting/not-armed.md",
    ),
    "not_checked": ErrorCode(
        "The joints of a real robot were not checked.",
        "A new robot file.",
        "Check the joints.",
        page="troubleshooting/calibration-missing.md",
    ),
    "cable": ErrorCode(
        "A cable is wound too far, or this is unknown.", "A joint without end stops.", "Unwind it."
    ),
    "settings_differ": ErrorCode(
        "A service has other settings than the host.", "Two versions of a file.", "Restart it."
    ),
    "wrong_state": ErrorCode(
        "Not possible in this state.", "See the lifecycle in the answer.", "Change the state."
    ),
    "wrong_robot": ErrorCode(
        "The request names another robot.", "A wrong machine.", "Name the right robot."
    ),
    "wrong_backend": ErrorCode(
        "The request names another backend.", "Simulation or hardware.", "Name the right one."
    ),
    "wrong_config": ErrorCode(
        "The request names another configuration.", "The run changed.", "Read the description."
    ),
    "wrong_host": ErrorCode(
        "The request names another host.", "The host restarted.", "Read the description again."
    ),
    "not_simulated": ErrorCode(
        "Time cannot be changed here.", "The robot is real.", "Use a simulated robot."
    ),
    "wrong_clock_mode": ErrorCode(
        "The clock mode has no speed.", "It is not realtime.", "Use --clock-mode realtime."
    ),
    "not_allowed": ErrorCode(
        "This run does not allow it.",
        "Faults were not allowed.",
        "See docs/how-to/inject-faults.md.",
    ),
    "not_permitted": ErrorCode(
        "The operating system refuses it.", "A missing capability.", "Run as root."
    ),
    "unknown_fault": ErrorCode(
        "There is no such fault.", "A misspelled kind.", "List the kinds of faults."
    ),
    "cannot": ErrorCode(
        "This fault cannot be injected here.",
        "The backend does not support it.",
        "Use another one.",
    ),
    "wrong_part": ErrorCode(
        "Another process carries this fault out.", "A wrong key.", "Send it to that process."
    ),
    "wrong_controller": ErrorCode(
        "Another controller runs.", "A different run.", "Read the present parameters."
    ),
    "bad_parameters": ErrorCode(
        "The controller refuses the parameters.", "A wrong value.", "See the answer's reason."
    ),
}
