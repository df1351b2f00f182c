"""The main loop on the page for board builders compiles against the firmware as it is copied."""

import re
import subprocess
from pathlib import Path

import pytest

from snakesim_native.compile import list_compilers
from snakesim_native.libraries import PACKAGE
from snakesim_native.programs import STRICT_FLAGS

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/hardware/build-a-joint-module.md").read_text()
HEADER = PACKAGE / "joint_module" / "firmware" / "joint_module.h"
BOARD = """
void board_start(void);
void board_read_config(jm_config *config);
bool board_read_flash(jm_parameters *flash);
void board_write_flash(const jm_parameters *flash);
uint64_t board_now_us(void);
void board_read_sensors(jm_sensors *sensors);
bool board_receive(jm_frame *frame, jm_sensors *sensors);
float board_angle_rad(void);
float board_velocity_rad_s(void);
void board_set_bridge(bool is_on);
void board_set_torque_nm(float torque_nm);
void board_feed_bridge_watchdog(void);
bool board_has_free_mailbox(void);
void board_send(const jm_frame *frame);
"""


def test_the_main_loop_of_the_page_compiles(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```c\n(.+?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    include = '#include "joint_module.h"\n'
    assert block.startswith(include)
    source = tmp_path / "main.c"
    source.write_text(block.replace(include, include + BOARD, 1))
    command = [
        *list_compilers()[0],
        *STRICT_FLAGS,
        f"-I{HEADER.parent}",
        "-c",
        source,
        "-o",
        tmp_path / "main.o",
    ]
    completed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert completed.returncode == 0, completed.stderr


@pytest.mark.parametrize(
    "name", ["jm_receive", "jm_poll", "jm_pop_frame", "jm_compute_torque", "jm_pop_flash_write"]
)
def test_the_page_names_every_function_that_a_board_calls(name: str) -> None:
    assert f"{name}(" in HEADER.read_text()
    assert f"`{name}`" in PAGE
