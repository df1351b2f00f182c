"""The Commission tab: all joints in a table, and the commands of `snakesim robot calibrate`, run from the page.

One step runs at a time, for the viewer in control. It ends when that viewer releases control or closes the page.
"""

import shlex
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import viser

from snakesim_hal.base.errors import RefusedError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Link
from snakesim_hal.wire.messages import Configuration
from snakesim_operator.base.targets import flags_of
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.joint_step import ENTER, JointStep, name_command
from snakesim_operator.features.console.operations import PageLog
from snakesim_operator.features.console.page.joint_table import AngleRange, commissioning_html
from snakesim_operator.features.console.page.page_html import escape_text
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

MAX_IDLE_JOG_S = 60.0  # a jog leaves the robot armed, so it ends when no button is held for this long
NO_VIEWER = -1  # viewer of a step that is being ended already
STEPS = {
    "direction": "turn joints by hand, as it asks; Enter skips one",
    "zero": "lay the robot straight, take your hands off it, then Enter",
    "limits": "move joints by hand from end to end, then Enter",
    "jog": "ARMS the robot, checked or not, and moves one joint while a button below is held",
}


class Commissioning:
    """The table of joints that all viewers see, and the step that runs.

    Threads: the display loop calls `update` and `redraw`. The threads of viser call `start` and `end`. `press_key` is
    also called by the thread that receives messages of browsers, so it must not wait.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiFolderHandle,
        link: Link,
        robot_file: Path | None,
        token: ControlToken,
        log: PageLog,
    ) -> None:
        """Add the table of joints to the page. No commissioning step runs yet.

        Args:
            gui: The page of all viewers.
            tab: The place of the table.
            link: How a step connects to the robot.
            robot_file: The robot file on this computer with which the host was started; None: steps need a terminal.
            token: Decides which viewer has control.
            log: Gets a line for each step that starts or is ended.
        """
        self.robot_file = robot_file
        self._link = link
        self._token = token
        self._log = log
        # The step. The lock keeps two viewers from starting one at the same time.
        self._lock = threading.Lock()
        self._step: JointStep | None = None
        self._viewer = NO_VIEWER
        self._last_key_s = 0.0  # when the step was started, or got its newest key
        self._moved_ranges: list[AngleRange] = []
        # The configuration of the run, decoded once.
        self._configuration: Configuration | None = None
        self._config: RunConfig | None = None
        with tab:
            self._table = gui.add_html("", order=0)
            self._step_output = gui.add_html("", order=1)
            self._terminal_commands = gui.add_html("", order=3)

    def start(self, viewer: int, verb: str, joint: int, options: list[str]) -> str:
        """Start a commissioning step as a command in a process of its own, whose output the page shows.

        Args:
            viewer: The viewer in control.
            verb: A key of STEPS.
            joint: Number of the joint; 0: all joints.
            options: Further words of the command line.

        Returns:
            The command that was started.

        Raises:
            RefusedError: A step runs already, or the step cannot be started from this page.
        """
        if self.robot_file is None:
            raise RefusedError("the console was started without --commission FILE", code="commissioning/not-possible")
        if verb == "jog" and not joint:
            raise RefusedError("jog moves one joint: give its number", code="commissioning/not-possible")
        joint_names: list[str] = []
        if joint and verb != "zero":
            joint_names.append(f"joint_{joint}")
        with self._lock:
            if self._step is not None and self._step.is_running:
                raise RefusedError(f"{self._step.verb} is under way: end it first", code="commissioning/not-possible")
            robot_flags = shlex.split(flags_of(self._link, None))
            self._step = JointStep([verb, str(self.robot_file), *joint_names, *options, *robot_flags])
            self._viewer = viewer
            self._last_key_s = time.monotonic()
            self._moved_ranges = []
        command = " ".join([name_command(verb), *joint_names])
        self._log.write(f"viewer {viewer + 1}: {command}")
        return command

    def press_key(self, viewer: int, key: bytes) -> None:
        """Send a key to the step, if the viewer who started it sends the key and is still in control."""
        step = self._step
        if step is None or viewer != self._viewer or self._token.holder != viewer:
            return
        if _takes_key(step, key):
            self._last_key_s = time.monotonic()
            step.press_key(key)

    def end(self) -> None:
        """End the step, if there is one."""
        if self._step is not None:
            self._step.end()

    def update(self, snapshot: RobotSnapshot | None) -> None:
        """End a step that must not go on, and note how far the joints were moved; called for each frame."""
        step = self._step
        if step is None or not step.is_running:
            return
        self._end_abandoned_step(step)
        if step.verb == "limits" and snapshot is not None and snapshot.joints is not None:
            self._extend_moved_ranges(snapshot.joints.angle_rad)

    def _end_abandoned_step(self, step: JointStep) -> None:
        """End a step whose viewer has lost control, and a jog in which no button was held for a long time."""
        if self._viewer == NO_VIEWER:
            return
        is_idle_jog = step.verb == "jog" and time.monotonic() - self._last_key_s > MAX_IDLE_JOG_S
        has_control = self._token.holder == self._viewer
        if is_idle_jog:
            reason = f"nothing was held for {MAX_IDLE_JOG_S:g} s"
        elif not has_control:
            reason = "control was given up"
        else:
            return
        self._log.write(f"{name_command(step.verb)} ends: {reason}")
        self._viewer = NO_VIEWER
        step.end()

    def _extend_moved_ranges(self, angles_rad: Sequence[float]) -> None:
        """Extend the range in which each joint was moved by its present angle."""
        ranges = self._moved_ranges or [(angle_rad, angle_rad) for angle_rad in angles_rad]
        self._moved_ranges = [
            (min(lower_rad, angle_rad), max(upper_rad, angle_rad))
            for (lower_rad, upper_rad), angle_rad in zip(ranges, angles_rad, strict=True)
        ]

    def redraw(self, snapshot: RobotSnapshot) -> None:
        """Redraw the tab; called a few times a second."""
        if snapshot.configuration is not self._configuration:
            self._configuration = snapshot.configuration
            self._config = None
            if self._configuration is not None:
                self._config = _decode_config(self._configuration.content)
        has_ranges = len(self._moved_ranges) == len(snapshot.robot.joints)
        moved_ranges = self._moved_ranges if has_ranges else ()
        self._table.content = commissioning_html(snapshot, self._config, moved_ranges)
        if self._step is not None:
            self._step_output.content = _step_html(self._step)
        self._terminal_commands.content = self._terminal_html(snapshot)

    def _terminal_html(self, snapshot: RobotSnapshot) -> str:
        """Return the exact commands for the steps that this page cannot do, to be typed in a terminal.

        Args:
            snapshot: The newest snapshot of the robot, with its name and backend.
        """
        flags = flags_of(self._link, snapshot.robot.robot)
        parts: list[str] = []
        if self.robot_file is None:
            steps: list[str] = []
            for verb in STEPS:
                joint = " joint_N" if verb == "jog" else ""
                steps.append(f"snakesim {name_command(verb)} FILE{joint}{flags}")
            parts = [
                _commands_html("Where the robot's FILE is, with which the host was started, type:", steps),
                _commands_html(
                    "or do these from a page, with a console on that computer:",
                    [f"snakesim console --commission FILE{flags}"],
                ),
            ]
        file_name = "FILE" if self.robot_file is None else str(self.robot_file)
        backend = snapshot.robot.backend
        check = [
            f"snakesim run SCENARIO --controller joint_check --backend {backend} --out runs/check",
            f"snakesim robot check runs/check --write {file_name} --straight",
        ]
        parts.append(
            _commands_html(
                "The start check, once the host is stopped (SCENARIO: the one that the host was started with):", check
            )
        )
        return "".join(parts)


def _takes_key(step: JointStep, key: bytes) -> bool:
    """Return whether a step takes a key now: a jog the keys that move a joint, every other step only Enter.

    A jog takes keys only once it has printed a line, which it does when the robot is armed.
    """
    if step.verb == "jog":
        return key != ENTER and bool(step.lines)
    return key == ENTER


def _step_html(step: JointStep) -> str:
    """Return the output of a step."""
    lines = "".join(f"<div>{escape_text(line)}</div>" for line in step.lines)
    return (
        f"<div data-step style='margin:.4em .6em;padding:.4em .6em;border:1px solid;border-radius:6px;"
        f"font-size:.85em'><b>{escape_text(name_command(step.verb))}</b>{lines}</div>"
    )


def _commands_html(introduction: str, commands: Sequence[str]) -> str:
    """Return commands for a terminal, below a line that introduces them."""
    lines = [f"<pre style='margin:.2em 0;white-space:pre-wrap'>{escape_text(command)}</pre>" for command in commands]
    return f"<div style='padding:.3em .6em;font-size:.82em'>{escape_text(introduction)}{''.join(lines)}</div>"


def _decode_config(content: str) -> RunConfig | None:
    """Return the configuration of a run; None if it is of another version."""
    try:
        return msgspec.json.decode(content, type=RunConfig)
    except msgspec.DecodeError:
        return None
