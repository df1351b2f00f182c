"""The control process: it runs one controller, holds the command lease, and sends setpoints.

`control_service`   calls the controller once a tick, and sends its setpoints
`freshness`         which inputs are fresh enough for the controller
`guarded`           checks the output of the controller
`live_parameters`   changes parameters while the robot runs
`update_times`      whether the controller is fast enough
`state_reports`, `states`, `advance`   the messages of `control/state`, with the four states of the paper's Figure 6
"""

from snakesim_gnc.control.service.control_service import ControlService

__all__ = ["ControlService"]
