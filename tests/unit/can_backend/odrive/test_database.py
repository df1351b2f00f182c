"""Our messages against ODrive's own database, read by cantools: the same ids, places, types and states.

`odrive-cansimple.dbc` holds the messages of one axis from ODrive Robotics' file of that name (repository
odriverobotics/ODrive, MIT license), which is of firmware 0.5.6. It lacks what 0.6 added or changed (version, errors,
temperature); of those the error bits were compared with the enumeration of PyPI's `odrive` 0.6.11.
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
SAME = {
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
SCALED = {"Vel_FF": 1000, "Torque_FF": 1000}  # integers by 0.001


@pytest.mark.parametrize("message", SAME, ids=lambda message: message.name)
def test_odrive_database_and_our_codec_read_each_other(message: MessageId) -> None:
    name, values = SAME[message]
    theirs = DATABASE.get_message_by_name(f"Axis0_{name}")
    ours = [round(value * SCALED[key]) if key in SCALED else value for key, value in values.items()]
    spare = [0, 0] if message is MessageId.HEARTBEAT else []
    frame = encode_message(0, message, *ours, *spare)
    read = theirs.decode(frame.data.ljust(8, b"\0"), decode_choices=False)
    assert frame.id == theirs.frame_id
    assert {key: read[key] for key in values} == pytest.approx(values)
    data = theirs.encode({signal.name: 0 for signal in theirs.signals} | values)
    assert PAYLOADS[message].unpack(data[: PAYLOADS[message].size])[: len(ours)] == pytest.approx(
        ours
    )


def test_messages_without_data_and_ids_of_other_axes_are_theirs() -> None:
    assert (
        DATABASE.get_message_by_name("Axis0_Clear_Errors").frame_id
        == encode_message(0, MessageId.CLEAR_ERRORS).id
    )
    assert encode_message(0, MessageId.CLEAR_ERRORS) == CanFrame(24, b"")
    assert encode_request(3, MessageId.MOTION) == CanFrame(3 << 5 | 9, b"")
    assert split_id(CanFrame(62 << 5 | 0x1B, b"")) == (62, MessageId.SET_VELOCITY_GAINS)


def test_states_modes_and_senders_are_theirs() -> None:
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
    assert [modes[one].name for one in ControlMode] == [
        "TORQUE_CONTROL",
        "VELOCITY_CONTROL",
        "POSITION_CONTROL",
    ]
    theirs = {
        message: DATABASE.get_message_by_name(f"Axis0_{name}")
        for message, (name, _) in SAME.items()
    }
    of_hosts = {message for message, described in theirs.items() if "Master" in described.senders}
    assert of_hosts == FROM_HOST - {MessageId.ESTOP, MessageId.CLEAR_ERRORS}
