"""The controls of one viewer. Only the viewer in control can use them; everybody can stop the robot."""

from collections.abc import Callable

import viser

from snakesim_hal.errors import SnakesimError
from snakesim_hal.wire.messages import Description
from snakesim_operator.console.operations import Operations
from snakesim_operator.console.token import ControlToken

TOLD_S = 6.0


class Controls:
    """One viewer's buttons."""

    def __init__(
        self,
        client: viser.ClientHandle,
        folder: viser.GuiFolderHandle,
        token: ControlToken,
        operations: Operations,
        robot: Callable[[], Description | None],
        changed: Callable[[], None],
    ) -> None:
        """folder: where on the page; changed: called when control was taken or released."""
        self._client, self._token, self._operations = client, token, operations
        self._robot, self._changed = robot, changed
        self.viewer = client.client_id
        with folder:
            self._take = client.gui.add_button("Take control", icon=viser.Icon.HAND_STOP, color="blue")
            self._lifecycle = client.gui.add_button_group("Robot", ("Arm", "Disarm", "Clear"))
            self._dark = client.gui.add_checkbox("Dark page", initial_value=False)
        self._take.on_click(lambda _: self._take_or_release())
        self._lifecycle.on_click(lambda event: self._ask(event.target.value))
        self._dark.on_update(lambda _: dress(client.gui, dark=self._dark.value))
        self.show()

    @property
    def who(self) -> str:
        """The viewer's name."""
        return name_of(self.viewer)

    def show(self) -> None:
        """Enable what this viewer may use now."""
        mine, holder = self._token.holder == self.viewer, self._token.holder
        self._take.label = "Release control" if mine else "Take control"
        self._take.color = "gray" if mine else "blue"
        self._take.disabled = holder is not None and not mine
        taken = holder not in (None, self.viewer)
        self._take.hint = f"{name_of(holder)} has control, and may release it" if taken else None
        self._lifecycle.visible = mine

    def tell(self, title: str, text: str, *, bad: bool = False) -> None:
        """Show a message to this viewer."""
        self._client.add_notification(title, text, auto_close_seconds=TOLD_S, color="red" if bad else "green")

    def _take_or_release(self) -> None:
        if not self._token.release(self.viewer) and not self._token.take(self.viewer):
            self.tell("Not in control", f"{name_of(self._token.holder)} has it", bad=True)
        self._changed()

    def _ask(self, what: str) -> None:
        robot = self._robot()
        if robot is None or self._token.holder != self.viewer:
            return
        match what:
            case "Arm":
                self.do("Arm", lambda: self._operations.arm(self.who, robot))
            case "Disarm":
                self.do("Disarm", lambda: self._operations.disarm(self.who))
            case _:
                self.do("Clear", lambda: self._operations.clear(self.who))

    def do(self, title: str, call: Callable[[], str]) -> None:
        """Do something, and show its outcome."""
        try:
            self.tell(title, call())
        except SnakesimError as error:
            self.tell(title, str(error), bad=True)


def name_of(viewer: int | None) -> str:
    """A viewer in words."""
    return "nobody" if viewer is None else f"viewer {viewer + 1}"


def dress(gui: viser.GuiApi, *, dark: bool) -> None:
    """What the page looks like."""
    gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 103, 176)
    )
