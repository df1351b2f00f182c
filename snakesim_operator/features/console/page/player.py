"""The player of a recording: play, pause, speed, and a slider for the time. All viewers share one."""

import time

import viser

from snakesim_operator.features.console.web.viser_server import PageServer

SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")
SLIDER_PERIOD_S = 0.1  # between two updates of the slider while the recording plays


class RecordingPlayer:
    """The time in the recording that the page shows.

    The display loop calls `advance`; the threads of viser and of the web server move the time.
    """

    def __init__(
        self, server: PageServer, span_s: tuple[float, float], start_s: float = 0.0
    ) -> None:
        """Add the player to the page, paused.

        Args:
            server: Server of the page.
            span_s: Robot time of the first and of the last instant.
            start_s: Time to show first, in seconds after the first instant.
        """
        self._start_s, self._end_s = span_s
        self.time_s = self._clamp_time(self._start_s + start_s)  # robot time that is shown
        self.is_playing = False
        self._has_jumped = False
        # Wall clock.
        now_s = time.monotonic()
        self._last_advance_s = now_s
        self._last_slider_update_s = now_s
        self._add_controls(server)

    def _add_controls(self, server: PageServer) -> None:
        gui = server.gui
        last_s = round(max(self._end_s - self._start_s, 0.01), 2)  # a slider needs some length
        with gui.add_folder("Recording", order=2):
            self._slider = gui.add_slider("Time, s", 0.0, last_s, 0.01, round(self.elapsed_s, 2))
            self._play_button = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._speed_dropdown = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        for control in (self._slider, self._play_button, self._speed_dropdown):
            server.admission.admit_control(control)
        self._play_button.on_click(lambda _: self._toggle_playing())
        self._slider.on_update(self._on_slider)

    def advance_time(self) -> tuple[float, bool]:
        """Move the time on if the recording plays; called for each frame.

        Returns:
            The robot time to show now, and whether it was moved by a jump.
        """
        now_s = time.monotonic()
        elapsed_s = now_s - self._last_advance_s
        self._last_advance_s = now_s
        if self.is_playing:
            speed = float(self._speed_dropdown.value.removesuffix("x"))
            self.time_s = min(self.time_s + elapsed_s * speed, self._end_s)
            if now_s - self._last_slider_update_s > SLIDER_PERIOD_S:
                self._last_slider_update_s = now_s
                self._update_slider()
            if self.time_s >= self._end_s:
                self._toggle_playing()
        has_jumped = self._has_jumped
        self._has_jumped = False
        return self.time_s, has_jumped

    @property
    def elapsed_s(self) -> float:
        """The time shown, in seconds after the first instant."""
        return self.time_s - self._start_s

    def jump_to(self, since_begin_s: float) -> None:
        """Show another instant, given in seconds after the first one; from any thread."""
        self._jump_to_time(self._clamp_time(self._start_s + since_begin_s))
        self._update_slider()

    def _jump_to_time(self, time_s: float) -> None:
        self.time_s = time_s
        self._has_jumped = True

    def _clamp_time(self, time_s: float) -> float:
        return min(max(time_s, self._start_s), self._end_s)

    def _update_slider(self) -> None:
        self._slider.value = round(self.elapsed_s, 2)

    def _on_slider(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        """Jump to the time that a viewer chose. An event without a viewer comes from `_update_slider`."""
        if event.client is not None:
            self._jump_to_time(self._start_s + self._slider.value)

    def _toggle_playing(self) -> None:
        """Play or pause; at the end of the recording, play from the beginning."""
        self.is_playing = not self.is_playing
        if self.is_playing and self.time_s >= self._end_s:
            self._jump_to_time(self._start_s)
        self._play_button.label = "Pause" if self.is_playing else "Play"
