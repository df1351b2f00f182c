"""Checks of one servo before a motor moves, for any protocol: it answers, and no other servo has its id."""

from typing import Any

from snakesim_serial_backend.servo_bus import ANSWERS_TWICE, GARBLED, Registers, SerialServo

READS = 3  # to distinguish a second servo from a single disturbance
MIN_DOUBLED = 2  # reads with an answer too many that show a second servo
NO_ANSWER = "does not answer: it is off, or has another id or baud rate"


def find_shared_id(servo: SerialServo[Any], registers: Registers) -> str:
    """Return why another servo seems to have the same id; empty if only one answers.

    A ping does not show it: two servos of one model answer it with the same bytes at the same time. Late answers to
    earlier requests do not show it, either: the port assigns them to those requests.

    Args:
        servo: the servo.
        registers: those in which two servos differ, such as position, voltage and temperature.
    """
    doubled = 0
    garbled = 0
    for _ in range(READS):
        answers = servo.port.read_alone(servo.id, registers.address, registers.size)
        if answers.surplus:
            doubled += 1
        elif answers.statuses:
            return ""
        garbled += answers.garbled
        servo.port.wait_until_idle()
    if doubled >= MIN_DOUBLED:
        return ANSWERS_TWICE
    if garbled:
        return f"sends garbled bytes, in {garbled} of {READS} answers: {GARBLED}"
    return ""
