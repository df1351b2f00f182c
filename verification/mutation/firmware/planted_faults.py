"""The planted faults: each breaks one promise that a joint module makes.

The promises are those of docs/reference/can-modules.md and docs/reference/can-protocol.md. Each fault replaces one
place of one file in `snakesim_native/joint_module/firmware`.
"""

from dataclasses import dataclass
from pathlib import Path

from snakesim_native.libraries import PACKAGE
from verification.mutation.firmware.faulty_copy import FIRMWARE_FOLDER


@dataclass(frozen=True, kw_only=True)
class PlantedFault:
    """One error in the firmware.

    Attributes:
        name: What the faulty firmware does.
        promise: The rule of the specification that it breaks.
        file: File of the firmware.
        original: Text that occurs exactly once in that file.
        faulty: Text that replaces it.
    """

    name: str
    promise: str
    file: str
    original: str
    faulty: str

    def make_source(self) -> str:
        """Return the content of the file with the fault.

        Raises:
            ValueError: The original text does not occur exactly once, because the firmware has been changed.
        """
        source = read_firmware_file(self.file)
        count = source.count(self.original)
        if count != 1:
            raise ValueError(
                f"{self.name}: its original text occurs {count} times in {self.file}, not once"
            )
        return source.replace(self.original, self.faulty)


def read_firmware_file(file: str) -> str:
    """Return the content of a file of the firmware."""
    return Path(PACKAGE, FIRMWARE_FOLDER, file).read_text(encoding="utf-8")


WATCHDOG_FAULTS = (
    PlantedFault(
        name="no_watchdog",
        promise="without setpoints, an armed module is in FAULT after the time of its watchdog",
        file="joint_module.c",
        original="if (now_us >= module->watchdog_fed_us + watchdog_us) {",
        faulty="if (now_us == UINT64_MAX) {",
    ),
    PlantedFault(
        name="doubled_watchdog",
        promise="the time of the watchdog is the parameter `watchdog`",
        file="joint_module.c",
        original="now_us >= module->watchdog_fed_us + watchdog_us",
        faulty="now_us >= module->watchdog_fed_us + 2 * watchdog_us",
    ),
    PlantedFault(
        name="any_frame_feeds_watchdog",
        promise="Syncs, Commands and parameters do not feed the watchdog",
        file="joint_module.c",
        original="    switch (opcode) {\n    case JM_OPCODE_COMMAND:\n        receive_command",
        faulty="    jm_feed_watchdog(module, now_us);\n"
        "    switch (opcode) {\n    case JM_OPCODE_COMMAND:\n        receive_command",
    ),
    PlantedFault(
        name="setpoints_without_sync_feed_watchdog",
        promise="only the first setpoint after a Sync feeds the watchdog",
        file="joint_module.c",
        original="if (module->has_sync_since_setpoint) {",
        faulty="if (true) {",
    ),
    PlantedFault(
        name="bridge_watchdog_fed_by_timer",
        promise="the hardware watchdog of the bridge is fed by setpoints, never by a timer",
        file="joint_module.c",
        original="    jm_latch_new_faults(module, now_us);\n    check_times",
        faulty="    module->is_bridge_feed_due = true;\n"
        "    jm_latch_new_faults(module, now_us);\n    check_times",
    ),
    PlantedFault(
        name="watchdog_of_ten_seconds",
        promise="a watchdog above 0.1 s is refused",
        file="parameters.c",
        original="[JM_WATCHDOG] = {0.02, 0.1, false, true}",
        faulty="[JM_WATCHDOG] = {0.02, 10.0, false, true}",
    ),
)

FRAME_FAULTS = (
    PlantedFault(
        name="ignores_checksum_of_setpoints",
        promise="a SetPoint with a wrong checksum is ignored",
        file="joint_module.c",
        original="frame->length != JM_SET_POINT_BYTES || !jm_has_valid_checksum(frame)",
        faulty="frame->length != JM_SET_POINT_BYTES",
    ),
    PlantedFault(
        name="accepts_stale_setpoints",
        promise="a setpoint whose counter does not follow the one before is dropped",
        file="joint_module.c",
        original="return is_first || lost_setpoints <= MAX_LOST_SETPOINTS;",
        faulty="return is_first || lost_setpoints <= COUNTER_MASK;",
    ),
    PlantedFault(
        name="follows_setpoints_of_other_nodes",
        promise="a module follows only the setpoints for its own node",
        file="joint_module.c",
        original="    case JM_OPCODE_PARAMETER_REQUEST:\n        return node == module->config.node;",
        faulty="    case JM_OPCODE_PARAMETER_REQUEST:\n        return node != JM_BROADCAST;",
    ),
)

