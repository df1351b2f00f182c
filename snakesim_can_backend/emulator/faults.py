"""Injected faults of an emulated joint module: those faults of a joint that a module can have.

The vocabulary is that of `snakesim_hal.model.fault_kinds`, with times since the emulators were started:
`mute:joint_3@2.0-3.5` is a module that sends nothing for 1.5 s. In a terminal it is `mute joint_3`, and later `mute
joint_3 off`.
"""

import re
from collections.abc import Mapping

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model import fault_kinds as injection
from snakesim_hal.model.fault_kinds import FAULT_KINDS, FaultInjection

# What each kind does to a module.
FAULT_DESCRIPTIONS: Mapping[str, str] = {
    name: kind.module_description or kind.description
    for name, kind in FAULT_KINDS["joint"].items()
    if "module" in kind.executors
}
FAULT_NOTATION = "KIND:JOINT@START or KIND:JOINT@START-END, in seconds, such as mute:joint_3@2.0 or leak:joint_1@1-4"
MAX_SHOWN_CHARACTERS = 40  # of a text that is too long
TYPED_FAULT_PATTERN = re.compile(r"(?P<kind>[a-z_]+)[ :]+(?P<joint>joint_[0-9]+)(?: +(?P<off>off))?")


def parse_fault(text: str, joints: int) -> FaultInjection:
    """Return the fault that a text describes in the notation of FORM.

    Args:
        text: The description.
        joints: Number of joints of the robot.

    Raises:
        ConfigError: The text has another form, or modules of this robot do not support the fault.
    """
    return validate_fault(injection.parse_injection(text), joints)


def parse_typed_fault(text: str, joints: int, now_s: float) -> tuple[FaultInjection, bool]:
    """Parse a fault that a person has typed in a terminal, such as `mute joint_3` or `mute joint_3 off`.

    Args:
        text: Typed line.
        joints: Number of joints of the robot.
        now_s: Current time, at which the fault starts or ends.

    Returns:
        The fault, and whether it starts (True) or ends (False).

    Raises:
        ConfigError: The text has another form, or modules of this robot do not support the fault.
    """
    if len(text) > injection.MAX_TEXT_LENGTH:
        raise ConfigError(
            f"{text[:MAX_SHOWN_CHARACTERS]!r}...: {len(text)} characters, at most {injection.MAX_TEXT_LENGTH}",
            code="injection/unknown-fault",
        )
    match = TYPED_FAULT_PATTERN.fullmatch(text.strip())
    if match is None:
        kinds = ", ".join(FAULT_DESCRIPTIONS)
        raise ConfigError(
            f"{text.strip()!r}: type KIND joint_N, and later KIND joint_N off. Kinds: {kinds}",
            code="injection/unknown-fault",
        )
    fault = injection.validate_and_complete_injection(
        FaultInjection(match["kind"], match["joint"], now_s), text.strip()
    )
    begins = match["off"] is None
    return validate_fault(fault, joints), begins


def format_typed_fault(fault: FaultInjection, *, begins: bool) -> str:
    """Return the text of a fault that `parse_typed_fault` reads."""
    if begins:
        return f"{fault.kind} {fault.target}"
    return f"{fault.kind} {fault.target} off"


def validate_fault(fault: FaultInjection, joints: int) -> FaultInjection:
    """Return the same fault. Raises ConfigError if modules of a robot with this many joints do not support it."""
    if fault.target_type != "joint" or fault.kind not in FAULT_DESCRIPTIONS:
        raise ConfigError(
            f"fault {str(fault)!r}: modules support {', '.join(FAULT_DESCRIPTIONS)}, as {FAULT_NOTATION}; put other "
            f"kinds into the scenario's `faults`",
            code="injection/unknown-fault",
        )
    injection.validate_injection_targets([fault], services=(), joints=joints, buses=0)
    return fault


def describe_faults() -> str:
    """Return every kind with its description, one a line, for a command's help."""
    return "\n".join(f"  {kind:<13} {description}" for kind, description in FAULT_DESCRIPTIONS.items())
