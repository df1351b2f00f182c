"""The controls of one viewer. Only the viewer in control can use them; everybody can stop the robot."""

import math
import threading
import time
from collections.abc import Callable, Collection
from typing import Any, Literal

import viser

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.workers import ErrorReport
from snakesim_hal.model.fault_kinds import KINDS, TargetType
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_of
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlSettings
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.operations import BUTTON_NS, KEY_NS, Operations
from snakesim_operator.features.console.page.commissioning_tab import Commissioning, CommissioningControls
from snakesim_operator.features.console.page.page_html import BAD, escape_text
from snakesim_operator.features.console.page.settings_form import SettingsForm
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.web.admission import MAX_HOLD_AGE_S, MAX_PRESS_AGE_S, Admission, in_words
from snakesim_operator.features.console.web.message_age import PageAction
from snakesim_operator.robot_commands.fault import FaultOrder
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder
from snakesim_operator.robot_commands.teleop.steering import HEADING_STEP_RAD, turned

TOLD_S = 6.0
FAULTS: dict[str, tuple[str, TargetType]] = {
    f"{kind} ({sort})": (kind, sort) for sort, kinds in KINDS.items() for kind in kinds
}
TARGETS: dict[TargetType, str] = {"process": "control", "key": keys.JOINTS, "joint": "joint_3", "bus": "bus_1"}
DRIVE_HZ = 10.0
ACTS_AT_ONCE = 4  # of one viewer
FASTEST_M_S = 0.5
Key = Literal["I", "J", "K", "L"]
KEYS: dict[str, Key] = {"Ahead": "I", "Backwards": "K", "Left": "J", "Right": "L"}  # viser's arrows turn the view
TIMES: tuple[str, ...] = ("0.1", "0.25", "0.5", "1", "2", "5", "10")  # speeds of a simulator


