"""Guidance: makes a world model of pose, contacts and obstacles for the other services.

`service`             the process, which makes world models with a `world_source`
`surveyed_source`     the source on a known map; `core` is its world model
`perceived_source`    the source for a map that begins empty

For a robot without a pose sensor or contact sensors on a known map:

`dead_reckoned_pose`  dead reckoning, corrected by `anchoring` to known obstacles
`estimated_contacts`  contacts from joint torques: `contact_estimate`, with `planar_dynamics` and `sparse_fit`

For a map that begins empty:

`perceived_world`     the world model from sensors alone
`localization`        the pose of the base: `odometry`, pose sensor and `scan_match`, over a `body_history`
`depth_scan`, `scan`  what ranging sensors see becomes a scan; `ground` is the plane below
`obstacle_map`        obstacles from scans, touches and the body's own path, with `clusters` of a scan
`tracks`              one obstacle: its `surfaces`, its shape by `circle_fit` or `box_fit`, its evidence
"""
