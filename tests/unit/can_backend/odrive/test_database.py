"""Our ODrive messages equal those of the database of ODrive, read by cantools: ids, layouts, types and states.

`odrive-cansimple.dbc` holds the messages of one axis from ODrive Robotics' file of that name (repository
odriverobotics/ODrive, MIT license), which is of firmware 0.5.6. It does not contain what 0.6 added or
changed (version, errors, temperature). The error bits were compared with the enumeration of PyPI's `odrive` 0.6.11.
"""

from pathlib import Path
from typing import Any

import cantools
import pytest

from snakesim_can_backend.odrive.protocol import (
    FROM_HOST,
    PAYLOADS,
    AxisState,
    ControlMode,
    MessageId,
    encode_message,
    encode_request,
    split_id,
)
from snakesim_can_backend.protocol.definitions import CanFrame

DATABASE: Any = cantools.database.load_file(Path(__file__).with_name("odrive-cansimple.dbc"))
EXAMPLES = {
    MessageId.HEARTBEAT: ("Heartbeat", {"Axis_Error": 5, "Axis_State": 8}),
    MessageId.SET_STATE: ("Set_Axis_State", {"Axis_Requested_State": 8}),
    MessageId.MOTION: ("Get_Encoder_Estimates", {"Pos_Estimate": 1.5, "Vel_Estimate": -0.25}),
    MessageId.SET_MODE: ("Set_Controller_Mode", {"Control_Mode": 3, "Input_Mode": 1}),
    MessageId.SET_POSITION: (
        "Set_Input_Pos",
        {"Input_Pos": -2.5, "Vel_FF": 0.125, "Torque_FF": -0.5},
    ),
    MessageId.SET_VELOCITY: ("Set_Input_Vel", {"Input_Vel": 3.0, "Input_Torque_FF": -0.75}),
    MessageId.SET_TORQUE: ("Set_Input_Torque", {"Input_Torque": -1.25}),
    MessageId.SET_LIMITS: ("Set_Limits", {"Velocity_Limit": 2.0, "Current_Limit": 7.5}),
    MessageId.CURRENT: ("Get_Iq", {"Iq_Setpoint": 1.0, "Iq_Measured": -2.0}),
    MessageId.SUPPLY: ("Get_Bus_Voltage_Current", {"Bus_Voltage": 24.0, "Bus_Current": 0.5}),
    MessageId.SET_POSITION_GAIN: ("Set_Pos_Gain", {"Pos_Gain": 40.0}),
    MessageId.SET_VELOCITY_GAINS: ("Set_Vel_Gains", {"Vel_Gain": 0.5, "Vel_Integrator_Gain": 0.25}),
}
SCALES = {"Vel_FF": 1000, "Torque_FF": 1000}  # integers in units of 0.001


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: message.name)
def test_odrive_database_and_our_codec_read_each_other(message: MessageId) -> None:
    name, values = EXAMPLES[message]
    database_message = DATABASE.get_message_by_name(f"Axis0_{name}")
    our_values = [
        round(value * SCALES[key]) if key in SCALES else value for key, value in values.items()
    ]
    padding = [0, 0] if message is MessageId.HEARTBEAT else []
    frame = encode_message(0, message, *our_values, *padding)
    decoded = database_message.decode(frame.data.ljust(8, b"\0"), decode_choices=False)
    assert frame.id == database_message.frame_id
    assert {key: decoded[key] for key in values} == pytest.approx(values)
    data = database_message.encode({signal.name: 0 for signal in database_message.signals} | values)
    assert PAYLOADS[message].unpack(data[: PAYLOADS[message].size])[
        : len(our_values)
    ] == pytest.approx(our_values)


def test_odrive_messages_without_data_equal_the_database() -> None:
    assert (
        DATABASE.get_message_by_name("Axis0_Clear_Errors").frame_id
        == encode_message(0, MessageId.CLEAR_ERRORS).id
    )
    assert encode_message(0, MessageId.CLEAR_ERRORS) == CanFrame(24, b"")
    assert encode_request(3, MessageId.MOTION) == CanFrame(3 << 5 | 9, b"")
    assert split_id(CanFrame(62 << 5 | 0x1B, b"")) == (62, MessageId.SET_VELOCITY_GAINS)


def test_odrive_states_modes_and_senders_equal_the_database() -> None:
    states = (
        DATABASE.get_message_by_name("Axis0_Heartbeat").get_signal_by_name("Axis_State").choices
    )
    assert states[AxisState.IDLE].name == "IDLE"
    assert states[AxisState.CLOSED_LOOP].name == "CLOSED_LOOP_CONTROL"
    modes = (
        DATABASE.get_message_by_name("Axis0_Set_Controller_Mode")
        .get_signal_by_name("Control_Mode")
        .choices
    )
    assert [modes[mode].name for mode in ControlMode] == [
        "TORQUE_CONTROL",
        "VELOCITY_CONTROL",
        "POSITION_CONTROL",
    ]
    database_messages = {
        message: DATABASE.get_message_by_name(f"Axis0_{name}")
        for message, (name, _) in EXAMPLES.items()
    }
    host_messages = {
        message
        for message, database_message in database_messages.items()
        if "Master" in database_message.senders
    }
    assert host_messages == FROM_HOST - {MessageId.ESTOP, MessageId.CLEAR_ERRORS}
