"""Commissioning, as a tab: every joint in a table, and the commands `snakesim joints` run from the page.

One step at a time, of the viewer in control; without control, or with its page, it ends.
"""

import shlex
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import viser

from snakesim_hal.base.errors import RefusedError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Link
from snakesim_hal.wire.messages import Configuration
from snakesim_hal.wire.quantities import MAX_JOINTS
from snakesim_operator.base.targets import flags_of
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.joint_step import BACKWARDS, ENTER, FORWARDS, JointStep
from snakesim_operator.features.console.operations import PageLog
from snakesim_operator.features.console.page.joint_table import Range, commissioning_html
from snakesim_operator.features.console.page.page_html import escape_text
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.web.admission import MAX_HOLD_AGE_S, MAX_PRESS_AGE_S, Admission
from snakesim_operator.features.console.web.message_age import PageAction

HOLD_HZ = 20.0  # a command counts a key as held for 0.15 s
NOBODY = -1  # as the viewer of a step: it is being ended
LEFT_S = 60.0  # a jog in which nothing is held for so long ends
STEPS = {
    "direction": "turn joints by hand, as it asks; Enter skips one",
    "zero": "lay the robot straight, let go of it, then Enter",
    "limits": "move joints by hand from end to end, then Enter",
    "jog": "ARMS the robot, checked or not, and moves one joint while a button below is held",
}


