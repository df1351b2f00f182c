"""Checks of one servo before a motor moves, for any protocol: it answers, and no other servo has its id."""

from typing import Any

from snakesim_serial_backend.servo_bus import GARBLED, RESPONDS_TWICE, RegisterRange, SerialServo

MAX_READS = 3  # to distinguish a second servo from a single disturbance
MIN_DOUBLED = 2  # reads with an answer too many that show a second servo
NO_ANSWER = "does not answer: it is off, or has another id or baud rate"


def find_shared_id(servo: SerialServo[Any], registers: RegisterRange) -> str:
    """Detect a second servo with the same id by reading registers several times.

    A ping does not show a second servo: two servos of one model respond with the same bytes at the same time. Late
    responses to earlier requests are not mistaken for those of a second servo: the port assigns them to their requests.

    Args:
        servo: Servo to check.
        registers: Registers in which two servos differ, such as position, voltage and temperature.

    Returns:
        The reason why the id seems to be shared, or bytes are garbled, to be put after the servo's name; an empty
        string if a single servo responds, or none.
    """
    double_response_count = 0
    garbled = 0
    for _ in range(MAX_READS):
        responses = servo.port.read_alone(servo.id, registers.address, registers.size)
        if responses.surplus_count:
            double_response_count += 1
        elif responses.statuses:
            return ""
        garbled += responses.garbled
        servo.port.wait_until_idle()
    if double_response_count >= MIN_DOUBLED:
        return RESPONDS_TWICE
    if garbled:
        return f"sends garbled bytes, in {garbled} of {MAX_READS} answers: {GARBLED}"
    return ""
