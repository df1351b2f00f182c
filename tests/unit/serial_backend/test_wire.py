"""The serial port of an adapter: its latency, exclusive access, and an adapter that is unplugged."""

from pathlib import Path

import pytest
import serial

from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_serial_backend.wire import USB_LATENCY_S, PseudoTerminal, SerialWire, latency_s
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

BAUD = 1_000_000  # bit/s; a pseudo terminal ignores it


def test_latency_is_read_from_the_timer_of_the_adapter(tmp_path: Path) -> None:
    timer_file = tmp_path / "sys/class/tty/ttyUSB0/device/latency_timer"
    timer_file.parent.mkdir(parents=True)
    timer_file.write_text("16\n")
    assert latency_s("/dev/ttyUSB0", tmp_path) == 0.016
    assert latency_s("/dev/ttyACM0", tmp_path) == USB_LATENCY_S, "the adapter reports no latency"
    assert latency_s("/dev/pts/3", tmp_path) == 0.0


def test_serial_port_opened_a_second_time_is_refused() -> None:
    pty = PseudoTerminal()
    first_wire = SerialWire(pty.path, BAUD)
    with raises_error(BackendError, code="bus/cannot-open"):
        SerialWire(pty.path, BAUD)
    first_wire.close()
    pty.close()


def test_serial_port_receives_each_answer_once() -> None:
    pty = PseudoTerminal()  # drives send from one end; the wire is the driver's end
    wire = SerialWire(pty.path, BAUD)
    wire.send(b"request")
    pty.send(b"answer 1")
    assert wire.receive(timeout_s=1.0) == b"answer 1"
    assert wire.receive(timeout_s=0.0) == b"", "answer 1 was received twice"
    pty.send(b"answer 2")
    assert wire.receive(timeout_s=1.0) == b"answer 2"
    wire.close()
    pty.close()


def test_serial_port_discards_late_answer_before_next_request() -> None:
    """The driver has stopped waiting for an answer that arrives late; it must not count for the next request."""
    pty = PseudoTerminal()
    wire = SerialWire(pty.path, BAUD)
    late_answer = b"late answer"
    wire.send(b"request 1")
    pty.send(late_answer)
    wait_until(lambda: wire._serial.in_waiting == len(late_answer), "the late answer has arrived")
    wire.send(b"request 2")
    assert wire.receive(timeout_s=0.0) == b""
    wire.close()
    pty.close()


def test_serial_port_that_is_cut_sends_and_receives_nothing() -> None:
    pty = PseudoTerminal()
    wire = SerialWire(pty.path, BAUD)
    wire.send(b"before")

    wire.set_cut(begins=True)
    wire.send(b"lost")
    assert wire.error() == "it is cut"
    assert wire.receive(timeout_s=0.0) == b""

    wire.set_cut(begins=False)
    assert wire.error() == ""
    wire.send(b"after")
    sent_requests = b"beforeafter"
    pty.expected_bytes = len(sent_requests)  # pty.receive() waits until so many bytes have arrived
    assert pty.receive() == sent_requests
    wire.close()
    pty.close()


def test_serial_port_logs_what_it_sends_and_receives(tmp_path: Path) -> None:
    pty = PseudoTerminal()
    log_path = tmp_path / "bytes.txt"
    with log_path.open("w") as log_file:
        wire = SerialWire(pty.path, BAUD, log_file)
        wire.send(b"request")
        for answer in (b"answer 1", b"answer 2"):
            pty.send(answer)
            wire.receive(timeout_s=1.0)
        wire.receive(timeout_s=0.0)  # nothing arrives
        wire.set_cut(begins=True)
        wire.send(b"lost")
        wire.close()
    # Each line has a time, the port, the direction and the bytes.
    logged = [line.split(maxsplit=3)[2:] for line in log_path.read_text().splitlines()]
    assert logged == [
        ["out", b"request".hex(" ")],
        ["in", b"answer 1".hex(" ")],
        ["in", b"answer 2".hex(" ")],
    ]
    pty.close()


def test_serial_port_of_unplugged_adapter_reports_an_error() -> None:
    pty = PseudoTerminal()
    wire = SerialWire(pty.path, 57600)
    pty.close()
    wire.send(b"hello?")
    wire.receive(0.0)
    assert wire.error().startswith("it is gone")
    wire.send(b"hello?")
    assert wire.receive(0.0) == b""
    wire.close()


def test_missing_serial_port_is_refused_by_name() -> None:
    with raises_error(ConfigError, code="bus/not-available", field="/dev/ttyUSB77"):
        SerialWire("/dev/ttyUSB77", 57600)


def test_serial_port_survives_a_pause_of_the_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    pty = PseudoTerminal()
    wire = SerialWire(pty.path, 1_000_000)
    write = serial.Serial.write

    def write_with_timeout(port: serial.Serial, data: bytes) -> None:
        write(port, data)
        raise serial.SerialTimeoutException("Write timeout")

    monkeypatch.setattr(serial.Serial, "write", write_with_timeout)
    wire.send(b"hello?")
    assert wire.error() == ""
    monkeypatch.undo()
    wire.send(b"again")
    pty.expected_bytes = len(b"hello?again")
    assert pty.receive() == b"hello?again"
    wire.close()
    pty.close()