STATE_FAULTS = (
    PlantedFault(
        name="setpoint_arms",
        promise="only the Command arm enables the motor",
        file="joint_module.c",
        original="    if (module->state != JM_ARMED) {\n        return;",
        faulty="    if (module->state == JM_DISARMED) {\n        jm_execute_action(module, 1, now_us);\n    }\n"
        "    if (module->state != JM_ARMED) {\n        return;",
    ),
    PlantedFault(
        name="arms_without_check",
        promise="a module does not arm while the cause of a fault is present",
        file="states.c",
        original="        if (detect_faults(module) == 0) {\n            module->has_sync_since_setpoint",
        faulty="        if (true) {\n            module->has_sync_since_setpoint",
    ),
    PlantedFault(
        name="arms_from_fault",
        promise="a fault is latched: arm has no effect until it is cleared",
        file="states.c",
        original="            enter_state(module, JM_ARMED, PASSIVE_DEMAND, now_us);\n        }\n        break;\n"
        "    case JM_BOOT:\n    case JM_ARMED:\n    case JM_STOPPING:\n    case JM_FAULT:\n    case JM_EMERGENCY:\n"
        "        break;",
        faulty="            enter_state(module, JM_ARMED, PASSIVE_DEMAND, now_us);\n        }\n        break;\n"
        "    case JM_FAULT:\n        enter_state(module, JM_ARMED, PASSIVE_DEMAND, now_us);\n        break;\n"
        "    case JM_BOOT:\n    case JM_ARMED:\n    case JM_STOPPING:\n    case JM_EMERGENCY:\n"
        "        break;",
    ),
    PlantedFault(
        name="clear_ignores_present_cause",
        promise="clear has no effect while the cause of a fault is present",
        file="states.c",
        original="        if (detect_faults(module) == 0) {\n            module->faults = 0;",
        faulty="        if (true) {\n            module->faults = 0;",
    ),
    PlantedFault(
        name="clear_arms_again",
        promise="clear leads to DISARMED, and enables nothing",
        file="states.c",
        original="module->faults = 0;\n            enter_state(module, JM_DISARMED",
        faulty="module->faults = 0;\n            enter_state(module, JM_ARMED",
    ),
    PlantedFault(
        name="restart_keeps_armed",
        promise="a reboot does not enable the motor",
        file="states.c",
        original="    module->state = JM_BOOT;\n    module->state_after_boot = JM_DISARMED;",
        faulty="    module->state_after_boot = jm_is_driven(module) ? JM_ARMED : JM_DISARMED;\n"
        "    module->state = JM_BOOT;",
    ),
    PlantedFault(
        name="ignores_stop",
        promise="after the Command stop, a module comes to rest and is disarmed",
        file="states.c",
        original="ACTION_STOP = 3",
        faulty="ACTION_STOP = 7",
    ),
    PlantedFault(
        name="brakes_without_end",
        promise="STOPPING lasts at most the time of the watchdog",
        file="joint_module.c",
        original="is_at_rest || now_us >= module->stopping_start_us + watchdog_us",
        faulty="is_at_rest",
    ),
    PlantedFault(
        name="ignores_emergency_for_all",
        promise="an Emergency to all modules stops each of them",
        file="joint_module.c",
        original="    case JM_OPCODE_EMERGENCY:\n    case JM_OPCODE_COMMAND:\n        return node == JM_BROADCAST ||",
        faulty="    case JM_OPCODE_EMERGENCY:\n        return node == module->config.node;\n"
        "    case JM_OPCODE_COMMAND:\n        return node == JM_BROADCAST ||",
    ),
    PlantedFault(
        name="bridge_on_in_fault",
        promise="the bridge of the motor is off in FAULT",
        file="joint_module.c",
        original="    case JM_STOPPING:\n        return true;\n"
        "    case JM_BOOT:\n    case JM_DISARMED:\n    case JM_FAULT:",
        faulty="    case JM_STOPPING:\n    case JM_FAULT:\n        return true;\n"
        "    case JM_BOOT:\n    case JM_DISARMED:",
    ),
    PlantedFault(
        name="disarm_keeps_torque",
        promise="the Command disarm switches the motor off at once",
        file="states.c",
        original="        record_stop(module, JM_STOP_DISARM);\n"
        "        enter_state(module, JM_DISARMED, PASSIVE_DEMAND, now_us);",
        faulty="        record_stop(module, JM_STOP_DISARM);\n"
        "        module->stopping_start_us = now_us;\n"
        "        enter_state(module, JM_STOPPING, module->demand, now_us);",
    ),
)

