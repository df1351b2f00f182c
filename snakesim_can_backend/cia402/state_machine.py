"""The state machine of a drive, CiA 402: states in the statusword 6041h, commands in the controlword 6040h. Pure.

State of the drive        statusword       sent to enable it         motor
Not ready to switch on    xxxx x0xx 0000   nothing: it is starting   off
Switch on disabled        xxxx x1xx 0000   shutdown                  off
Ready to switch on        xx01 0001        switch on                 off
Switched on               xx01 0011        enable operation          off
Operation enabled         xx01 0111        enable operation          follows targets
Quick stop active         xx00 0111        disable voltage           brakes by 605Ah
Fault reaction active     xxxx x0xx 1111   nothing: it ends itself   brakes by 605Eh
Fault                     xxxx x0xx 1000   nothing: fault reset is   off
                                           the operator's

Only the operator's reset leads to a fault reset, and nothing enables a drive again that has left Operation enabled by
itself.
"""

from enum import IntEnum, StrEnum


class PowerState(StrEnum):
    """A state of the state machine."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "in a state that CiA 402 does not have"


FAULT_STATES = (PowerState.FAULT_REACTION, PowerState.FAULT)


class ControlwordCommand(IntEnum):
    """Commands in the controlword."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80  # works at the change from 0 to 1 of its bit


class OperationMode(IntEnum):
    """The modes of operation that the driver uses. Bit n - 1 of 6502h is whether a drive has mode n."""

    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10


def decode_statusword(word: int) -> PowerState:
    """Return the state that a statusword reports.

    Bits 0 to 3 and 6 of the word, and in the last four states also bit 5, are compared with the patterns of CiA 402
    (IEC 61800-7-201), object 6041h. All other bits are ignored.
    """
    match word & 0x4F:
        case 0x00:
            return PowerState.NOT_READY
        case 0x40:
            return PowerState.SWITCH_ON_DISABLED
        case 0x0F:
            return PowerState.FAULT_REACTION
        case 0x08:
            return PowerState.FAULT
        case _:
            pass
    match word & 0x6F:
        case 0x21:
            return PowerState.READY
        case 0x23:
            return PowerState.SWITCHED_ON
        case 0x27:
            return PowerState.ENABLED
        case 0x07:
            return PowerState.QUICK_STOP
        case _:
            return PowerState.UNKNOWN


def choose_next_controlword(state: PowerState) -> ControlwordCommand:
    """Return the controlword command that leads a drive one step towards Operation enabled."""
    match state:
        case PowerState.SWITCH_ON_DISABLED:
            return ControlwordCommand.SHUTDOWN
        case PowerState.READY:
            return ControlwordCommand.SWITCH_ON
        case PowerState.SWITCHED_ON | PowerState.ENABLED:
            return ControlwordCommand.ENABLE_OPERATION
        case _:
            return ControlwordCommand.DISABLE_VOLTAGE


def apply_controlword(state: PowerState, word: int, previous_word: int) -> PowerState:
    """Return the state that a drive enters when it receives a controlword (object 6040h).

    Args:
        state: Current state of the drive.
        word: Received controlword.
        previous_word: Last controlword before it: a fault is reset when the reset bit changes from 0 to 1.
    """
    if state == PowerState.FAULT:
        is_reset = bool(word & ~previous_word & ControlwordCommand.FAULT_RESET)
        return PowerState.SWITCH_ON_DISABLED if is_reset else state
    if state in (PowerState.FAULT_REACTION, PowerState.NOT_READY):
        return state
    if not word & 0x02:  # disable voltage
        return PowerState.SWITCH_ON_DISABLED
    if not word & 0x04:  # the quick stop bit is active low
        return _apply_quick_stop(state)
    match word & 0x0F:
        case 0x06 | 0x0E:  # shutdown
            return PowerState.READY
        case 0x07:  # switch on
            return _apply_switch_on(state)
        case _:  # 0x0F, enable operation
            return _apply_enable_operation(state)


def _apply_quick_stop(state: PowerState) -> PowerState:
    match state:
        case PowerState.ENABLED | PowerState.QUICK_STOP:
            return PowerState.QUICK_STOP
        case _:
            return PowerState.SWITCH_ON_DISABLED


def _apply_switch_on(state: PowerState) -> PowerState:
    match state:
        case PowerState.READY | PowerState.SWITCHED_ON | PowerState.ENABLED:
            return PowerState.SWITCHED_ON
        case _:
            return state


def _apply_enable_operation(state: PowerState) -> PowerState:
    match state:
        case PowerState.READY:
            return PowerState.SWITCHED_ON
        case PowerState.SWITCHED_ON | PowerState.ENABLED:
            return PowerState.ENABLED
        case _:
            return state


def encode_statusword(state: PowerState) -> int:
    """Return the statusword (object 6041h) of a state, as emulated drives send it.

    Only the bits that identify the state are set. An unknown state, which no emulated drive is in, is encoded as "not
    ready to switch on".

    Source: CiA 402 (IEC 61800-7-201), state bits of the statusword; see the table at the top of this file.
    """
    match state:
        case PowerState.NOT_READY | PowerState.UNKNOWN:
            return 0x0000
        case PowerState.SWITCH_ON_DISABLED:
            return 0x0040
        case PowerState.READY:
            return 0x0021
        case PowerState.SWITCHED_ON:
            return 0x0023
        case PowerState.ENABLED:
            return 0x0027
        case PowerState.QUICK_STOP:
            return 0x0007
        case PowerState.FAULT_REACTION:
            return 0x000F
        case PowerState.FAULT:
            return 0x0008
