"""Messages for which Foxglove has no schema, as JSON: state of host and controller, and contact forces; and its log."""

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, NamedTuple, Self

import msgspec
from foxglove_schemas_protobuf.Log_pb2 import Log

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Contacts
from snakesim_operator.recording.foxglove_messages.shapes import make_timestamp

OptionalNumber = float | msgspec.UnsetType
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


class RobotStateMessage(msgspec.Struct, frozen=True, kw_only=True):
    """The message on `/ROBOT/state`. Unknown texts are empty, unknown numbers are left out."""

    lifecycle: str
    lifecycle_reason: str
    locomotion: str
    reason: str
    propulsion_joint: str
    jammed: bool
    saturated: bool
    faults: int
    path_s_m: OptionalNumber = msgspec.UNSET
    propulsion_n: OptionalNumber = msgspec.UNSET
    propulsion_torque_nm: OptionalNumber = msgspec.UNSET
    torque_headroom_nm: OptionalNumber = msgspec.UNSET
    custom: dict[str, float] = {}


class ContactForcesMessage(msgspec.Struct, frozen=True, kw_only=True):
    """The message on `/ROBOT/contact_forces`: the force on each link in the link's frame, summed over its contacts.

    The links are in the order from tail to head.
    """

    along_n: list[float]
    left_n: list[float]
    up_n: list[float]

    @classmethod
    def sum_contacts(cls, contacts: Contacts, link_count: int) -> Self:
        """Return the sum of the contact forces on each link of a robot.

        Args:
            contacts: Contacts of one sample. Contacts of links that the robot does not have are ignored.
            link_count: Number of links of the robot.
        """
        along_n = [0.0] * link_count
        left_n = [0.0] * link_count
        up_n = [0.0] * link_count
        for contact in contacts.contacts:
            if contact.link < link_count:
                along_n[contact.link] += contact.force_l[0]
                left_n[contact.link] += contact.force_l[1]
                up_n[contact.link] += contact.force_l[2]
        return cls(along_n=along_n, left_n=left_n, up_n=up_n)


class _StatusFields(msgspec.Struct, frozen=True):
    """The fields of `hal/status` that are shown."""

    lifecycle: q.Name = ""
    reason: q.Reason = ""
    faults: Annotated[list[msgspec.Raw], msgspec.Meta(max_length=64)] = []


class _ControlFields(msgspec.Struct, frozen=True):
    """The fields of `control/state` that are shown."""

    state: q.Name = ""
    reason: q.Reason = ""
    propulsion_joint: q.Name | None = None
    path_s_m: q.Length | None = None
    propulsion_n: q.Force | None = None
    propulsion_torque_nm: q.Torque | None = None
    torque_headroom_nm: q.Torque | None = None
    reference_rad: q.Angles = []
    custom: Annotated[dict[q.Name, q.Scalar], msgspec.Meta(max_length=32)] = {}
    jammed: bool = False
    saturated: bool = False


_status_decoder = msgspec.msgpack.Decoder(_StatusFields)
_control_decoder = msgspec.msgpack.Decoder(_ControlFields)


class StateUpdate(NamedTuple):
    """What is shown of the newest state of host and controller."""

    state: RobotStateMessage
    new_logs: list[Log]  # the state in words, as far as it differs from what was logged
    reference_rad: Sequence[float]  # (n_joints,) angles that the controller wants; empty if unknown


class StateMessages:
    """Makes the state message for viewers, and log entries when the state changes."""

    def __init__(self) -> None:
        # By source: state, and its reason without numbers.
        self._last_logged_by_source: dict[str, tuple[str, str]] = {}

    def update_state(
        self, status_payload: bytes | None, control_payload: bytes | None, time_ns: int
    ) -> StateUpdate:
        """Combine the newest messages of host and controller into the state that viewers show.

        Args:
            status_payload: Newest payload of `hal/status`; None if the host publishes none.
            control_payload: Newest payload of `control/state`; None if the controller publishes none.
            time_ns: Robot time.

        Returns:
            The state, log entries about changes since the last call, and the controller's reference angles in rad.
        """
        host_state = _decode_status(status_payload)
        control_state = _decode_control(control_payload)
        state = RobotStateMessage(
            # Reported by the host.
            lifecycle=host_state.lifecycle,
            lifecycle_reason=host_state.reason,
            faults=len(host_state.faults),
            # Reported by the controller.
            locomotion=control_state.state,
            reason=control_state.reason,
            propulsion_joint=control_state.propulsion_joint or "",
            jammed=control_state.jammed,
            saturated=control_state.saturated,
            path_s_m=_unset_if_none(control_state.path_s_m),
            propulsion_n=_unset_if_none(control_state.propulsion_n),
            propulsion_torque_nm=_unset_if_none(control_state.propulsion_torque_nm),
            torque_headroom_nm=_unset_if_none(control_state.torque_headroom_nm),
            custom=control_state.custom,
        )
        logs = self._make_logs(state, time_ns)
        return StateUpdate(state, logs, control_state.reference_rad)

    def _make_logs(self, state: RobotStateMessage, time_ns: int) -> list[Log]:
        """Return log entries for viewers: one for the host and one for the controller, if its state has changed.

        Args:
            state: The state of host and controller now.
            time_ns: Robot time.

        Returns:
            One entry for each of host and controller whose state, or the reason of it, has changed since the last
            call; often empty.
        """
        host_level = Log.INFO
        if state.lifecycle in ("fault", "estop"):
            host_level = Log.ERROR
        host_reason, _, _ = state.lifecycle_reason.partition("; ")
        host_entry = self._make_log_if_changed(
            "hal", state.lifecycle, host_reason, host_level, time_ns
        )

        control_level = Log.INFO
        if state.jammed or state.saturated:
            control_level = Log.WARNING
        control_entry = self._make_log_if_changed(
            "control", state.locomotion, state.reason, control_level, time_ns
        )
        return [entry for entry in (host_entry, control_entry) if entry is not None]

    def _make_log_if_changed(
        self, source: str, state_name: str, reason: str, level: "Log.Level.ValueType", time_ns: int
    ) -> Log | None:
        """Return a log entry for the state of a source, if it differs from the entry that was logged last.

        Args:
            source: Publisher of the state: "hal" or "control".
            state_name: Name of the state; empty if the source publishes no state.
            reason: Reason of the state.
            level: Severity of the entry.
            time_ns: Robot time.

        Returns:
            The entry. None if the state is unchanged, or if the source has never published a state.
        """
        if not state_name:
            if source not in self._last_logged_by_source:
                return None
            state_name = "silent"
            reason = f"the state of {source} is no longer published"
            level = Log.ERROR
        # A force or an age that changes is no new state.
        reason_without_numbers = _NUMBER.sub("#", reason)
        content = (state_name, reason_without_numbers)
        if self._last_logged_by_source.get(source) == content:
            return None
        self._last_logged_by_source[source] = content
        return Log(
            timestamp=make_timestamp(time_ns),
            level=level,
            name=source,
            message=f"{state_name}: {reason}",
        )


def _decode_status(payload: bytes | None) -> _StatusFields:
    if payload is not None:
        with suppress(*UNDECODABLE):
            return _status_decoder.decode(payload)
    return _StatusFields()


def _decode_control(payload: bytes | None) -> _ControlFields:
    if payload is not None:
        with suppress(*UNDECODABLE):
            return _control_decoder.decode(payload)
    return _ControlFields()


def _unset_if_none(value: float | None) -> OptionalNumber:
    if value is None:
        return msgspec.UNSET
    return value
