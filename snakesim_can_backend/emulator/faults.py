"""Injected faults of an emulated joint module: those faults of a joint that a module can have.

The vocabulary is that of `snakesim_hal.model.fault_kinds`, with times since the emulators were started:
`mute:joint_3@2.0-3.5` is a module that sends nothing for 1.5 s. In a terminal it is `mute joint_3`, and later
`mute joint_3 off`: see `snakesim_drivers.emulation.emulator_control`.
"""

from collections.abc import Mapping

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model import fault_kinds
from snakesim_hal.model.fault_kinds import FAULT_KINDS, FaultInjection

# What each kind does to a module.
FAULT_DESCRIPTIONS: Mapping[str, str] = {
    name: kind.module_description or kind.description
    for name, kind in FAULT_KINDS["joint"].items()
    if "module" in kind.executors
}
FAULT_NOTATION = "KIND:JOINT@START or KIND:JOINT@START-END, in seconds, such as mute:joint_3@2.0 or leak:joint_1@1-4"


def parse_fault(text: str, joint_count: int) -> FaultInjection:
    """Return the fault that a text describes in the notation of FORM.

    Args:
        text: The description.
        joint_count: Number of joints of the robot.

    Raises:
        ConfigError: The text has another form, or modules of this robot do not support the fault.
    """
    return validate_fault(fault_kinds.parse_injection(text), joint_count)


def validate_fault(fault: FaultInjection, joint_count: int) -> FaultInjection:
    """Return the same fault. Raises ConfigError if modules of a robot with this many joints do not support it."""
    if fault.target_type != "joint" or fault.kind not in FAULT_DESCRIPTIONS:
        raise ConfigError(
            f"fault {str(fault)!r}: modules support {', '.join(FAULT_DESCRIPTIONS)}, as {FAULT_NOTATION}; put other "
            f"kinds into the scenario's `faults`",
            code="injection/unknown-fault",
        )
    fault_kinds.validate_injection_targets(
        [fault], services=(), joint_count=joint_count, bus_count=0
    )
    return fault


def describe_faults() -> str:
    """Return every kind with its description, one a line, for a command's help."""
    return "\n".join(
        f"  {kind:<13} {description}" for kind, description in FAULT_DESCRIPTIONS.items()
    )
