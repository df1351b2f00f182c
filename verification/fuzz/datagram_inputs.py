"""Inputs that read UDP datagrams, sent through a real socket: motion capture and the stop port."""

import socket
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import msgspec

from snakesim_drivers.motion_capture.mocap import MAX_DATAGRAM_BYTES, MocapReceiver
from snakesim_hal.network.stop_port import (
    REQUEST_HEADER,
    open_stop_port,
    request_stop,
    start_stop_server,
)
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import EstopRequest, Pose
from verification.fuzz.inputs import DecoderInput

PAYLOADS_PER_STOP = 20
STOP_TIMEOUT_S = 5.0
MAX_UDP_BYTES = 60_000
MAX_REQUESTER_CHARACTERS = 64
POSE_PERIOD_NS = 10_000_000
MAX_POSE_AGE_S = 0.01


@contextmanager
def open_motion_capture() -> Iterator[DecoderInput]:
    """Open a receiver of motion capture. After each payload, it must still read a valid datagram."""
    now_ns = 0
    receiver = MocapReceiver("127.0.0.1:0", MAX_POSE_AGE_S, lambda _timestamp_ns: now_ns)
    host, _, port = receiver.address.rpartition(":")
    with closing(receiver), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:

        def send_and_read(payload: bytes) -> str:
            """Send one datagram, and return what the receiver made of it."""
            nonlocal now_ns
            now_ns += POSE_PERIOD_NS
            rejections_before = receiver.rejected_count_by_reason.copy()
            client.sendto(payload, (host, int(port)))
            pose = receiver.read_newest(now_ns // POSE_PERIOD_NS, now_ns)
            if pose is not None:
                decoder = MessageDecoder(Pose)
                assert decoder.decode(encode(pose), format_encoding(Pose)) == pose
                return "a pose"
            new_rejections = receiver.rejected_count_by_reason - rejections_before
            return next(iter(new_rejections), "no velocity yet")

        def decode(payload: bytes) -> str:
            outcome = send_and_read(payload)
            valid_outcome = send_and_read(_make_pose_datagram(now_ns + POSE_PERIOD_NS))
            assert valid_outcome in ("a pose", "reordered", "duplicate", "no velocity yet"), (
                f"the next valid datagram: {valid_outcome}"
            )
            return outcome

        timestamps_ns = (1, 10**7, 10**9)
        valid_payloads = [_make_pose_datagram(timestamp_ns) for timestamp_ns in timestamps_ns]
        valid_payloads.append(_make_pose_datagram(10**8, with_velocity=False))
        yield DecoderInput("motion capture", valid_payloads, decode, MAX_DATAGRAM_BYTES + 100)


@contextmanager
def open_stop_server() -> Iterator[DecoderInput]:
    """Open a stop port. Now and then it gets a valid stop, which it must answer."""
    stop_socket = open_stop_port("127.0.0.1", 0)
    host, port = stop_socket.getsockname()
    requesters: list[str] = []
    payload_count = 0

    def stop(requester: str, reply: Callable[[str], None]) -> None:
        request = EstopRequest(requester=requester[:MAX_REQUESTER_CHARACTERS])
        assert MessageDecoder(EstopRequest).decode(encode(request), format_encoding(EstopRequest))
        requesters.append(requester)
        reply("stopped")

    start_stop_server(stop_socket, "worm", stop)
    with stop_socket, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:

        def decode(payload: bytes) -> str:
            nonlocal payload_count
            client.sendto(payload, (host, port))
            payload_count += 1
            if payload_count % PAYLOADS_PER_STOP == 0:
                answer = request_stop(host, port, "a person", STOP_TIMEOUT_S)
                assert answer is not None, "the stop port does not answer"
                assert answer.text == "stopped"
            outcome = "a stop" if requesters else "no stop yet"
            requesters.clear()
            return outcome

        names = (b"", b"a person", b"x" * MAX_REQUESTER_CHARACTERS)
        valid_payloads = [REQUEST_HEADER + bytes(16) + name for name in names]
        yield DecoderInput("stop port", valid_payloads, decode, MAX_UDP_BYTES)


def _make_pose_datagram(timestamp_ns: int, *, with_velocity: bool = True) -> bytes:
    fields: dict[str, object] = {
        "timestamp_ns": timestamp_ns,
        "position_w": [0.1, 0.2, 0.3],
        "orientation_wxyz": [1, 0, 0, 0],
    }
    if with_velocity:
        fields["velocity_w"] = [0.0, 0.1, 0.0]
        fields["angular_velocity_w"] = [0.0, 0.0, 1.0]
    return msgspec.json.encode(fields)