class ViewerControls:
    """One viewer's buttons."""

    def __init__(
        self,
        client: viser.ClientHandle,
        folder: viser.GuiFolderHandle,
        token: ControlToken,
        operations: Operations,
        snapshot: Callable[[], RobotSnapshot | None],
        settings_tab: viser.GuiFolderHandle,
        changed: Callable[[], None],
        admission: Admission,
        commissioning: tuple[Commissioning, viser.GuiFolderHandle],
    ) -> None:
        """folder, settings_tab: places on the page; snapshot: the newest; changed: called when the token has moved.

        commissioning: and its tab.
        """
        self.client, self._token, self._operations = client, token, operations
        self._moment, self._changed = snapshot, changed
        self._settings_tab, self._admission = settings_tab, admission
        self._acts = threading.Semaphore(ACTS_AT_ONCE)
        self._form: SettingsForm | None = None
        self._offers_unchecked = False  # this viewer was refused because the joints were not checked
        self._way, self._driven_s = 1, -math.inf  # by keys: ahead or backwards, and when last
        self.viewer = client.client_id
        self._errors = ErrorReport(f"console, {self.who}")
        with folder:
            self._take = client.gui.add_button("Take control", icon=viser.Icon.HAND_STOP, color="blue")
            self._lifecycle = client.gui.add_button_group("Robot", ("Arm", "Disarm", "Clear"))
            self._why_unchecked = client.gui.add_html("", visible=False)
            self._arm_unchecked = client.gui.add_button("Arm it unchecked", color="red", visible=False)
            self._simulator = client.gui.add_folder("Simulator")
            with self._simulator:
                time_buttons = client.gui.add_button_group("Time", ("Pause", "Resume", "Step", "Reset"))
                self._time_speed = client.gui.add_dropdown("Speed", TIMES, initial_value="1")
            self._heading = client.gui.add_slider("Heading, °", -180, 180, 5, 0)
            self._speed = client.gui.add_slider("Speed, m/s", 0.0, FASTEST_M_S, 0.01, 0.1)
            self._drive = client.gui.add_button(
                "Hold to drive  (keys I, K; turn: J, L)", icon=viser.Icon.STEERING_WHEEL, color="green"
            )
            self._faults = client.gui.add_folder("Inject a fault", expand_by_default=False)
            with self._faults:
                self._kind = client.gui.add_dropdown("Kind", tuple(FAULTS), initial_value="mute (joint)")
                self._target = client.gui.add_text("Target", TARGETS["joint"])
                inject = client.gui.add_button_group("Fault", ("Inject", "End it"))
        admission.admit(self._take, self.viewer)
        for control in (self._heading, self._speed, self._kind, self._target):
            admission.admit(control, self.viewer, self._in_control)
        self._admit_press(self._lifecycle, at_any_age=("Disarm",))
        self._admit_press(time_buttons, at_any_age=("Pause",))
        self._admit_press(self._time_speed)
        self._admit_press(inject, at_any_age=("End it",))
        self._admit_press(self._arm_unchecked, lambda: self._in_control() and self._offers_unchecked)
        admission.admit(
            self._drive, self.viewer, self._in_control, DRIVE_HZ, act=self._on_held, max_age_s=MAX_HOLD_AGE_S
        )
        self._take.on_click(lambda _: self._take_or_release())
        self._lifecycle.on_click(lambda event: self._ask(event.target.value))
        self._arm_unchecked.on_click(lambda _: self._arm(unchecked=True))
        time_buttons.on_click(lambda event: self._change_time(event.target.value.lower()))
        self._time_speed.on_update(lambda _: self._change_time("speed"))
        with settings_tab:
            self._apply = client.gui.add_button("Apply", visible=False, order=0)
        self._admit_press(self._apply)
        about, tab = commissioning
        self._commissioning = CommissioningControls(
            client, tab, about, admission, self._in_control, self.do, self._on_late
        )
        self._kind.on_update(lambda _: self._suggest_target())
        inject.on_click(lambda event: self._inject(end=event.target.value == "End it"))
        # So that the page repeats that the button is held; `_on_held` gets that, and without it motion stops.
        self._drive.on_hold(lambda _: None, callback_hz=DRIVE_HZ)
        self._apply.on_click(lambda _: self._configure())
        self.show()

    @property
    def who(self) -> str:
        """The viewer's name."""
        return format_viewer(self.viewer)

    def show(self) -> None:
        """Enable what this viewer may use now."""
        mine, holder = self._token.holder == self.viewer, self._token.holder
        self._take.label = "Release control" if mine else "Take control"
        self._take.color = "gray" if mine else "blue"
        self._take.disabled = holder is not None and not mine
        taken = holder not in (None, self.viewer)
        self._take.hint = f"{format_viewer(holder)} has control, and may release it" if taken else None
        for one in (self._lifecycle, self._heading, self._speed, self._drive, self._faults):
            one.visible = mine
        snapshot = self._moment()
        self._show_unchecked(snapshot if mine else None)
        self._simulator.visible = mine and snapshot is not None and snapshot.robot.simulated_time
        self._time_speed.visible = (
            snapshot is not None and snapshot.status is not None and snapshot.status.clock_mode == "realtime"
        )
        self._apply.disabled = not mine
        self._commissioning.show()
        if self._form is not None:
            self._form.enable(mine)

    def show_settings(self, settings: ControlSettings) -> None:
        """Show the settings in force."""
        if self._form is None or not self._form.show(settings):
            if self._form is not None:
                for one in self._form.inputs:
                    self._admission.forget(one)
                self._form.remove()
            self._form = SettingsForm(self.client.gui, self._settings_tab, settings)
            for one in self._form.inputs:
                self._admission.admit(one, self.viewer, self._in_control)
        self._apply.visible = True
        self.show()

    def tell(self, title: str, text: str, *, bad: bool = False) -> None:
        """Show a message to this viewer."""
        self.client.add_notification(title, text, auto_close_seconds=TOLD_S, color="red" if bad else "green")

    def _take_or_release(self) -> None:
        if not self._token.release(self.viewer):
            if not self._token.take(self.viewer):
                self.tell("Not in control", f"{format_viewer(self._token.holder)} has it", bad=True)
            elif (body_w_rad := self._body_w_rad()) is not None:
                self._heading.value = _degrees(body_w_rad)  # straight on, until asked to turn
        self._changed()

    def _in_control(self) -> bool:
        """Whether this viewer may: the page greys the others' buttons out, but a page can be changed."""
        return self._token.holder == self.viewer

    def _ask(self, what: str) -> None:
        snapshot = self._moment()
        if snapshot is None or not self._in_control():
            return
        match what:
            case "Arm":
                self._arm(unchecked=False)
            case "Disarm":
                self.do("Disarm", lambda: self._operations.disarm(self.who))
            case _:
                self.do("Clear", lambda: self._operations.clear(self.who))

    def _arm(self, *, unchecked: bool) -> None:
        """The word `unchecked` is offered, as a button of its own, once the host has refused to do without."""
        snapshot = self._moment()
        if snapshot is None or not self._in_control():
            return
        armed = self.do("Arm", lambda: self._operations.arm(self.who, snapshot.robot, unchecked=unchecked))
        self._offers_unchecked = not armed
        self.show()

    def _show_unchecked(self, snapshot: RobotSnapshot | None) -> None:
        why = "" if snapshot is None or snapshot.status is None else snapshot.status.unchecked
        self._offers_unchecked &= bool(why)
        self._why_unchecked.content = (
            f"<div style='padding:.3em .6em;font-size:.85em;color:{BAD}'>{escape_text(why)}</div>"
        )
        self._why_unchecked.visible = self._arm_unchecked.visible = self._offers_unchecked

    def _change_time(self, action: str) -> None:
        if self._in_control():
            order = SimulatorOrder(action, speed=float(self._time_speed.value), who=self.who)
            self.do("Simulator", lambda: self._operations.change_time(self.who, order))

    def _admit_press(
        self, control: Any, may: Callable[[], bool] | None = None, at_any_age: Collection[str] = ()
    ) -> None:
        """Admit a control whose press may move the robot, now or later: an old one does not count."""
        self._admission.admit(
            control,
            self.viewer,
            may or self._in_control,
            max_age_s=MAX_PRESS_AGE_S,
            at_any_age=at_any_age,
            on_late=self._on_late,
        )

    def _on_late(self, age_s: float) -> None:
        self.tell("Not done", f"{in_words(age_s)}; press again if you still want it", bad=True)

    def _on_held(self, _viewer: int, action: PageAction) -> None:
        self._ask_for(self._speed.value, BUTTON_NS, action)

    def press(self, key: str, action: PageAction) -> None:
        """A key of `KEYS` was pressed, or its keyboard repeats it; only the last one of several is repeated.

        action: when that was; what is too old is ignored.
        """
        if not self._in_control() or action.age_s > MAX_HOLD_AGE_S:
            return
        now_s = time.monotonic()
        if key in ("Ahead", "Backwards"):
            self._way = 1 if key == "Ahead" else -1
        else:
            by_rad = HEADING_STEP_RAD if key == "Left" else -HEADING_STEP_RAD
            self._heading.value = _degrees(turned(self._heading_w_rad, by_rad, self._body_w_rad()))
            if now_s - self._driven_s > KEY_NS * 1e-9:
                return  # it turns only while it drives
        self._driven_s = now_s
        self._ask_for(self._way * self._speed.value, KEY_NS, action)

    def _ask_for(self, speed_m_s: float, valid_ns: int, action: PageAction) -> None:
        """Ask the robot to go, from the moment at which the viewer is known to have wanted it."""
        if action.robot_ns is not None and self._in_control():
            self._operations.drive(self.who, self._heading_w_rad, speed_m_s, action.robot_ns, valid_ns)

    @property
    def _heading_w_rad(self) -> float:
        return math.radians(self._heading.value)

    def _body_w_rad(self) -> float | None:
        snapshot = self._moment()
        return None if snapshot is None or snapshot.base is None else yaw_of(rotation_from_quaternion(snapshot.base[1]))

    def _suggest_target(self) -> None:
        """A target of the sort that the kind is for; simulator and clock are their own."""
        _, sort = FAULTS[self._kind.value]
        self._target.value = TARGETS.get(sort, sort)

    def _inject(self, *, end: bool) -> None:
        if self._in_control():
            kind, _ = FAULTS[self._kind.value]
            order = FaultOrder(kind, self._target.value.strip(), end=end)
            self.do("Fault", lambda: self._operations.inject(self.who, order))

    def _configure(self) -> None:
        form = self._form
        if form is not None and self._in_control():
            self.do("Settings", lambda: self._operations.configure(self.who, form.controller, form.asked()))

    def do(self, title: str, call: Callable[[], str]) -> bool:
        """Do something, and show its outcome; whether it was done.

        Few at once, so that a viewer keeps no other one's click waiting.
        """
        if not self._acts.acquire(blocking=False):
            self.tell(title, "not done: what you asked for before is still under way", bad=True)
            return False
        try:
            self.tell(title, call())
            return True
        except SnakesimError as error:
            self.tell(title, str(error), bad=True)
            return False
        except Exception as error:  # noqa: BLE001 - outermost in a thread of viser's, which tells no viewer
            self._errors.write(error)
            self.tell(title, f"not done: unexpected error: {type(error).__name__}: {error}", bad=True)
            return False
        finally:
            self._acts.release()


def _degrees(angle_rad: float) -> int:
    """In steps of the slider."""
    return 5 * round(math.degrees(angle_rad) / 5)


def format_viewer(viewer: int | None) -> str:
    """A viewer in words."""
    return "nobody" if viewer is None else f"viewer {viewer + 1}"


def set_appearance(gui: viser.GuiApi, *, dark: bool) -> None:
    """What the page looks like."""
    gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 103, 176)
    )


def add_appearance(client: viser.ClientHandle, admission: Admission, *, dark: bool) -> None:
    """The viewer's own choice of a dark page; dark: what its browser prefers, until the viewer chooses."""
    chosen = client.gui.add_checkbox("Dark page", initial_value=dark, order=2.5)
    admission.admit(chosen, client.client_id)
    chosen.on_update(lambda _: set_appearance(client.gui, dark=chosen.value))
    set_appearance(client.gui, dark=dark)
