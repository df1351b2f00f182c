"""The controls of one viewer. Only the viewer in control can use them; every viewer can stop the robot."""

import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import viser

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.workers import ErrorReporter
from snakesim_hal.model.fault_kinds import FAULT_KINDS, TargetType
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlParameters
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.operations import RobotOperations
from snakesim_operator.features.console.page.commissioning_controls import CommissioningControls
from snakesim_operator.features.console.page.commissioning_tab import CommissioningTab
from snakesim_operator.features.console.page.drive_controls import DriveControls
from snakesim_operator.features.console.page.page_html import BAD, escape_text
from snakesim_operator.features.console.page.parameter_form import ParameterForm
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.web.admission import (
    MAX_PRESS_AGE_S,
    ControlAdmission,
    format_age,
)
from snakesim_operator.robot_commands.fault import FaultOrder
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

NOTIFICATION_DURATION_S = 6.0  # long enough to read a refusal
MAX_CONCURRENT_OPERATIONS = 4  # of one viewer, so that the threads of viser are left for the others

FAULT_KIND_BY_LABEL: dict[str, tuple[str, TargetType]] = {
    f"{kind} ({target_type})": (kind, target_type)
    for target_type, kinds in FAULT_KINDS.items()
    for kind in kinds
}
EXAMPLE_TARGET_BY_TYPE: dict[TargetType, str] = {
    "process": "control",
    "key": keys.JOINTS,
    "joint": "joint_3",
    "bus": "bus_1",
}
# Multiples of real time.
SIMULATOR_SPEEDS: tuple[str, ...] = "0.1", "0.25", "0.5", "1", "2", "5", "10"


@dataclass(frozen=True)
class ControlContext:
    """What the controls of every viewer act on, and their places in the panel."""

    token: ControlToken  # decides which viewer has control
    operations: RobotOperations  # sends commands to the robot
    admission: ControlAdmission  # decides which messages of a page count
    commissioning: CommissioningTab  # runs steps; all viewers share one
    # Returns the newest snapshot; None while there is no robot.
    get_snapshot: Callable[[], RobotSnapshot | None]
    on_control_changed: Callable[[], None]  # called when a viewer took or released control
    control_folder: viser.GuiFolderHandle
    parameters_tab: viser.GuiFolderHandle
    commissioning_tab: viser.GuiFolderHandle


