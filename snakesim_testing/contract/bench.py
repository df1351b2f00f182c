"""One backend with its settings, as the contract tests use it: opened by one user at a time, like a robot."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.model.scenario import Override, RunConfig, ServiceSchedule, load, parse_set
from snakesim_hal.programs.preflight import backend_settings, find_backend, with_backend_modes
from snakesim_hal.wire.messages import ClockMode
from snakesim_testing.contract.loopback import Hosted
from snakesim_testing.contract.rig import HOLDER, Rig

SCENARIO = str(Path(__file__).parent / "scenario.toml")
Mute = Callable[[Any, int], None]


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


DrivesOf = Callable[[Any], EmulatedDrives]


class Bench:
    """A column of the contract's table."""

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
        """backend: an installed one's name, `./file.py:Class`, or the class itself.

        sets: as `--set` of `snakesim run`; mute: `mute(backend, joint)` silences one joint's module, as by a
        broken wire; drives: gives the emulated drives of an open backend; unavailable: why the bench cannot
        be used on this machine.
        """
        self.name = name
        self.unavailable = unavailable
        self.mute = mute
        self.drives = drives
        self._backend = backend
        self._scenario, self._sets = scenario, sets
        self._rig: Rig | None = None
        self.was_opened = False  # at any time
        self._hosted: Hosted | None = None
        self._kept: dict[str, Any] = {}

    # --- what it is ----------------------------------------------------------------------------------------

    @cached_property
    def backend_type(self) -> type[Backend]:
        """The backend's class. Raises ConfigError when there is no such backend."""
        return find_backend(self._backend) if isinstance(self._backend, str) else self._backend

    @cached_property
    def config(self) -> RunConfig:
        """The scenario with the backend, at the clock mode of the bench. Raises ConfigError."""
        backend = self._backend if isinstance(self._backend, str) else self.name
        overrides = [Override("backend", backend, "--snakesim-backend"), *map(parse_set, self._sets)]
        config = with_backend_modes(load(self._scenario, overrides).config, self.backend_type)
        # The tests' own controller is the only service.
        clock_modes = self.backend_type.check(config, backend_settings(config, self.backend_type))
        clock_mode = (
            "lockstep" if "lockstep" in clock_modes else "realtime"
        )  # the first: quick, and the same on every machine
        return msgspec.structs.replace(config, clock_mode=clock_mode, services={HOLDER: ServiceSchedule()})

    @property
    def clock_mode(self) -> ClockMode:
        """At which clock mode the tests run it."""
        return self.config.clock_mode

    # --- opening and closing -------------------------------------------------------------------------------

    def open(self) -> Backend:
        """A new backend; an open one is closed before."""
        self.close()
        self.was_opened = True
        return self.backend_type(self.config, backend_settings(self.config, self.backend_type))

    def fresh_rig(self) -> Rig:
        """A rig on a fresh backend."""
        backend = self.open()
        try:
            self._rig = Rig(backend, self.clock_mode, self.config.period_ns)
        except BaseException:
            backend.close()
            raise
        return self._rig

    def rig(self) -> Rig:
        """The rig that tests share, since opening may be slow; a new one if that is spoiled."""
        return self._rig if self._rig is not None and not self._rig.spoiled else self.fresh_rig()

    def hosted(self) -> Hosted:
        """The backend behind a real host, shared like the rig."""
        if self._hosted is None:
            self._hosted = Hosted(self.open(), self.config)
        return self._hosted

    def spoil(self) -> None:
        """Reopen for the next test: after this one the backend's state is unknown."""
        self.close()

    def close(self) -> None:
        """Close the open backend."""
        rig, hosted = self._rig, self._hosted
        self._rig = self._hosted = None
        if hosted is not None:
            hosted.close()
        if rig is not None and not rig.closed:
            rig.close()

    def keep(self, name: str, make: Callable[[], Any]) -> Any:
        """A recording that several tests read, made by the first of them."""
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]
