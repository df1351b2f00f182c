"""The controls of one viewer in the Commission tab, with which the viewer in control runs a step."""

from collections.abc import Callable
from functools import partial

import viser

from snakesim_hal.wire.quantities import MAX_JOINTS
from snakesim_operator.features.console.joint_step import BACKWARDS, ENTER, FORWARDS
from snakesim_operator.features.console.page.commissioning_tab import (
    DESCRIPTION_BY_STEP,
    CommissioningTab,
)
from snakesim_operator.features.console.page.page_html import escape_text
from snakesim_operator.features.console.web.admission import (
    MAX_HOLD_AGE_S,
    MAX_PRESS_AGE_S,
    ControlAdmission,
)
from snakesim_operator.features.console.web.message_age import PageAction

HOLD_REPEAT_HZ = 20.0  # `snakesim robot jog` counts a key as held for 0.15 s


class CommissioningControls:
    """The buttons of one viewer with which it runs a step."""

    def __init__(
        self,
        client: viser.ClientHandle,
        tab: viser.GuiFolderHandle,
        commissioning: CommissioningTab,
        admission: ControlAdmission,
        is_in_control: Callable[[], bool],
        run_operation: Callable[[str, Callable[[], str]], object],
        on_late_press: Callable[[float], None],
    ) -> None:
        """Add the buttons with which one viewer runs a commissioning step, such as a search for zeros, to its page.

        Args:
            client: The viewer's page.
            tab: Folder of the page in which the controls are put.
            commissioning: Runs the step.
            admission: Filter that decides which messages of the page count.
            is_in_control: Returns whether this viewer has control.
            run_operation: Runs an operation, and shows its title and its result to the viewer.
            on_late_press: Called with the age of a press that was too old.
        """
        self._viewer = client.client_id
        self._commissioning = commissioning
        self._is_in_control = is_in_control
        self._run_operation = run_operation
        with tab:
            self._folder = client.gui.add_folder("Run a step", order=2, visible=False)
        with self._folder:
            self._add_controls(client.gui)
        self._admit_controls(admission, on_late_press)
        self._step_dropdown.on_update(lambda _: self._show_chosen_step())
        self._start_button.on_click(lambda _: self._start_step())
        self._enter_button.on_click(lambda _: commissioning.press_key(self._viewer, ENTER))
        self._end_button.on_click(lambda _: self._end_step())
        self._show_chosen_step()

    def _add_controls(self, gui: viser.GuiApi) -> None:
        self._step_dropdown = gui.add_dropdown(
            "Step", tuple(DESCRIPTION_BY_STEP), initial_value="direction"
        )
        self._description = gui.add_html("")
        self._joint_input = gui.add_number("Joint (0: all)", 0, min=0, max=MAX_JOINTS, step=1)
        # Limits of a jog.
        self._speed_rad_s = gui.add_slider("Speed, rad/s", 0.01, 0.5, 0.01, 0.1)
        self._travel_rad = gui.add_slider("Travel, rad", 0.05, 3.2, 0.05, 0.2)
        self._torque_fraction = gui.add_slider("Share of torque", 0.05, 1.0, 0.05, 0.3)
        # Buttons.
        self._start_button = gui.add_button("Start step", color="blue")
        self._enter_button = gui.add_button("Enter")
        self._forwards_button = gui.add_button("Hold: forwards (+)", color="green")
        self._backwards_button = gui.add_button("Hold: backwards (-)", color="green")
        self._end_button = gui.add_button("End step", color="gray")

    def _admit_controls(
        self, admission: ControlAdmission, on_late_press: Callable[[float], None]
    ) -> None:
        """Let this viewer's page use the controls. A step ends at any age of the press; other presses may not be old.

        Args:
            admission: Filter that decides which messages of the page count.
            on_late_press: Called with the age of a press that was too old.
        """
        jog_inputs = (self._speed_rad_s, self._travel_rad, self._torque_fraction)
        for control in (self._step_dropdown, self._joint_input, *jog_inputs, self._end_button):
            admission.admit_control(control, self._viewer, self._is_in_control)
        for button in (self._start_button, self._enter_button):
            admission.admit_control(
                button,
                self._viewer,
                self._is_in_control,
                max_age_s=MAX_PRESS_AGE_S,
                on_late=on_late_press,
            )
        for button, key in ((self._forwards_button, FORWARDS), (self._backwards_button, BACKWARDS)):
            # The page repeats that a button is held only if viser has a callback for it.
            button.on_hold(lambda _: None, callback_hz=HOLD_REPEAT_HZ)
            admission.admit_control(
                button,
                self._viewer,
                self._is_in_control,
                HOLD_REPEAT_HZ,
                handler=partial(self._on_jog_held, key),
                max_age_s=MAX_HOLD_AGE_S,
            )

    def refresh(self) -> None:
        """Show the controls if this viewer may use them now."""
        self._folder.visible = self._commissioning.robot_file is not None and self._is_in_control()

    def _show_chosen_step(self) -> None:
        """Describe the chosen step, and show only the inputs that it has."""
        step_name = self._step_dropdown.value
        description = escape_text(DESCRIPTION_BY_STEP[step_name])
        self._description.content = (
            f"<div style='padding:.2em .6em;font-size:.85em'>{description}</div>"
        )
        self._joint_input.visible = step_name != "zero"
        self._enter_button.visible = step_name != "jog"
        jog_limits = (self._speed_rad_s, self._travel_rad, self._torque_fraction)
        for control in (*jog_limits, self._forwards_button, self._backwards_button):
            control.visible = step_name == "jog"

    def _on_jog_held(self, key: bytes, _viewer: int, _action: PageAction) -> None:
        """Send the step the key of a button that is held; admission has checked the message's age."""
        self._commissioning.press_key(self._viewer, key)

    def _start_step(self) -> None:
        step_name = self._step_dropdown.value
        joint_number = int(self._joint_input.value)
        joint_name = f"joint_{joint_number}" if joint_number else None  # 0: all joints
        options: list[str] = []
        if step_name == "jog":
            options += ["--joint-speed", f"{self._speed_rad_s.value:g}"]
            options += ["--travel", f"{self._travel_rad.value:g}"]
            options += ["--torque", f"{self._torque_fraction.value:g}"]
        if self._is_in_control():
            self._run_operation(
                "Joints",
                lambda: self._commissioning.start_step(
                    self._viewer, step_name, joint_name, options
                ),
            )

    def _end_step(self) -> None:
        if self._is_in_control():
            self._commissioning.end_step()
