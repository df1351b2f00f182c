"""A text that attacks a terminal, and the check that no command prints such a text."""

from verification.attack.robot import AttackedRobot

FALSE_LINE = "planar13: armed - all is well"
# Clears the screen, sets the title of the window, adds a false line, and reverses the direction of the text.
EVIL_TEXT = f"\x1b[2J\x1b]0;evil\x07\r\n{FALSE_LINE}\n\x9b31m\u202e"
TOOLS = ("status", "estop", "robot reset")


def find_control_characters(text: str) -> list[str]:
    """Return all characters that control a terminal or reverse its text, except line breaks."""
    return [character for character in text if not character.isprintable() and character != "\n"]


def assert_output_is_safe(robot: AttackedRobot, printed_before: str) -> None:
    """Fail if a tool or the run prints control characters, or a line that a client has written.

    Args:
        robot: Robot whose state the tools read. They also stop and reset it.
        printed_before: What the run printed before the attack.
    """
    outputs = {f"snakesim {tool}": robot.run.run_tool(*tool.split()).printed for tool in TOOLS}
    outputs["the run"] = robot.run.printed()[len(printed_before) :]
    for program, output in outputs.items():
        assert not find_control_characters(output), f"{program} prints {output!r}"
        assert not any(line.startswith(FALSE_LINE) for line in output.splitlines()), output
