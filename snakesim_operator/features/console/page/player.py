"""The time slider of a recording: play, pause, speed, and a place in time. One for all viewers."""

import time

import viser

from snakesim_operator.features.console.web.server import PageServer

SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")
SLIDER_EVERY_S = 0.1


class Player:
    """Where in the recording the page is."""

    def __init__(self, server: PageServer, span_s: tuple[float, float], at_s: float = 0.0) -> None:
        """span_s: first and last instant; at_s: where to begin, seconds after the first."""
        self._begin_s, self._end_s = span_s
        self.time_s = min(max(self._begin_s + at_s, self._begin_s), self._end_s)
        self._now_s = self._shown_s = time.monotonic()
        self._moved = False
        gui = server.gui
        with gui.add_folder("Recording", order=2):
            last_s = max(self._end_s - self._begin_s, 0.01)
            self._slider = gui.add_slider("Time, s", 0.0, round(last_s, 2), 0.01, round(self.time_s - self._begin_s, 2))
            self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        for control in (self._slider, self._play, self._speed):
            server.admission.admit(control)
        self.playing = False
        self._play.on_click(lambda _: self._toggle())
        self._slider.on_update(lambda event: self._jump() if event.client is not None else None)

    def turn(self) -> tuple[float, bool]:
        """The time to show now, and whether it has jumped."""
        now_s = time.monotonic()
        passed_s, self._now_s = now_s - self._now_s, now_s
        if self.playing:
            self.time_s = min(self.time_s + passed_s * float(self._speed.value[:-1]), self._end_s)
            if now_s - self._shown_s > SLIDER_EVERY_S:
                self._shown_s = now_s
                self._slider.value = round(self.time_s - self._begin_s, 2)
            if self.time_s >= self._end_s:
                self._toggle()
        moved, self._moved = self._moved, False
        return self.time_s, moved

    @property
    def since_s(self) -> float:
        """The time shown, after the first instant."""
        return self.time_s - self._begin_s

    def go(self, since_s: float) -> None:
        """Show another instant; from any thread."""
        self.time_s, self._moved = min(max(self._begin_s + since_s, self._begin_s), self._end_s), True
        self._slider.value = round(self.since_s, 2)

    def _jump(self) -> None:
        self.time_s, self._moved = self._begin_s + self._slider.value, True

    def _toggle(self) -> None:
        self.playing = not self.playing
        if self.playing and self.time_s >= self._end_s:
            self.time_s, self._moved = self._begin_s, True
        self._play.label = "Pause" if self.playing else "Play"
