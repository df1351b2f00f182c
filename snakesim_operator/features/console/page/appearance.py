"""Colors and layout of the page, for all viewers or as one viewer chooses them."""

import viser

from snakesim_operator.features.console.web.admission import Admission

BRAND_COLOR = (0, 103, 176)


def set_appearance(gui: viser.GuiApi, *, dark: bool) -> None:
    """Set colors and layout of the page, for one viewer or for all."""
    gui.configure_theme(
        dark_mode=dark,
        show_logo=False,
        show_share_button=False,
        control_width="large",
        brand_color=BRAND_COLOR,
    )


def add_appearance(client: viser.ClientHandle, admission: Admission, *, dark: bool) -> None:
    """Add a checkbox with which a viewer chooses a dark page. dark: what the browser prefers, until then."""
    checkbox = client.gui.add_checkbox("Dark page", initial_value=dark, order=2.5)
    admission.admit(checkbox, client.client_id)
    checkbox.on_update(lambda _: set_appearance(client.gui, dark=checkbox.value))
    set_appearance(client.gui, dark=dark)