MOTOR_FAULTS = (
    PlantedFault(
        name="ignores_torque_limit_of_setpoint",
        promise="the torque is at most the `torque_limit` of the setpoint",
        file="control.c",
        original="        module->demand.torque_limit_nm,\n",
        faulty="        module->parameters.values[JM_RATED_TORQUE],\n",
    ),
    PlantedFault(
        name="no_derating",
        promise="a hot module lowers its torque limit, down to a fifth",
        file="control.c",
        original="MIN_TORQUE_FRACTION = 0.2f",
        faulty="MIN_TORQUE_FRACTION = 1.0f",
    ),
    PlantedFault(
        name="derating_not_reported",
        promise="`derated` is 1 while heat reduces the torque",
        file="control.c",
        original="output.is_derated = output.torque_nm != requested_nm;",
        faulty="output.is_derated = false;",
    ),
    PlantedFault(
        name="position_in_milliradians",
        promise="a step of a position target is 0.0001 rad",
        file="joint_module.c",
        original="TARGET_STEP_RAD = 1e-4f",
        faulty="TARGET_STEP_RAD = 1e-3f",
    ),
)

HEALTH_FAULTS = (
    PlantedFault(
        name="ignores_low_voltage",
        promise="a supply below the minimum is a fault",
        file="states.c",
        original="sensors->voltage_mv < module->config.min_voltage_mv",
        faulty="sensors->voltage_mv < 0",
    ),
)

REPORT_FAULTS = (
    PlantedFault(
        name="answers_with_old_values",
        promise="a JointState contains the values at the Sync that it answers",
        file="joint_module.c",
        original="    module->sensors = *sensors;\n    if (frame->id",
        faulty="    if (opcode != JM_OPCODE_SYNC) {\n        module->sensors = *sensors;\n    }\n    if (frame->id",
    ),
    PlantedFault(
        name="answers_with_frozen_counter",
        promise="a JointState contains the counter of the Sync that it answers",
        file="reports.c",
        original="    jm_write_bits(&frame, 48, 4, count & COUNT_MASK);",
        faulty="    jm_write_bits(&frame, 48, 4, 0 * count);",
    ),
    PlantedFault(
        name="answers_under_another_node",
        promise="a module answers under the id of its own node",
        file="reports.c",
        original="jm_make_frame(JM_OPCODE_JOINT_STATE, module->config.node, 8)",
        faulty="jm_make_frame(JM_OPCODE_JOINT_STATE, JM_FIRST_NODE, 8)",
    ),
    PlantedFault(
        name="no_health",
        promise="a module reports voltage and temperatures twice per second",
        file="reports.c",
        original="    jm_write_bits(&frame, 49, 7, (uint32_t)jm_clamp(sensors->water_percent, 0, MAX_PERCENT));\n"
        "    jm_send(module, &frame);",
        faulty="    jm_write_bits(&frame, 49, 7, (uint32_t)jm_clamp(sensors->water_percent, 0, MAX_PERCENT));",
    ),
)

PARAMETER_FAULTS = (
    PlantedFault(
        name="flash_not_checked",
        promise="saved values that are out of range are replaced by those of a new module",
        file="parameters.c",
        original="RANGES[index].is_writable && clamp_to_range(&RANGES[index], &value)",
        faulty="RANGES[index].is_writable",
    ),
    PlantedFault(
        name="save_does_not_write_flash",
        promise="after `save`, the board is asked to write its flash memory",
        file="parameters.c",
        original="    module->is_flash_write_due = true;",
        faulty="    module->is_flash_write_due = false;",
    ),
)

PLANTED_FAULTS = (
    *WATCHDOG_FAULTS,
    *FRAME_FAULTS,
    *STATE_FAULTS,
    *MOTOR_FAULTS,
    *HEALTH_FAULTS,
    *REPORT_FAULTS,
    *PARAMETER_FAULTS,
)
