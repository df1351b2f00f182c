"""What Foxglove has no schema for, as JSON: state of host and controller, a log of its changes, forces of contact."""

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any, Self

import msgspec
from foxglove_schemas_protobuf.Log_pb2 import Log

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Contacts
from snakesim_operator.recording.shapes import stamp

Maybe = float | msgspec.UnsetType


class State(msgspec.Struct, frozen=True, kw_only=True):
    """`/ROBOT/state`. What is unknown is empty, or left out."""

    lifecycle: str
    why: str
    locomotion: str
    reason: str
    propulsion_joint: str
    jammed: bool
    saturated: bool
    faults: int
    path_s_m: Maybe = msgspec.UNSET
    propulsion_n: Maybe = msgspec.UNSET
    propulsion_torque_nm: Maybe = msgspec.UNSET
    torque_headroom_nm: Maybe = msgspec.UNSET


class ContactForces(msgspec.Struct, frozen=True, kw_only=True):
    """`/ROBOT/contact_forces`: on each link in its own frame, tail to head, summed over its contacts."""

    along_n: list[float]
    left_n: list[float]
    up_n: list[float]

    @classmethod
    def of(cls, felt: Contacts, links: int) -> Self:
        """Of a sample, for a robot of so many links."""
        along_n, left_n, up_n = ([0.0] * links for _ in range(3))
        for contact in felt.contacts:
            if contact.link < links:
                along_n[contact.link] += contact.force_l[0]
                left_n[contact.link] += contact.force_l[1]
                up_n[contact.link] += contact.force_l[2]
        return cls(along_n=along_n, left_n=left_n, up_n=up_n)


class _StatusFields(msgspec.Struct, frozen=True):
    """Of `hal/status`."""

    lifecycle: q.Name = ""
    why: q.Reason = ""
    faults: Annotated[list[msgspec.Raw], msgspec.Meta(max_length=64)] = []


class _ControlFields(msgspec.Struct, frozen=True):
    """Of `control/state`."""

    state: q.Name = ""
    reason: q.Reason = ""
    propulsion_joint: q.Name | None = None
    path_s_m: q.Length | None = None
    propulsion_n: q.Force | None = None
    propulsion_torque_nm: q.Torque | None = None
    torque_headroom_nm: q.Torque | None = None
    reference_rad: q.Angles = []
    jammed: bool = False
    saturated: bool = False


_status, _control = msgspec.msgpack.Decoder(_StatusFields), msgspec.msgpack.Decoder(_ControlFields)
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_NUMBERS = ("path_s_m", "propulsion_n", "propulsion_torque_nm", "torque_headroom_nm")


class StateMessages:
    """Remembers what it has logged."""

    def __init__(self) -> None:
        self._logged: dict[str, tuple[str, str]] = {}

    def of(self, status: bytes | None, control: bytes | None, time_ns: int) -> tuple[State, list[Log], Sequence[float]]:
        """State, what of it is new, and the angles that the controller wants, in rad: of the newest payloads."""
        host, control_state = _StatusFields(), _ControlFields()
        with suppress(*UNDECODABLE):
            host = host if status is None else _status.decode(status)
        with suppress(*UNDECODABLE):
            control_state = control_state if control is None else _control.decode(control)
        numbers: dict[str, Any] = {
            name: value for name in _NUMBERS if (value := getattr(control_state, name)) is not None
        }
        state = State(
            lifecycle=host.lifecycle,
            why=host.why,
            locomotion=control_state.state,
            reason=control_state.reason,
            propulsion_joint=control_state.propulsion_joint or "",
            jammed=control_state.jammed,
            saturated=control_state.saturated,
            faults=len(host.faults),
            **numbers,
        )
        return state, self._new(state, time_ns), control_state.reference_rad

    def _new(self, state: State, time_ns: int) -> list[Log]:
        stopped, stuck = state.lifecycle in ("fault", "estop"), state.jammed or state.saturated
        found: list[Log] = []
        for name, what, why, level in (
            ("hal", state.lifecycle, state.why.partition("; ")[0], Log.ERROR if stopped else Log.INFO),
            ("control", state.locomotion, state.reason, Log.WARNING if stuck else Log.INFO),
        ):
            if not what and name in self._logged:
                what, why, level = "silent", f"the state of {name} is no longer published", Log.ERROR
            said = (what, _NUMBER.sub("#", why))  # a force or an age that changes is no news
            if what and self._logged.get(name) != said:
                self._logged[name] = said
                found.append(Log(timestamp=stamp(time_ns), level=level, name=name, message=f"{what}: {why}"))
        return found
