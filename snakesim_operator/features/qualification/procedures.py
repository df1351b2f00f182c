"""Names the procedure of every step."""

from collections.abc import Callable, Mapping

from snakesim_operator.features.qualification import motion_procedures, stop_procedures
from snakesim_operator.features.qualification.assistant import Assistant
from snakesim_operator.features.qualification.protocol.checks import Check
from snakesim_operator.features.qualification.protocol.steps import StepKey
from snakesim_operator.features.qualification.rig import Rig

PROCEDURES: Mapping[StepKey, Callable[[Rig, Assistant], list[Check]]] = {
    "identity": motion_procedures.check_identity,
    "configuration": motion_procedures.check_configuration,
    "limits": motion_procedures.check_limits,
    "motion": motion_procedures.check_motion,
    "torque": motion_procedures.check_torque,
    "watchdog": stop_procedures.check_watchdog,
    "freeze": stop_procedures.check_freeze,
    "unplug": stop_procedures.check_unplug,
    "supply": stop_procedures.check_supply,
    "estop_key": stop_procedures.check_estop_key,
    "estop_network": stop_procedures.check_estop_network,
    "estop_relay": stop_procedures.check_estop_relay,
    "restart": stop_procedures.check_restart,
}
