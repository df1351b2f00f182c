"""The serial port of an adapter: its latency, exclusive access, and an adapter that is unplugged."""

from pathlib import Path

import pytest
import serial

from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_serial_backend.wire import USB_LATENCY_S, PseudoTerminal, SerialWire, latency_s
from snakesim_testing.messages import raises_error


def test_latency_is_read_from_the_timer_of_the_adapter(tmp_path: Path) -> None:
    timer_file = tmp_path / "sys/class/tty/ttyUSB0/device/latency_timer"
    timer_file.parent.mkdir(parents=True)
    timer_file.write_text("16\n")
    assert latency_s("/dev/ttyUSB0", tmp_path) == 0.016
    assert latency_s("/dev/ttyACM0", tmp_path) == USB_LATENCY_S, "the adapter reports no latency"
    assert latency_s("/dev/pts/3", tmp_path) == 0.0


def test_serial_port_is_exclusive_and_late_bytes_are_discarded(tmp_path: Path) -> None:
    pty = PseudoTerminal()
    log = tmp_path / "bytes.txt"
    with log.open("w") as file:
        wire = SerialWire(pty.path, 1_000_000, file)
        with raises_error(BackendError, code="bus/cannot-open"):
            SerialWire(pty.path, 1_000_000)
        wire.send(b"first?")
        pty.send(b"late")
        assert wire.receive(1.0) == b"late"
        assert wire.receive(0.0) == b""
        pty.send(b"later")
        assert wire.receive(1.0) == b"later"
        wire.set_cut(begins=True)
        wire.send(b"lost")
        assert wire.error() == "it is cut"
        assert wire.receive(0.0) == b""
        wire.set_cut(begins=False)
        assert wire.error() == ""
        pty.expected_bytes = len(b"first?")
        assert pty.receive() == b"first?"
        wire.close()
    lines = [line.split(maxsplit=3)[2:] for line in log.read_text().splitlines()]
    assert lines == [
        ["out", b"first?".hex(" ")],
        ["in", b"late".hex(" ")],
        ["in", b"later".hex(" ")],
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
