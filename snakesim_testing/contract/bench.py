"""One backend with its settings, as the contract tests use it: opened by one user at a time, like a robot."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.model.scenario import Override, RunConfig, ServiceSchedule, load, parse_set
from snakesim_hal.programs.preflight import backend_settings, find_backend, with_backend_modes
from snakesim_hal.wire.messages import ClockMode
from snakesim_testing.contract.loopback import Hosted
from snakesim_testing.contract.rig import HOLDER, Rig

SCENARIO = str(Path(__file__).parent / "scenario.toml")
Mute = Callable[[Any, int], None]


class TorqueSwitch(NamedTuple):
    """One entry of the drives' own log: a drive has switched its torque."""

    time_s: float  # the drives' own time
    joint: int
    on: bool


class EmulatedDrives(Protocol):
    """The emulated drives of an open backend, for clauses about what drives do while their driver does nothing."""

    def enabled(self) -> list[bool]:
        """Return for each joint whether its drive would follow a setpoint now: in truth, not as the driver has it."""
        ...

    def freeze_driver(self, seconds: float, sleep: Callable[[float], None]) -> None:
        """Let time pass at the drives while nothing of the driver runs, as when its process is stopped.

        A driver with threads holds them meanwhile. `sleep` waits where the drives' time is that of a clock.
        """
        ...

    def now_s(self) -> float:
        """Return the drives' own time, which also passes while their driver does nothing."""
        ...

    def torque_log(self) -> list[TorqueSwitch]:
        """Return when drives have switched their torque on and off since this object was made, by `now_s`."""
        ...


DrivesOf = Callable[[Any], EmulatedDrives]


class Bench:
    """A backend with its settings: a column of the contract's table."""

    def __init__(
        self,
        name: str,
        backend: str | type[Backend],
        *,
        scenario: str = SCENARIO,
        sets: tuple[str, ...] = (),
        mute: Mute | None = None,
        drives: DrivesOf | None = None,
        unavailable: str | None = None,
    ) -> None:
        """Describe the backend without opening it.

        Args:
            name: of the column.
            backend: name of an installed backend, `./file.py:Class`, or the class itself.
            scenario: name or path of the scenario.
            sets: changes of the scenario, as `--set` of `snakesim run`.
            mute: `mute(backend, joint)` silences one joint module, as a broken wire does; None: not possible.
            drives: returns the emulated drives of an open backend; None: not possible.
            unavailable: why the bench cannot be used on this machine; None: it can.
        """
        self.name = name
        self.unavailable = unavailable
        self.mute = mute
        self.drives = drives
        self._backend = backend
        self._scenario = scenario
        self._sets = sets
        self._rig: Rig | None = None
        self._looked_at: tuple[Backend, EmulatedDrives] | None = None  # an open backend with its drives
        self.was_opened = False  # since the bench was made
        self._hosted: Hosted | None = None
        self._recordings: dict[str, Any] = {}

    # --- what it is ----------------------------------------------------------------------------------------

    @cached_property
    def backend_type(self) -> type[Backend]:
        """The backend's class. Raises ConfigError when there is no such backend."""
        if isinstance(self._backend, str):
            return find_backend(self._backend)
        return self._backend

    @cached_property
    def config(self) -> RunConfig:
        """The scenario with the backend, at the clock mode of the bench. Raises ConfigError."""
        backend = self._backend if isinstance(self._backend, str) else self.name
        overrides = [Override("backend", backend, "--snakesim-backend"), *map(parse_set, self._sets)]
        config = with_backend_modes(load(self._scenario, overrides).config, self.backend_type)
        # The tests' own controller is the only service.
        clock_modes = self.backend_type.check(config, backend_settings(config, self.backend_type))
        # Lockstep is preferred: it is quick, and the same on every machine.
        clock_mode = "lockstep" if "lockstep" in clock_modes else "realtime"
        return msgspec.structs.replace(config, clock_mode=clock_mode, services={HOLDER: ServiceSchedule()})

    @property
    def clock_mode(self) -> ClockMode:
        """The clock mode in which the tests run the backend."""
        return self.config.clock_mode

    # --- opening and closing -------------------------------------------------------------------------------

    def open(self) -> Backend:
        """Open the backend, and return it. The one that is open is closed first."""
        self.close()
        self.was_opened = True
        return self.backend_type(self.config, backend_settings(self.config, self.backend_type))

    def open_rig(self) -> Rig:
        """Open the backend, and return a rig with it."""
        backend = self.open()
        try:
            self._rig = Rig(backend, self.clock_mode, self.config.period_ns)
        except BaseException:
            backend.close()
            raise
        return self._rig

    def shared_rig(self) -> Rig:
        """Return the rig that tests share, because opening may be slow; a new one if it is not usable any more."""
        if self._rig is None or self._rig.spoiled:
            return self.open_rig()
        return self._rig

    def look_at_drives(self, backend: Backend) -> EmulatedDrives | None:
        """Return the emulated drives of an open backend, the same object each time; None if that is not possible."""
        if self.drives is None:
            return None
        if self._looked_at is None or self._looked_at[0] is not backend:
            self._looked_at = (backend, self.drives(backend))
        return self._looked_at[1]

    def shared_host(self) -> Hosted:
        """Return the backend behind a real host, which tests share."""
        if self._hosted is None:
            self._hosted = Hosted(self.open(), self.config)
        return self._hosted

    def reopen_for_next_test(self) -> None:
        """Close the backend, so that the next test opens it again: its state is unknown."""
        self.close()

    def close(self) -> None:
        """Close the open backend."""
        rig = self._rig
        hosted = self._hosted
        self._rig = None
        self._hosted = None
        if hosted is not None:
            hosted.close()
        if rig is not None and not rig.closed:
            rig.close()

    def record_once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return a recording that several tests read; the first of them makes it."""
        if name not in self._recordings:
            self._recordings[name] = make()
        return self._recordings[name]
