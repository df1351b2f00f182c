"""The kernel's SocketCAN is there and does what our driver relies on; nothing of ours is in these tests."""

import errno
import socket
import struct

import pytest

from tests.vcan.link import CAN_ERR_MASK, CAN_RAW_ERR_FILTER, FRAME, SO_RXQ_OVFL, frame, ip, listener, tc


def test_a_frame_goes_from_one_socket_to_another(raw_socket: socket.socket, channel: str) -> None:
    with listener(channel) as other:
        raw_socket.send(frame(0x123, b"snake"))
        can_id, length, data = FRAME.unpack(other.recv(FRAME.size))
    assert (can_id, data[:length]) == (0x123, b"snake")


def test_a_sender_does_not_hear_itself(raw_socket: socket.socket) -> None:
    raw_socket.send(frame(0x123))
    raw_socket.setblocking(False)
    with pytest.raises(BlockingIOError):
        raw_socket.recv(FRAME.size)


def test_the_kernel_filters_what_was_not_asked_for(raw_socket: socket.socket, channel: str) -> None:
    with listener(channel) as other:
        other.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x200, 0x700))
        for can_id in (0x1FF, 0x2AB, 0x300, 0x2AC):
            raw_socket.send(frame(can_id))
        heard = [FRAME.unpack(other.recv(FRAME.size))[0] for _ in range(2)]
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.recv(FRAME.size)
    assert heard == [0x2AB, 0x2AC]


def test_sending_on_an_interface_that_is_down_raises(spare_channel: str) -> None:
    with listener(spare_channel) as opened:
        opened.send(frame(1))
        assert ip("link", "set", spare_channel, "down").returncode == 0
        with pytest.raises(OSError) as raised:
            opened.send(frame(2))
    assert raised.value.errno == errno.ENETDOWN


def test_a_full_queue_raises_enobufs(spare_channel: str) -> None:
    # vcan is never slow; a traffic limit of one kilobit a second stands in for a bus that nobody acknowledges.
    assert ip("link", "set", spare_channel, "txqueuelen", "10").returncode == 0
    limited = tc(
        *("qdisc", "add", "dev", spare_channel, "root", "tbf", "rate", "1kbit", "burst", "16", "limit", "64"),
    )
    if limited.returncode:
        pytest.skip(f"no traffic limit here: {limited.stderr.strip()}")
    with listener(spare_channel) as opened, pytest.raises(OSError) as raised:
        for number in range(200):
            opened.send(frame(number))
    assert raised.value.errno == errno.ENOBUFS


def test_error_frames_can_be_asked_for(raw_socket: socket.socket) -> None:
    raw_socket.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, CAN_ERR_MASK)
    assert raw_socket.getsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER) == CAN_ERR_MASK


def test_the_kernel_counts_frames_that_a_slow_reader_lost(raw_socket: socket.socket, channel: str) -> None:
    with listener(channel) as slow:
        slow.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel makes it its minimum
        for number in range(100):
            raw_socket.send(frame(number))
        # The count comes with the first frame received after the loss.
        slow.setblocking(False)
        with pytest.raises(BlockingIOError):
            while True:
                slow.recv(FRAME.size)
        slow.settimeout(2.0)
        raw_socket.send(frame(0x7FF))
        _, extra, _, _ = slow.recvmsg(FRAME.size, socket.CMSG_SPACE(4))
    lost = [
        struct.unpack("=I", data)[0] for level, kind, data in extra if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL)
    ]
    assert lost and 0 < lost[0] < 100
