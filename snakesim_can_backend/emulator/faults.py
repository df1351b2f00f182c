"""Injected faults of an emulated joint module: those faults of a joint that a module can have.

The vocabulary is that of `snakesim_hal.model.fault_kinds`, with times since the emulators were started:
`mute:joint_3@2.0-3.5` is a module that sends nothing for 1.5 s. In a terminal it is `mute joint_3`, and later `mute
joint_3 off`.
"""

import re
from collections.abc import Mapping

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model import fault_kinds as injection
from snakesim_hal.model.fault_kinds import KINDS, Injection

FAULT_DESCRIPTIONS: Mapping[str, str] = {
    name: kind.in_module or kind.about for name, kind in KINDS["joint"].items() if "module" in kind.by
}
FORM = "KIND:JOINT@START or KIND:JOINT@START-END, in seconds, such as mute:joint_3@2.0 or leak:joint_1@1-4"
_typed = re.compile(r"(?P<kind>[a-z_]+)[ :]+(?P<joint>joint_[0-9]+)(?: +(?P<off>off))?")


def parse_fault(text: str, joints: int) -> Injection:
    """A fault from its text. Raises ConfigError."""
    return check_fault(injection.parse(text), joints)


def parse_typed_fault(text: str, joints: int, now_s: float) -> tuple[Injection, bool]:
    """A fault as typed in a terminal, `mute joint_3 off`, and whether it begins. Raises ConfigError."""
    if len(text) > injection.LONGEST_TEXT:
        raise ConfigError(f"{text[:40]!r}...: {len(text)} characters, at most {injection.LONGEST_TEXT}")
    match = _typed.fullmatch(text.strip())
    if match is None:
        raise ConfigError(
            f"{text.strip()!r}: type KIND joint_N, and later KIND joint_N off. Kinds: {', '.join(FAULT_DESCRIPTIONS)}"
        )
    fault = injection.checked(Injection(match["kind"], match["joint"], now_s), text.strip())
    return check_fault(fault, joints), match["off"] is None


def format_typed_fault(fault: Injection, *, begins: bool) -> str:
    """A fault as `parse_typed` reads it."""
    return f"{fault.kind} {fault.target}" if begins else f"{fault.kind} {fault.target} off"


def check_fault(fault: Injection, joints: int) -> Injection:
    """The same fault, if modules of a robot support it. Raises ConfigError."""
    if fault.target_type != "joint" or fault.kind not in FAULT_DESCRIPTIONS:
        raise ConfigError(
            f"fault {str(fault)!r}: modules support {', '.join(FAULT_DESCRIPTIONS)}, as {FORM}; put other kinds into the "
            f"scenario's `faults`"
        )
    injection.check_targets([fault], services=(), joints=joints, buses=0)
    return fault


def describe_faults() -> str:
    """Every kind, for a command's help."""
    return "\n".join(f"  {kind:<13} {about}" for kind, about in FAULT_DESCRIPTIONS.items())
