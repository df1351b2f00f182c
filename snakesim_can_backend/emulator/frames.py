"""Readers and writers of a module's frames, as functions of raw numbers."""

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import ModuleFault, Opcode

_layouts = load_layouts()
_setpoint = _layouts[Opcode.SET_POINT].signals
STEPS = (0.0, *(_setpoint[name].scale for name in ("position", "velocity", "torque")))
LIMIT_STEP = _setpoint["torque_limit"].scale
LENGTHS: dict[int, int] = {opcode: _layouts[opcode].length for opcode in Opcode}
read_sync = _layouts[Opcode.SYNC].make_reader("count", "time")
read_command = _layouts[Opcode.COMMAND].make_reader("action", "key")
read_setpoint = _layouts[Opcode.SET_POINT].make_reader("mode", "count", "position", "torque_limit")
write_joint_state = _layouts[Opcode.JOINT_STATE].make_writer("angle", "velocity", "torque", "count", "state", "derated")
_touch = ("force_x", "force_y", "force_z", "along", "bearing", "touched", "count")
write_contact = _layouts[Opcode.CONTACT].make_writer(*_touch)
write_tail_contact = _layouts[Opcode.TAIL_CONTACT].make_writer(*_touch)
write_gyro = _layouts[Opcode.GYRO].make_writer("rate_x", "rate_y", "rate_z", "count")
write_acceleration = _layouts[Opcode.ACCELEROMETER].make_writer(
    "acceleration_x", "acceleration_y", "acceleration_z", "count"
)
write_shaft_load = _layouts[Opcode.SHAFT_LOAD].make_writer("torque", "count")
write_heartbeat = _layouts[Opcode.HEARTBEAT].make_writer(
    "state", "mode", "last_stop", *(f"fault_{fault.name.lower()}" for fault in ModuleFault), "uptime"
)
write_health = _layouts[Opcode.HEALTH].make_writer(
    "voltage", "current", "motor_temperature", "board_temperature", "leak", "water"
)
write_identity = _layouts[Opcode.IDENTITY].make_writer(
    "serial", "firmware_major", "firmware_minor", "protocol", "emulated", "stepped"
)