class ViewerControls:
    """The buttons and inputs of one viewer, and what they do.

    viser calls the callbacks in threads of its own; they may wait for the robot. Only `drive` is called by the thread
    that receives messages.
    """

    def __init__(self, client: viser.ClientHandle, context: ControlContext) -> None:
        """Add the controls to the viewer's page.

        Args:
            client: The viewer's page.
            context: Objects that the controls act on.
        """
        self.client = client
        self.viewer = client.client_id
        # What the controls act on.
        self._control_token = context.token
        self._operations = context.operations
        self._get_snapshot = context.get_snapshot
        self._on_control_changed = context.on_control_changed
        self._admission = context.admission
        # What this viewer has done.
        self._operation_slots = threading.Semaphore(MAX_CONCURRENT_OPERATIONS)
        # The host refused to arm because the joints were not checked.
        self._can_offer_unchecked = False
        self._error_report = ErrorReporter(f"console, {self.name}")
        # The controls.
        self._parameters_tab = context.parameters_tab
        self._parameter_form: ParameterForm | None = None
        with context.control_folder:
            self._add_control_buttons()
            self._add_simulator_controls()
            self.drive_controls = DriveControls(
                client,
                self._admission,
                self._is_in_control,
                self._get_snapshot,
                partial(self._operations.drive, self.name),
            )
            self._add_fault_controls()
        with self._parameters_tab:
            self._apply_button = client.gui.add_button("Apply", visible=False, order=0)
        self._admit_controls()
        self._commissioning_controls = CommissioningControls(
            client,
            context.commissioning_tab,
            context.commissioning,
            self._admission,
            self._is_in_control,
            self.run_operation,
            self._on_late_press,
        )
        self._connect_callbacks()
        self.refresh()

    def _add_control_buttons(self) -> None:
        gui = self.client.gui
        self._take_control_button = gui.add_button(
            "Take control", icon=viser.Icon.HAND_STOP, color="blue"
        )
        self._lifecycle_buttons = gui.add_button_group("Robot", ("Arm", "Disarm", "Reset fault"))
        self._unchecked_reason = gui.add_html("", visible=False)
        self._arm_unchecked_button = gui.add_button("Arm it unchecked", color="red", visible=False)

    def _add_simulator_controls(self) -> None:
        gui = self.client.gui
        self._simulator_folder = gui.add_folder("Simulator")
        with self._simulator_folder:
            self._time_buttons = gui.add_button_group("Time", ("Pause", "Resume", "Step", "Reset"))
            self._speed_dropdown = gui.add_dropdown("Speed", SIMULATOR_SPEEDS, initial_value="1")

    def _add_fault_controls(self) -> None:
        gui = self.client.gui
        self._fault_folder = gui.add_folder("Inject a fault", expand_by_default=False)
        with self._fault_folder:
            self._fault_kind_dropdown = gui.add_dropdown(
                "Kind", tuple(FAULT_KIND_BY_LABEL), initial_value="mute (joint)"
            )
            self._fault_target_input = gui.add_text("Target", EXAMPLE_TARGET_BY_TYPE["joint"])
            self._fault_buttons = gui.add_button_group("Fault", ("Inject", "End it"))

    def _admit_controls(self) -> None:
        """Let this viewer's page use the controls.

        What calms the robot counts at any age. What may move it, now or later, counts only while it is recent.
        """
        admit = self._admission.admit_control
        admit(self._take_control_button, self.viewer)
        for control in (self._fault_kind_dropdown, self._fault_target_input):
            admit(control, self.viewer, self._is_in_control)
        self._admit_if_recent(self._lifecycle_buttons, at_any_age=("Disarm",))
        self._admit_if_recent(self._time_buttons, at_any_age=("Pause",))
        self._admit_if_recent(self._speed_dropdown)
        self._admit_if_recent(self._fault_buttons, at_any_age=("End it",))
        self._admit_if_recent(self._arm_unchecked_button, self._may_arm_unchecked)
        self._admit_if_recent(self._apply_button)

    def _admit_if_recent(
        self,
        control: Any,
        is_allowed: Callable[[], bool] | None = None,
        at_any_age: Collection[str] = (),
    ) -> None:
        """Admit a control whose press may move the robot, now or later: an old press does not count.

        Args:
            control: The control.
            is_allowed: Returns whether the control may be used now; None allows it while this viewer is in control.
            at_any_age: Values that count however old the press is.
        """
        self._admission.admit_control(
            control,
            self.viewer,
            is_allowed or self._is_in_control,
            max_age_s=MAX_PRESS_AGE_S,
            at_any_age=at_any_age,
            on_late=self._on_late_press,
        )

    def _connect_callbacks(self) -> None:
        self._take_control_button.on_click(lambda _: self._take_or_release_control())
        self._lifecycle_buttons.on_click(lambda event: self._change_lifecycle(event.target.value))
        self._arm_unchecked_button.on_click(lambda _: self._arm(unchecked=True))
        self._time_buttons.on_click(
            lambda event: self._control_simulator(event.target.value.lower())
        )
        self._speed_dropdown.on_update(lambda _: self._control_simulator("speed"))
        self._fault_kind_dropdown.on_update(lambda _: self._suggest_fault_target())
        self._fault_buttons.on_click(
            lambda event: self._inject_or_end_fault(end=event.target.value == "End it")
        )
        self._apply_button.on_click(lambda _: self._apply_parameters())

    @property
    def name(self) -> str:
        """The viewer's name in logs and in requests to the robot."""
        return format_viewer(self.viewer)

    # --- what the viewer sees --------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show, hide, enable and disable all controls by what this viewer may use now.

        Only the viewer in control may operate the robot. Controls of the simulator need a simulated robot.
        """
        is_in_control = self._is_in_control()
        snapshot = self._get_snapshot()
        self._update_take_control_button()
        self._lifecycle_buttons.visible = is_in_control
        self.drive_controls.set_visible(is_in_control)
        self._fault_folder.visible = is_in_control
        self._update_arm_unchecked_button(snapshot if is_in_control else None)
        is_simulated = snapshot is not None and snapshot.robot.simulated_time
        self._simulator_folder.visible = is_in_control and is_simulated
        # Only a simulator that follows the wall clock has a speed.
        status = None if snapshot is None else snapshot.status
        self._speed_dropdown.visible = status is not None and status.clock_mode == "realtime"
        self._apply_button.disabled = not is_in_control
        self._commissioning_controls.refresh()
        if self._parameter_form is not None:
            self._parameter_form.set_enabled(is_in_control)

    def _update_take_control_button(self) -> None:
        """Show whether this viewer can take control, or can release it, or which other viewer has it."""
        holder = self._control_token.holder
        is_mine = holder == self.viewer
        is_taken = holder is not None and not is_mine
        self._take_control_button.label = "Release control" if is_mine else "Take control"
        self._take_control_button.color = "gray" if is_mine else "blue"
        self._take_control_button.disabled = is_taken
        self._take_control_button.hint = (
            f"{format_viewer(holder)} has control, and may release it" if is_taken else None
        )

    def _update_arm_unchecked_button(self, snapshot: RobotSnapshot | None) -> None:
        """Show why the joints are unchecked with a button that arms all the same, once the host has refused to arm."""
        reason = ""
        if snapshot is not None and snapshot.status is not None:
            reason = snapshot.status.unchecked
        if not reason:
            self._can_offer_unchecked = False
        self._unchecked_reason.content = (
            "<div "
            f"style='padding:.3em .6em;font-size:.85em;color:{BAD}'>{escape_text(reason)}</div>"
        )
        self._unchecked_reason.visible = self._can_offer_unchecked
        self._arm_unchecked_button.visible = self._can_offer_unchecked

    def show_parameters(self, parameters: ControlParameters) -> None:
        """Show the controller parameters in force."""
        if self._parameter_form is None or not self._parameter_form.show_values(parameters):
            self._replace_parameter_form(parameters)
        self._apply_button.visible = True
        self.refresh()

    def _replace_parameter_form(self, parameters: ControlParameters) -> None:
        """Add the form of the running controller, in the place of the form of another controller."""
        former = self._parameter_form
        if former is not None:
            for control in former.inputs:
                self._admission.remove_control(control)
            former.remove()
        self._parameter_form = ParameterForm(self.client.gui, self._parameters_tab, parameters)
        for control in self._parameter_form.inputs:
            self._admission.admit_control(control, self.viewer, self._is_in_control)

    def notify(self, title: str, text: str, *, bad: bool = False) -> None:
        """Show a notification to this viewer."""
        color = "red" if bad else "green"
        self.client.add_notification(
            title, text, auto_close_seconds=NOTIFICATION_DURATION_S, color=color
        )

    # --- control ---------------------------------------------------------------------------------------------

    def _is_in_control(self) -> bool:
        """Return whether this viewer has control.

        The page disables the buttons of the other viewers, but a page can be changed: each command is checked here.
        """
        return self._control_token.holder == self.viewer

    def _may_arm_unchecked(self) -> bool:
        return self._is_in_control() and self._can_offer_unchecked

    def _take_or_release_control(self) -> None:
        was_released = self._control_token.release(self.viewer)
        if not was_released:
            if self._control_token.acquire(self.viewer):
                self.drive_controls.steer_straight_on()
            else:
                self.notify(
                    "Not in control",
                    f"{format_viewer(self._control_token.holder)} has it",
                    bad=True,
                )
        self._on_control_changed()

    def _on_late_press(self, age_s: float) -> None:
        self.notify("Not done", f"{format_age(age_s)}; press again if you still want it", bad=True)

    # --- commands --------------------------------------------------------------------------------------------

    def _change_lifecycle(self, button: str) -> None:
        if self._get_snapshot() is None or not self._is_in_control():
            return
        match button:
            case "Arm":
                self._arm(unchecked=False)
            case "Disarm":
                self.run_operation("Disarm", lambda: self._operations.disarm(self.name))
            case _:
                self.run_operation("Reset fault", lambda: self._operations.reset_fault(self.name))

    def _arm(self, *, unchecked: bool) -> None:
        """Arm the robot; offer to arm it unchecked, with a button of its own, once the host has refused."""
        snapshot = self._get_snapshot()
        if snapshot is None or not self._is_in_control():
            return
        robot = snapshot.robot
        is_armed = self.run_operation(
            "Arm", lambda: self._operations.arm(self.name, robot, unchecked=unchecked)
        )
        self._can_offer_unchecked = not is_armed
        self.refresh()

    def _control_simulator(self, action: str) -> None:
        """Pause, resume, step, reset or speed up the simulator."""
        if not self._is_in_control():
            return
        speed = float(self._speed_dropdown.value)
        order = SimulatorOrder(action, speed=speed, requester=self.name)
        self.run_operation(
            "Simulator", lambda: self._operations.control_simulator(self.name, order)
        )

    def _suggest_fault_target(self) -> None:
        """Enter an example of a target for the chosen kind of fault; simulator and clock are their own target."""
        _, target_type = FAULT_KIND_BY_LABEL[self._fault_kind_dropdown.value]
        self._fault_target_input.value = EXAMPLE_TARGET_BY_TYPE.get(target_type, target_type)

    def _inject_or_end_fault(self, *, end: bool) -> None:
        """Inject the chosen fault, or end it."""
        if not self._is_in_control():
            return
        kind, _ = FAULT_KIND_BY_LABEL[self._fault_kind_dropdown.value]
        target = self._fault_target_input.value.strip()
        order = FaultOrder(kind, target, end=end)
        self.run_operation("Fault", lambda: self._operations.inject_fault(self.name, order))

    def _apply_parameters(self) -> None:
        form = self._parameter_form
        if form is None or not self._is_in_control():
            return
        self.run_operation(
            "Parameters",
            lambda: self._operations.change_parameters(
                self.name, form.controller, form.encode_parameters()
            ),
        )

    def run_operation(self, title: str, operation: Callable[[], str]) -> bool:
        """Run an operation in the calling thread, and notify the viewer of its outcome.

        Only a few run at once, so that the operations of one viewer do not occupy all threads of viser.

        Args:
            title: Title of the notification.
            operation: Does the operation, and returns its result as text or raises a SnakesimError.

        Returns:
            Whether the operation was done; False if it failed, or if too many operations of this viewer run.
        """
        if not self._operation_slots.acquire(blocking=False):
            self.notify(title, "not done: what you asked for before is still under way", bad=True)
            return False
        try:
            self.notify(title, operation())
            return True
        except SnakesimError as error:
            self.notify(title, str(error), bad=True)
            return False
        except Exception as error:  # noqa: BLE001 - outermost in a thread of viser's, which reports to no viewer
            self._error_report.print_error(error)
            self.notify(
                title, f"not done: unexpected error: {type(error).__name__}: {error}", bad=True
            )
            return False
        finally:
            self._operation_slots.release()


def format_viewer(viewer_id: int | None) -> str:
    """Return the name of a viewer; None is no viewer."""
    return "no viewer" if viewer_id is None else f"viewer {viewer_id + 1}"
