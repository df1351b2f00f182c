"""Forges commands of a robot's controller, as an unauthorized client on the network could send them."""

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

MIN_FORGED_SEQUENCE = 1_000_000_000  # the controller's own sequence numbers stay below
HUGE_PAYLOAD_BYTES = MAX_PAYLOAD_BYTES + 1024
ARRIVAL_TIMEOUT_S = 2.0
UNUSED_MESSAGEPACK_BYTE = 0xC1  # is in no valid MessagePack document
MAX_NOISE_BYTES = 300


def send_payload(session: Session, payload: bytes, encoding: str | None = None) -> None:
    """Publish bytes on the key of joint commands. encoding: that of a JointCommand by default."""
    encoding = encoding or format_encoding(JointCommand)
    session._zenoh.put(keys.JOINT_COMMAND, payload, encoding=encoding)


class CommandForger:
    """Copies the controller's newest command, with its lease epoch, and makes one thing in it invalid."""

    def __init__(self, observer: Observer, seed: int = 1) -> None:
        self.observer = observer
        self.random = random.Random(seed)
        self._sequence = MIN_FORGED_SEQUENCE
        self._decoder = MessageDecoder(JointCommand)

    def make_command(self, **changes: Any) -> JointCommand:
        """Return a command that the controller could send now, except for the changed fields."""
        self._sequence += 1
        observer = self.observer
        observer.wait_until(lambda: observer.clocks, "the clock", ARRIVAL_TIMEOUT_S)
        tick = observer.clocks[-1].message.tick
        command, _ = self._find_controller_command(1)
        fields = {"sequence": self._sequence, "tick": tick, **changes}
        return msgspec.structs.replace(command, **fields)

    def send_command(self, command: JointCommand) -> None:
        """Send a command without a check of its values."""
        send_payload(self.observer.session, encode(command))

    def _find_controller_command(self, count_back: int) -> tuple[JointCommand, bytes]:
        """Wait for enough commands of the controller, and return one with its bytes.

        Args:
            count_back: 1 for the newest command, 2 for the one before, and so on. Forged commands do not count.
        """

        def find_newest() -> dict[int, tuple[JointCommand, bytes]] | None:
            newest: dict[int, tuple[JointCommand, bytes]] = {}
            for arrival in reversed(self.observer.commands):
                with contextlib.suppress(WireError):
                    command = self._decoder.decode(arrival.payload, arrival.encoding)
                    if command.sequence < MIN_FORGED_SEQUENCE:
                        newest[command.sequence] = command, arrival.payload
                if len(newest) == count_back:
                    return newest
            return None

        by_sequence = self.observer.wait_until(
            find_newest, "enough of the controller's commands", ARRIVAL_TIMEOUT_S
        )
        return by_sequence[min(by_sequence)]

    # --- commands at the wrong time ---------------------------------------------------------------------------

    def send_at_wrong_tick(self, tick_offset: int) -> None:
        """Send a command that answers another tick than the newest, with a fresh sequence number.

        Args:
            tick_offset: Ticks after the newest one; negative for an older tick.
        """
        command = self.make_command()
        self.send_command(msgspec.structs.replace(command, tick=max(command.tick + tick_offset, 0)))

    def send_without_arm_session(self) -> None:
        """Send a command for the newest tick that names no arm session."""
        self.send_command(self.make_command(arm_session=0))

    def replay_command(self, count_back: int) -> None:
        """Send the bytes of a controller's command again. count_back: 1 for the newest command."""
        _, payload = self._find_controller_command(count_back)
        send_payload(self.observer.session, payload)

    # --- commands with invalid content ------------------------------------------------------------------------

    def send_target(self, target: float) -> None:
        """Send a command in which one random target has this value."""
        command = self.make_command()
        targets = list(command.target)
        targets[self.random.randrange(len(targets))] = target
        self.send_command(msgspec.structs.replace(command, target=targets))

    def send_wrong_length(self) -> None:
        """Send a command for one joint less than the robot has."""
        command = self.make_command()
        self.send_command(
            msgspec.structs.replace(command, mode=command.mode[:-1], target=command.target[:-1])
        )

    def send_wrong_joint_order(self) -> None:
        """Send a command with the layout of a robot that has the same joints in reverse order."""
        command = self.make_command()
        self.send_command(
            msgspec.structs.replace(
                command,
                layout=command.layout[::-1] + "x",
                target=command.target[::-1],
                mode=command.mode[::-1],
            )
        )

    def send_malformed_bytes(self) -> None:
        """Send a valid command with missing or changed bytes, or random noise."""
        payload = bytearray(encode(self.make_command()))
        match self.random.randrange(3):
            case 0:
                payload = payload[: self.random.randrange(1, len(payload))]
            case 1:
                payload[0] = UNUSED_MESSAGEPACK_BYTE
            case _:
                noise = self.random.randbytes(self.random.randrange(1, MAX_NOISE_BYTES))
                payload = bytearray(noise)
                payload[0] |= UNUSED_MESSAGEPACK_BYTE
        send_payload(self.observer.session, bytes(payload))

    def send_huge_payload(self) -> None:
        """Send more bytes than a message may have."""
        kibibyte = self.random.randbytes(1024)
        send_payload(self.observer.session, kibibyte * (HUGE_PAYLOAD_BYTES // 1024))

    def send_unknown_version(self) -> None:
        """Send a valid command whose encoding names version 2, which does not exist."""
        encoding = format_encoding(JointCommand)
        next_encoding = encoding.replace("/1", "/2")
        assert next_encoding != encoding
        send_payload(self.observer.session, encode(self.make_command()), next_encoding)

    def send_other_encoding(self) -> None:
        """Send a valid command whose encoding names another type of data."""
        send_payload(self.observer.session, encode(self.make_command()), "application/json")
