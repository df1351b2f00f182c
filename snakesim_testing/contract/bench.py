"""The bench of a backend: the fixture around one backend under test, which the contract tests open like a robot.

A bench holds one backend with its settings. It opens the backend for one user at a time, and keeps what several tests
share. In the table of results, each bench is a column.
"""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.model.scenario import (
    KeyOverride,
    RunConfig,
    ServiceSchedule,
    load_scenario,
    parse_set_option,
)
from snakesim_hal.programs.preflight import (
    apply_backend_modes,
    decode_backend_settings,
    load_backend_class,
)
from snakesim_hal.wire.messages import ClockMode
from snakesim_testing.contract.loopback import HostedBackend
from snakesim_testing.contract.rig import LEASE_HOLDER, BackendRig

DEFAULT_SCENARIO = str(Path(__file__).parent / "scenario.toml")
MuteJoint = Callable[[Any, int], None]


class TorqueSwitch(NamedTuple):
    """One entry of the drives' own log: a drive has switched its torque on or off."""

    time_s: float  # the drives' own time
    joint: int
    is_on: bool


class EmulatedDrives(Protocol):
    """The emulated drives of an open backend, for clauses about drives whose driver does nothing."""

    def list_enabled(self) -> list[bool]:
        """Return for each joint whether its drive would follow a setpoint now, whatever the driver has received."""
        ...

    def freeze_driver(self, seconds: float, sleep: Callable[[float], None]) -> None:
        """Let time pass at the drives while nothing of the driver runs, as when its process is stopped.

        A driver with threads stops them for this time. `sleep` waits if the time of the drives is that of a clock.
        """
        ...

    def read_time_s(self) -> float:
        """Return the drives' own time, which also passes while their driver does nothing."""
        ...

    def list_torque_switches(self) -> list[TorqueSwitch]:
        """Return when drives have switched their torque on and off since this object was made, by `read_time_s`."""
        ...


MakeEmulatedDrives = Callable[[Any], EmulatedDrives]


class Bench:
    """The fixture around one backend under test: the backend with its settings, and what the contract tests share.

    A bench opens its backend for one user at a time: a rig without a network, or a host. In the table of results, each
    bench is a column.
    """

    def __init__(
        self,
        name: str,
        backend: str | type[Backend],
        *,
        scenario: str = DEFAULT_SCENARIO,
        overrides: tuple[str, ...] = (),
        mute_joint: MuteJoint | None = None,
        make_emulated_drives: MakeEmulatedDrives | None = None,
        unavailable_reason: str | None = None,
    ) -> None:
        """Store the backend and its settings, without opening the backend.

        Args:
            name: Name of the bench (this fixture), and of its column in the table of results.
            backend: Name of an installed backend, `./file.py:Class`, or the class itself.
            scenario: Name or path of the scenario.
            overrides: Changes of the scenario, as `--set KEY=VALUE` of `snakesim run` takes them.
            mute_joint: Function `mute_joint(backend, joint)` that disconnects one joint module, as a broken wire does.
                None if that is not possible.
            make_emulated_drives: Function that returns the emulated drives of an open backend. None if the backend
                has none.
            unavailable_reason: Reason why the bench cannot be used on this machine. None if it can.
        """
        self.name = name
        self.unavailable_reason = unavailable_reason
        self.mute_joint = mute_joint
        self.make_emulated_drives = make_emulated_drives
        self._backend = backend
        self._scenario = scenario
        self._overrides = overrides
        # The open backend: in a rig without a network, or in a host; None if it is closed.
        self._rig: BackendRig | None = None
        # An open backend and its emulated drives.
        self._open_backend_and_drives: tuple[Backend, EmulatedDrives] | None = None
        self.was_opened = False  # whether the backend was ever opened
        self._hosted_backend: HostedBackend | None = None
        # Measurements that several tests share.
        self._recording_by_name: dict[str, Any] = {}

    # --- what it is ----------------------------------------------------------------------------------------

    @cached_property
    def backend_type(self) -> type[Backend]:
        """The class of the backend. Raises ConfigError if there is no such backend."""
        if isinstance(self._backend, str):
            return load_backend_class(self._backend)
        return self._backend

    @cached_property
    def config(self) -> RunConfig:
        """The scenario with the backend, at the clock mode of the bench. Raises ConfigError."""
        backend = self._backend if isinstance(self._backend, str) else self.name
        overrides = [
            KeyOverride("backend", backend, "--snakesim-backend"),
            *map(parse_set_option, self._overrides),
        ]
        config = apply_backend_modes(
            load_scenario(self._scenario, overrides).config, self.backend_type
        )
        # The tests' own controller is the only service.
        clock_modes = self.backend_type.check(
            config, decode_backend_settings(config, self.backend_type)
        )
        # Lockstep is preferred, because it is faster and repeatable on every machine.
        clock_mode = "lockstep" if "lockstep" in clock_modes else "realtime"
        return msgspec.structs.replace(
            config, clock_mode=clock_mode, services={LEASE_HOLDER: ServiceSchedule()}
        )

    @property
    def clock_mode(self) -> ClockMode:
        """The clock mode in which the tests run the backend."""
        return self.config.clock_mode

    # --- opening and closing -------------------------------------------------------------------------------

    def load_config(self) -> RunConfig:
        """Load the scenario of the bench if it is not loaded yet, and return it. Raises ConfigError."""
        return self.config

    def open(self) -> Backend:
        """Open the backend, and return it. A backend that is still open is closed first."""
        self.close()
        self.was_opened = True
        return self.backend_type(
            self.config, decode_backend_settings(self.config, self.backend_type)
        )

    def open_rig(self) -> BackendRig:
        """Open the backend, and return a rig that drives it without a network."""
        backend = self.open()
        try:
            self._rig = BackendRig(backend, self.clock_mode, self.config.period_ns)
        except BaseException:
            backend.close()
            raise
        return self._rig

    def get_shared_rig(self) -> BackendRig:
        """Return the rig that tests share, because opening may be slow. It is replaced if it is not usable any more."""
        if self._rig is None or self._rig.must_reopen:
            return self.open_rig()
        return self._rig

    def find_emulated_drives(self, backend: Backend) -> EmulatedDrives | None:
        """Return the emulated drives of an open backend, or None if the bench has no access to them.

        For the same open backend, this returns the same object each time.
        """
        if self.make_emulated_drives is None:
            return None
        if self._open_backend_and_drives is None or self._open_backend_and_drives[0] is not backend:
            self._open_backend_and_drives = (backend, self.make_emulated_drives(backend))
        return self._open_backend_and_drives[1]

    def get_shared_host(self) -> HostedBackend:
        """Return the backend behind a real host, which tests share."""
        if self._hosted_backend is None:
            self._hosted_backend = HostedBackend(self.open(), self.config)
        return self._hosted_backend

    def reopen_for_next_test(self) -> None:
        """Close the backend, so that the next test opens it again: its state is unknown."""
        self.close()

    def close(self) -> None:
        """Close the open backend."""
        rig = self._rig
        hosted = self._hosted_backend
        self._rig = None
        self._hosted_backend = None
        if hosted is not None:
            hosted.close()
        if rig is not None and not rig.is_closed:
            rig.close()

    def record_once(self, name: str, make_recording: Callable[[], Any]) -> Any:
        """Return a recording that several tests share. It is made when it is first needed.

        Args:
            name: Name of the recording.
            make_recording: Makes the recording.
        """
        if name not in self._recording_by_name:
            self._recording_by_name[name] = make_recording()
        return self._recording_by_name[name]