class Commissioning:
    """What all viewers see of it, and the step that runs."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiFolderHandle,
        link: Link,
        file: Path | None,
        token: ControlToken,
        log: PageLog,
    ) -> None:
        """file: the robot file on this computer with which the host was started; None: steps need a terminal."""
        self.file, self._link, self._token, self._log = file, link, token, log
        self._step: JointStep | None = None
        self._viewer, self._held_s = NOBODY, 0.0
        self._lock = threading.Lock()
        self._configured: Configuration | None = None
        self._config: RunConfig | None = None
        self._moved: list[Range] = []
        with tab:
            self._table = gui.add_html("", order=0)
            self._said = gui.add_html("", order=1)
            self._typed = gui.add_html("", order=3)

    def start(self, viewer: int, verb: str, joint: int, more: list[str]) -> str:
        """Start a step. joint: its number, 0: all of them. Raises RefusedError."""
        if self.file is None:
            raise RefusedError("the console was started without --commission FILE")
        if verb == "jog" and not joint:
            raise RefusedError("jog moves one joint: give its number")
        named = [f"joint_{joint}"] if joint and verb != "zero" else []
        with self._lock:
            if self._step is not None and self._step.runs:
                raise RefusedError(f"{self._step.verb} is under way: end it first")
            where = shlex.split(flags_of(self._link, None))
            self._step = JointStep([verb, str(self.file), *named, *more, *where])
            self._viewer, self._held_s, self._moved = viewer, time.monotonic(), []
        what = f"joints {' '.join([verb, *named])}"
        self._log.write(f"viewer {viewer + 1}: {what}")
        return what

    def press(self, viewer: int, key: bytes) -> None:
        """A key for the step, of the viewer who started it."""
        step = self._step
        if step is None or viewer != self._viewer or self._token.holder != viewer:
            return
        if key == ENTER if step.verb != "jog" else key != ENTER and step.lines:  # a jog speaks once it is armed
            self._held_s = time.monotonic()
            step.press(key)

    def end(self) -> None:
        """End the step."""
        if self._step is not None:
            self._step.end()

    def turn(self, snapshot: RobotSnapshot | None) -> None:
        """Each frame: no step goes on without its viewer, and no jog that is left alone."""
        step = self._step
        if step is None or not step.runs:
            return
        left = step.verb == "jog" and time.monotonic() - self._held_s > LEFT_S
        if self._viewer != NOBODY and (left or self._token.holder != self._viewer):
            why = f"nothing was held for {LEFT_S:g} s" if left else "control was given up"
            self._log.write(f"joints {step.verb} ends: {why}")
            self._viewer = NOBODY
            step.end()
        if step.verb == "limits" and snapshot is not None and snapshot.joints is not None:
            now = snapshot.joints.angle_rad
            before = self._moved or [(angle, angle) for angle in now]
            self._moved = [(min(least, at), max(most, at)) for (least, most), at in zip(before, now, strict=True)]

    def show(self, snapshot: RobotSnapshot) -> None:
        """A few times a second."""
        if snapshot.configuration is not self._configured:
            self._configured = snapshot.configuration
            self._config = None if self._configured is None else _read(self._configured.content)
        moved = self._moved if len(self._moved) == len(snapshot.robot.joints) else ()
        self._table.content = commissioning_html(snapshot, self._config, moved)
        step = self._step
        if step is not None:
            lines = "".join(f"<div>{escape_text(line)}</div>" for line in step.lines)
            self._said.content = (
                f"<div data-step style='margin:.4em .6em;padding:.4em .6em;border:1px solid;border-radius:6px;"
                f"font-size:.85em'><b>joints {escape_text(step.verb)}</b>{lines}</div>"
            )
        self._typed.content = self._in_a_terminal(snapshot)

    def _in_a_terminal(self, snapshot: RobotSnapshot) -> str:
        """What this page cannot do, as the exact commands."""
        flags, file = flags_of(self._link, snapshot.robot.robot), "FILE" if self.file is None else str(self.file)
        check = [
            f"snakesim run SCENARIO --controller joint_check --backend {snapshot.robot.backend} --out runs/check",
            f"snakesim joints check runs/check {file} --straight",
        ]
        texts = [
            ("The start check, once the host is stopped (SCENARIO: the one that the host was started with):", check)
        ]
        if self.file is None:
            steps = [f"snakesim joints {verb} FILE{' joint_N' if verb == 'jog' else ''}{flags}" for verb in STEPS]
            again = f"snakesim console --commission FILE{flags}"
            texts = [
                ("Where the robot's FILE is, with which the host was started, type:", steps),
                ("or do these from a page, with a console on that computer:", [again]),
                *texts,
            ]
        return "".join(
            f"<div style='padding:.3em .6em;font-size:.82em'>{escape_text(what)}"
            + "".join(f"<pre style='margin:.2em 0;white-space:pre-wrap'>{escape_text(line)}</pre>" for line in typed)
            + "</div>"
            for what, typed in texts
        )


class CommissioningControls:
    """One viewer's buttons for it."""

    def __init__(
        self,
        client: viser.ClientHandle,
        tab: viser.GuiFolderHandle,
        commissioning: Commissioning,
        admission: Admission,
        may: Callable[[], bool],
        do: Callable[[str, Callable[[], str]], object],
        on_late: Callable[[float], None],
    ) -> None:
        """may: whether this viewer is in control; do: does something, and tells the viewer what came of it.

        on_late: called with the age of a press that was too old.
        """
        self._commissioning, self._may, self._do = commissioning, may, do
        self._viewer, gui = client.client_id, client.gui
        with tab:
            self._folder = gui.add_folder("Do it here", order=2, visible=False)
        with self._folder:
            self._verb = gui.add_dropdown("Step", tuple(STEPS), initial_value="direction")
            self._about = gui.add_html("")
            self._joint = gui.add_number("Joint (0: all)", 0, min=0, max=MAX_JOINTS, step=1)
            self._speed = gui.add_slider("Speed, rad/s", 0.01, 0.5, 0.01, 0.1)
            self._travel = gui.add_slider("Travel, rad", 0.05, 3.2, 0.05, 0.2)
            self._torque = gui.add_slider("Share of torque", 0.05, 1.0, 0.05, 0.3)
            start = gui.add_button("Start step", color="blue")
            self._enter = gui.add_button("Enter")
            self._forwards = gui.add_button("Hold: forwards (+)", color="green")
            self._backwards = gui.add_button("Hold: backwards (-)", color="green")
            end = gui.add_button("End step", color="gray")
        for one in (self._verb, self._joint, self._speed, self._travel, self._torque, end):
            admission.admit(one, self._viewer, may)
        for one in (start, self._enter):
            admission.admit(one, self._viewer, may, max_age_s=MAX_PRESS_AGE_S, on_late=on_late)
        for one, key in ((self._forwards, FORWARDS), (self._backwards, BACKWARDS)):
            one.on_hold(lambda _: None, callback_hz=HOLD_HZ)  # so that the page repeats that it is held
            act = partial(self._on_held, key)
            admission.admit(one, self._viewer, may, HOLD_HZ, act=act, max_age_s=MAX_HOLD_AGE_S)
        self._verb.on_update(lambda _: self._describe())
        start.on_click(lambda _: self._start())
        self._enter.on_click(lambda _: commissioning.press(self._viewer, ENTER))
        end.on_click(lambda _: self._end())
        self._describe()

    def show(self) -> None:
        """Whether this viewer may."""
        self._folder.visible = self._commissioning.file is not None and self._may()

    def _describe(self) -> None:
        """What the chosen step is, and its inputs alone."""
        verb = self._verb.value
        self._about.content = f"<div style='padding:.2em .6em;font-size:.85em'>{escape_text(STEPS[verb])}</div>"
        self._joint.visible, self._enter.visible = verb != "zero", verb != "jog"
        for one in (self._speed, self._travel, self._torque, self._forwards, self._backwards):
            one.visible = verb == "jog"

    def _on_held(self, key: bytes, _viewer: int, _action: PageAction) -> None:
        """A button is held, by a message that is not too old."""
        self._commissioning.press(self._viewer, key)

    def _start(self) -> None:
        verb, joint = self._verb.value, int(self._joint.value)
        jog = ["--speed", self._speed, "--travel", self._travel, "--torque", self._torque]
        words = [one if isinstance(one, str) else f"{one.value:g}" for one in jog] if verb == "jog" else []
        if self._may():
            self._do("Joints", lambda: self._commissioning.start(self._viewer, verb, joint, words))

    def _end(self) -> None:
        if self._may():
            self._commissioning.end()


def _read(content: str) -> RunConfig | None:
    """None: of another version."""
    try:
        return msgspec.json.decode(content, type=RunConfig)
    except msgspec.DecodeError:
        return None
