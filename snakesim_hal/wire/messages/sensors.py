"""Samples of the joints, of contacts, of motion capture, of IMUs and of the power supply."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import ONE_PER_JOINT, Message
from snakesim_hal.wire.quantities import describe


class JointState(Message, frozen=True, kw_only=True):
    """`sensor/joints`: every joint at one moment."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    angle_rad: Annotated[
        q.Angles, describe("positive: yaw to the left, pitch downwards, seen towards the head")
    ]
    velocity_rad_s: Annotated[q.AngularVelocities, describe(ONE_PER_JOINT)]
    torque_nm: Annotated[
        q.Torques,
        describe(
            "of the motor, positive towards positive angles (0 of a joint that does not measure it)"
        ),
    ]
    valid: Annotated[q.Flags, describe("false: its numbers are outdated, and must not be used")]
    age_ns: Annotated[q.Ages, describe("how long before `timestamp_ns` each joint was measured")]

    def has_joint_count(self, joint_count: int) -> bool:
        """Return whether every list has an entry for each of so many joints."""
        return (
            len(self.angle_rad) == joint_count
            and len(self.velocity_rad_s) == joint_count
            and len(self.torque_nm) == joint_count
            and len(self.valid) == joint_count
            and len(self.age_ns) == joint_count
        )


class Contact(Message, frozen=True, kw_only=True):
    """One contact of a link with an obstacle (not the ground); all vectors in the link's frame."""

    link: Annotated[q.LinkIndex, describe("number of the link, from 0 at the tail")]
    obstacle: Annotated[
        q.Name | None, describe("touched obstacle; null: the sensor does not identify it")
    ]
    position_l: q.Vector
    normal_l: Annotated[q.UnitVector, describe("from the obstacle into the body")]
    tangent_1_l: Annotated[q.UnitVector, describe("across the normal, towards the head")]
    tangent_2_l: Annotated[q.UnitVector, describe("across both")]
    force_l: Annotated[q.ForceVector, describe("on the body")]
    torque_l: Annotated[q.TorqueVector, describe("on the body about the contact point")]


class Contacts(Message, frozen=True, kw_only=True):
    """`sensor/contacts`: all contacts at one moment; an empty list means no contact."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    contacts: Annotated[list[Contact], Meta(max_length=q.MAX_CONTACTS)]
    measured_force_n: Annotated[
        q.Force | None,
        describe(
            "largest force of one obstacle on one link, as a mean over the last 50 ms; null: not measured"
        ),
    ] = None


class Imu(Message, frozen=True, kw_only=True):
    """`sensor/imu`: one entry a link that carries an IMU, at its middle, in the link's frame."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    link: Annotated[
        list[q.LinkIndex],
        Meta(max_length=q.MAX_JOINTS + 1),
        describe("their numbers, from 0 at the tail"),
    ]
    angular_velocity_rad_s: Annotated[
        list[q.AngularVelocityVector], Meta(max_length=q.MAX_JOINTS + 1)
    ]
    acceleration_m_s2: Annotated[
        list[q.AccelerationVector],
        Meta(max_length=q.MAX_JOINTS + 1),
        describe("specific force: at rest 1 g upwards"),
    ]


class Pose(Message, frozen=True, kw_only=True):
    """`sensor/pose`: pose of the base (tail end of link 0) from motion capture."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    position_w: q.Vector
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector
    angular_velocity_w: q.AngularVelocityVector


class Power(Message, frozen=True, kw_only=True):
    """`sensor/power`: supply and health of the joint modules, one entry a joint."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    voltage_v: Annotated[list[q.Voltage], Meta(max_length=q.MAX_JOINTS)]
    current_a: Annotated[list[q.Current], Meta(max_length=q.MAX_JOINTS)]
    motor_c: Annotated[
        list[q.Temperature], Meta(max_length=q.MAX_JOINTS), describe("of the winding")
    ]
    board_c: Annotated[
        list[q.Temperature], Meta(max_length=q.MAX_JOINTS), describe("of the electronics")
    ]
    leak: Annotated[q.Flags, describe("true: water inside")]
    valid: Annotated[q.Flags, describe("false: the state of this module is unknown")]
