"""A second program that reads one joint module."""

from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.bus.request import request_response
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import (
    FIRST_NODE,
    FROM_HOST,
    CanFrame,
    CommandAction,
    LastStop,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
    ParameterResult,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.kit.drive_probe import DriveProbe, DriveStatus, ReadBack
from snakesim_hal.model.scenario import RunConfig

DRIVING_STATES = (ModuleState.ARMED, ModuleState.STOPPING)
TOLERANCE = 0.001  # of single precision, and of the step of a parameter


class ModuleProbe(DriveProbe):
    """Reads the heartbeat and the parameters of the first module of a robot."""

    def __init__(self, config: RunConfig, settings: CanSettings) -> None:
        """Open the bus of the module.

        Args:
            config: Configuration of the run.
            settings: Settings of the backend.
        """
        self._joint = config.robot.joint_table[0]
        self._settings = settings
        from_modules = frozenset(Opcode) - FROM_HOST
        self._wire = open_wire(settings.channels[0], from_modules, settings.bit_rate)

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Request the identity, and return the state in the next heartbeat, which a change of state sends at once."""
        layout = load_layouts()[Opcode.HEARTBEAT]

        def decode(frame: CanFrame) -> DriveStatus | None:
            if (parse_opcode(frame.id), parse_node(frame.id)) != (Opcode.HEARTBEAT, FIRST_NODE):
                return None
            values = layout.decode(frame.data)
            state = ModuleState(int(values["state"]))
            last_stop = LastStop(int(values["last_stop"]))
            return DriveStatus(
                state in DRIVING_STATES,
                f"{state.name.lower()}, last stop: {last_stop.name.lower()}",
            )

        return request_response(self._wire, make_command(CommandAction.IDENTIFY), decode, timeout_s)

    def read_configuration(self, timeout_s: float) -> list[ReadBack]:
        """Read the watchdog and the limits that the driver has written. A host that runs reports a second host."""
        gear = self._joint.drive.gear
        limits = self._joint.limits
        required = (
            (ModuleParameter.WATCHDOG, "s", self._settings.watchdog_s),
            (ModuleParameter.TORQUE_LIMIT, "N·m", limits.torque_nm / gear),
            (ModuleParameter.SPEED_LIMIT, "rad/s", limits.speed_rad_s * gear),
        )
        return [
            ReadBack(
                parameter.name.lower(),
                unit,
                value,
                self._read_parameter(parameter, timeout_s),
                TOLERANCE,
            )
            for parameter, unit, value in required
        ]

    def close(self) -> None:
        """Leave the bus."""
        self._wire.close()

    def _read_parameter(self, parameter: ModuleParameter, timeout_s: float) -> float | None:
        layout = load_layouts()[Opcode.PARAMETER_ANSWER]

        def decode(frame: CanFrame) -> float | None:
            if (parse_opcode(frame.id), parse_node(frame.id)) != (
                Opcode.PARAMETER_ANSWER,
                FIRST_NODE,
            ):
                return None
            values = layout.decode(frame.data)
            is_answer = (
                int(values["index"]) == parameter and int(values["result"]) == ParameterResult.DONE
            )
            return float(values["value"]) if is_answer else None

        return request_response(self._wire, _make_request(parameter), decode, timeout_s)


def _make_request(parameter: ModuleParameter) -> CanFrame:
    layout = load_layouts()[Opcode.PARAMETER_REQUEST]
    return layout.encode(FIRST_NODE, index=parameter, operation=ParameterOperation.READ, value=0.0)
