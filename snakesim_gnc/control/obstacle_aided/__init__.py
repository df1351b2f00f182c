"""The controller `obstacle_aided`: the whole body pushes itself forward off the obstacles that it touches.

`controller`     the law: what to command in each situation; the entry point `obstacle_aided`
`parameters`     the controller's parameters
`push_control`   how hard to push along the path, and the joint torques of this push
`push`           which contacts can push, and how a push is distributed among them
`look_ahead`     how far along its path the shape is commanded ahead of the body
`torque_mode`    torques that hold the shape without pushing, and drives that damp them
`front_steering` the joints ahead of all pushing contacts lead the body back onto its path
`push_report`    what the controller reports about the push, and why a body is stationary

`contact_search` moves a body that does not advance by a wave, until it lies where it can push;
`force_feedback_wave` is one of these waves.
"""

from snakesim_gnc.control.obstacle_aided.controller import ObstacleAided
from snakesim_gnc.control.obstacle_aided.parameters import ObstacleAidedParameters

__all__ = ["ObstacleAided", "ObstacleAidedParameters"]
