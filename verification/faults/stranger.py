"""Somebody else on the robot's network, who does not keep to our session: sends whatever bytes at whatever key."""

import contextlib
import random
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES, MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import JointCommand
from verification.faults.observer import Observer

FORGED = 1_000_000_000  # sequences from here on are not the controller's
HUGE = MAX_PAYLOAD_BYTES + 1024


def send_raw(session: Session, payload: bytes, encoding: str | None = None) -> None:
    """Put bytes where commands go."""
    session._zenoh.put(
        keys.JOINT_COMMAND, payload, encoding=encoding or format_encoding(JointCommand)
    )


class CommandForger:
    """Copies the controller's newest command, lease epoch and all, and spoils one thing in it."""

    def __init__(self, observer: Observer, seed: int = 1) -> None:
        self.observer = observer
        self.random = random.Random(seed)
        self._sequence = FORGED
        self._decoder = MessageDecoder(JointCommand)

    def forged(self, **changes: Any) -> JointCommand:
        """As the controller would send it now, but for the changes."""
        self._sequence += 1
        observer = self.observer
        observer.until(lambda: observer.clocks, "the clock", 2.0)
        tick = observer.clocks[-1].message.tick
        command, _ = self._of_controller(1)
        return msgspec.structs.replace(
            command, **{"sequence": self._sequence, "tick": tick, **changes}
        )

    def _of_controller(self, back: int) -> tuple[JointCommand, bytes]:
        """The controller's newest command (1), or an older one, with its bytes; what strangers sent is left out."""
        found: dict[int, tuple[JointCommand, bytes]] = {}

        def enough() -> bool:
            found.clear()
            for arrival in reversed(self.observer.commands):
                with contextlib.suppress(WireError):
                    command = self._decoder.decode(arrival.payload, arrival.encoding)
                    if command.sequence < FORGED:
                        found[command.sequence] = command, arrival.payload
                if len(found) == back:
                    return True
            return False

        self.observer.until(enough, "enough of the controller's commands", 2.0)
        return found[sorted(found)[0]]

    def send(self, command: JointCommand) -> None:
        """On the wire, whatever is in it."""
        send_raw(self.observer.session, encode(command))

    # --- out of time ------------------------------------------------------------------------------------------

    def out_of_time(self, ticks: int) -> None:
        """An answer to a state so many periods after the newest, or before it, with a fresh sequence."""
        forged = self.forged()
        self.send(msgspec.structs.replace(forged, tick=max(forged.tick + ticks, 0)))

    def without_arming(self) -> None:
        """An answer to the newest state that names no arming."""
        self.send(self.forged(arm_session=0))

    def again(self, back: int) -> None:
        """The bytes of the controller's newest command (1), or of an older one."""
        _, payload = self._of_controller(back)
        send_raw(self.observer.session, payload)

    # --- wrong in itself --------------------------------------------------------------------------------------

    def number(self, value: float) -> None:
        """One target is this number."""
        forged = self.forged()
        target = list(forged.target)
        target[self.random.randrange(len(target))] = value
        self.send(msgspec.structs.replace(forged, target=target))

    def wrong_length(self) -> None:
        """One joint too few."""
        forged = self.forged()
        self.send(msgspec.structs.replace(forged, mode=forged.mode[:-1], target=forged.target[:-1]))

    def wrong_order(self) -> None:
        """Joints in another order: the layout of a robot with the same joints named the other way round."""
        forged = self.forged()
        self.send(
            msgspec.structs.replace(
                forged,
                layout=forged.layout[::-1] + "x",
                target=forged.target[::-1],
                mode=forged.mode[::-1],
            )
        )

    def malformed(self) -> None:
        """A good command with bytes cut off or changed, or plain noise."""
        payload = bytearray(encode(self.forged()))
        match self.random.randrange(3):
            case 0:
                payload = payload[: self.random.randrange(1, len(payload))]
            case 1:
                payload[0] = 0xC1  # which MessagePack never uses
            case _:
                payload = bytearray(self.random.randbytes(self.random.randrange(1, 300)))
                payload[0] |= 0xC1
        send_raw(self.observer.session, bytes(payload))

    def huge(self) -> None:
        """More than four megabytes."""
        send_raw(self.observer.session, self.random.randbytes(1024) * (HUGE // 1024))

    def unknown_version(self) -> None:
        """A good command that says that it is of version 2."""
        version = format_encoding(JointCommand).replace("/1", "/2")
        assert version != format_encoding(JointCommand)
        send_raw(self.observer.session, encode(self.forged()), version)

    def other_message(self) -> None:
        """Bytes that say that they are of another kind."""
        send_raw(self.observer.session, encode(self.forged()), "application/json")
