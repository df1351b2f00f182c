"""The reference firmware in C as a child of the driver, on a local bus of its own."""

import subprocess
from pathlib import Path

from snakesim_can_backend.driver.own_emulators import EmulatorProcess
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.emulator_child import EmulatorChild
from snakesim_hal.model.scenario import RunConfig

BUS_FOLDER_NAME = "bus"
MODULES_NAME = "modules.txt"


class FirmwareProcess(EmulatorProcess):
    """The program `joint_modules` as a child that ends when this process closes its input."""

    def __init__(self, config: RunConfig, settings: CanSettings, *, is_stepped: bool) -> None:
        """Compile the program if necessary, start it, and wait until its modules are on the bus.

        Args:
            config: Configuration of the run, with the robot.
            settings: Settings of the backend.
            is_stepped: Whether time advances only from Sync to Sync.

        Raises:
            BackendError: The program cannot be compiled or started, ended at once, or was not ready in time.
        """
        super().__init__(config, settings, None, is_stepped=is_stepped)

    @property
    def channel(self) -> str:
        """Channel of the bus with the modules."""
        return f"local:{self._folder.name}/{BUS_FOLDER_NAME}"

    def _start(
        self,
        config: RunConfig,
        settings: CanSettings,
        pose_address: str | None,
        output_path: Path,
        *,
        is_stepped: bool,
    ) -> EmulatorChild:
        from snakesim_can_backend.emulator.reference_firmware import (
            build_program,
            describe_modules,
            make_program_arguments,
        )

        folder = Path(self._folder.name)
        modules_path = folder / MODULES_NAME
        modules_path.write_text(describe_modules(config, settings), encoding="utf-8")
        arguments = make_program_arguments(
            str(folder / BUS_FOLDER_NAME), str(modules_path), is_stepped=is_stepped
        )
        with output_path.open("wb") as output:
            process = subprocess.Popen(
                [str(build_program()), *arguments, "--until-input-ends"],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return EmulatorChild(process, output_path)
