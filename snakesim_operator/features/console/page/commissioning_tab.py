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
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.wire.messages import RunConfiguration
from snakesim_operator.base.targets import make_robot_flags
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.joint_step import ENTER, JointStep, format_command_name
from snakesim_operator.features.console.operations import PageLog
from snakesim_operator.features.console.page.joint_table import AngleRange, format_joint_table
from snakesim_operator.features.console.page.page_html import escape_text
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

# A jog leaves the robot armed, so it ends when no button is held for this long.
MAX_IDLE_JOG_S = 60.0
NO_VIEWER_ID = -1  # viewer of a step that is being ended already
DESCRIPTION_BY_STEP = {
    "direction": "turn each joint by hand when you are asked to; press Enter to skip a joint",
    "zero": "lay the robot straight, take your hands off it, then press Enter",
    "limits": "move each joint by hand from end to end, then press Enter",
    "jog": "ARMS the robot, checked or not, and moves one joint while you hold a button below",
}


class CommissioningTab:
    """The table of joints that all viewers see, and the step that runs.

    Threads: the display loop calls `update` and `redraw`. The threads of viser call `start_step` and `end_step`.
    `press_key` is also called by the thread that receives messages of browsers, so it must not wait.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiFolderHandle,
        connection: ConnectionSettings,
        robot_file: Path | None,
        control_token: ControlToken,
        log: PageLog,
    ) -> None:
        """Add the table of joints to the page. No commissioning step runs yet.

        Args:
            gui: The page of all viewers.
            tab: The place of the table.
            connection: Addresses and certificates with which a step connects to the robot.
            robot_file: The robot file on this computer with which the host was started; None if steps can be run in a
                terminal only.
            control_token: Token that one viewer at a time holds; its holder has control.
            log: Log that gets a line for each step that starts or is ended.
        """
        self.robot_file = robot_file
        self._connection = connection
        self._token = control_token
        self._log = log
        # The step. The lock keeps two viewers from starting one at the same time.
        self._lock = threading.Lock()
        self._step: JointStep | None = None
        self._viewer = NO_VIEWER_ID
        self._last_keypress_time_s = 0.0  # when the step was started, or got its newest key
        self._measured_ranges: list[AngleRange] = []
        # The configuration of the run, decoded once.
        self._configuration: RunConfiguration | None = None
        self._config: RunConfig | None = None
        with tab:
            self._table = gui.add_html("", order=0)
            self._step_output = gui.add_html("", order=1)
            self._terminal_commands = gui.add_html("", order=3)

    def start_step(
        self, viewer_id: int, step_name: str, joint_name: str | None, options: list[str]
    ) -> str:
        """Start a commissioning step as a command in a process of its own, whose output the page shows.

        Args:
            viewer_id: Client id of the viewer in control, from 0.
            step_name: Name of the step, a key of `DESCRIPTION_BY_STEP`.
            joint_name: Name of the joint to commission; None for all joints.
            options: Further words of the command line.

        Returns:
            Command and joint that were started, for the viewer, without file, options and connection.

        Raises:
            RefusedError: A step runs already, or the step cannot be started from this page.
        """
        if self.robot_file is None:
            raise RefusedError(
                "the console was started without --commission FILE",
                code="commissioning/not-possible",
            )
        if step_name == "jog" and joint_name is None:
            raise RefusedError(
                "jog moves one joint: give its number", code="commissioning/not-possible"
            )
        joint_names: list[str] = []
        # The zeros of all joints are calibrated together.
        if joint_name is not None and step_name != "zero":
            joint_names.append(joint_name)
        with self._lock:
            if self._step is not None and self._step.is_running:
                raise RefusedError(
                    f"{self._step.step_name} is under way: end it first",
                    code="commissioning/not-possible",
                )
            # None: without the robot's name.
            robot_flags = shlex.split(make_robot_flags(self._connection, None))
            self._step = JointStep(
                [step_name, str(self.robot_file), *joint_names, *options, *robot_flags]
            )
            self._viewer = viewer_id
            self._last_keypress_time_s = time.monotonic()
            self._measured_ranges = []
        command = " ".join([format_command_name(step_name), *joint_names])
        self._log.write(f"viewer {viewer_id + 1}: {command}")  # viewers are shown from 1
        return command

    def press_key(self, viewer_id: int, key: bytes) -> None:
        """Send a key to the running step, if the viewer that started the step presses it and is still in control."""
        step = self._step
        if step is None or viewer_id != self._viewer or self._token.holder != viewer_id:
            return
        if _accepts_key(step, key):
            self._last_keypress_time_s = time.monotonic()
            step.press_key(key)

    def end_step(self) -> None:
        """End the running step, if there is one."""
        if self._step is not None:
            self._step.terminate()

    def update(self, snapshot: RobotSnapshot | None) -> None:
        """End a step that must not go on, and note how far the joints were moved; called for each frame."""
        step = self._step
        if step is None or not step.is_running:
            return
        self._end_abandoned_step(step)
        if step.step_name == "limits" and snapshot is not None and snapshot.joints is not None:
            self._extend_measured_ranges(snapshot.joints.angle_rad)

    def _end_abandoned_step(self, step: JointStep) -> None:
        """End a step whose viewer has lost control, and a jog in which no button was held for a long time."""
        if self._viewer == NO_VIEWER_ID:
            return
        is_idle_jog = (
            step.step_name == "jog"
            and time.monotonic() - self._last_keypress_time_s > MAX_IDLE_JOG_S
        )
        has_control = self._token.holder == self._viewer
        if is_idle_jog:
            reason = f"nothing was held for {MAX_IDLE_JOG_S:g} s"
        elif not has_control:
            reason = "control was given up"
        else:
            return
        self._log.write(f"{format_command_name(step.step_name)} ends: {reason}")
        self._viewer = NO_VIEWER_ID
        step.terminate()

    def _extend_measured_ranges(self, angles_rad: Sequence[float]) -> None:
        """Extend the range in which each joint was moved by its present angle."""
        ranges = self._measured_ranges or [(angle_rad, angle_rad) for angle_rad in angles_rad]
        self._measured_ranges = [
            (min(lower_rad, angle_rad), max(upper_rad, angle_rad))
            for (lower_rad, upper_rad), angle_rad in zip(ranges, angles_rad, strict=True)
        ]

    def redraw(self, snapshot: RobotSnapshot) -> None:
        """Redraw table, output of the step and commands for a terminal; called a few times a second."""
        if snapshot.configuration is not self._configuration:
            self._configuration = snapshot.configuration
            self._config = None
            if self._configuration is not None:
                self._config = _decode_config(self._configuration.content)
        has_ranges = len(self._measured_ranges) == len(snapshot.robot.joints)
        measured_ranges = self._measured_ranges if has_ranges else ()
        self._table.content = format_joint_table(snapshot, self._config, measured_ranges)
        if self._step is not None:
            self._step_output.content = _format_step(self._step)
        self._terminal_commands.content = self._format_terminal_commands(snapshot)

    def _format_terminal_commands(self, snapshot: RobotSnapshot) -> str:
        """Format the exact commands for the steps that this page cannot run, to be typed in a terminal, as HTML.

        Args:
            snapshot: The newest snapshot of the robot, with its name and backend.
        """
        connection_flags = make_robot_flags(self._connection, snapshot.robot.robot)
        html_parts: list[str] = []
        if self.robot_file is None:
            step_commands: list[str] = []
            for step_name in DESCRIPTION_BY_STEP:
                joint_argument = " joint_N" if step_name == "jog" else ""
                step_commands.append(
                    f"snakesim {format_command_name(step_name)} FILE{joint_argument}{connection_flags}"
                )
            html_parts = [
                _format_commands(
                    "Where the robot's FILE is, with which the host was started, type:",
                    step_commands,
                ),
                _format_commands(
                    "or do these from a page, with a console on that computer:",
                    [f"snakesim console --commission FILE{connection_flags}"],
                ),
            ]
        file_name = "FILE" if self.robot_file is None else str(self.robot_file)
        backend = snapshot.robot.backend
        check_commands = [
            f"snakesim run SCENARIO --controller joint_check --backend {backend} --out runs/check",
            f"snakesim robot check runs/check --write {file_name} --straight",
        ]
        html_parts.append(
            _format_commands(
                "The start check, once the host is stopped (SCENARIO: the one that the host was started with):",
                check_commands,
            )
        )
        return "".join(html_parts)


def _accepts_key(step: JointStep, key: bytes) -> bool:
    """Return whether a step takes a key now: a jog the keys that move a joint, every other step only Enter.

    A jog takes keys only once it has printed a line, which it does when the robot is armed.
    """
    if step.step_name == "jog":
        return key != ENTER and bool(step.lines)
    return key == ENTER


def _format_step(step: JointStep) -> str:
    """Return the output of a step."""
    lines = "".join(f"<div>{escape_text(line)}</div>" for line in step.lines)
    return (
        f"<div data-step style='margin:.4em .6em;padding:.4em .6em;border:1px solid;border-radius:6px;"
        f"font-size:.85em'><b>{escape_text(format_command_name(step.step_name))}</b>{lines}</div>"
    )


def _format_commands(introduction: str, commands: Sequence[str]) -> str:
    """Return commands for a terminal, below a line that introduces them."""
    lines = [
        f"<pre style='margin:.2em 0;white-space:pre-wrap'>{escape_text(command)}</pre>"
        for command in commands
    ]
    return f"<div style='padding:.3em .6em;font-size:.82em'>{escape_text(introduction)}{''.join(lines)}</div>"


def _decode_config(content: str) -> RunConfig | None:
    """Return the configuration of a run; None if it is of another version."""
    try:
        return msgspec.json.decode(content, type=RunConfig)
    except msgspec.DecodeError:
        return None
