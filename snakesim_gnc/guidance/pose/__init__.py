"""The pose of the base: dead reckoning, and what corrects it.

`localization`        a Kalman filter of dead reckoning, pose sensor and map, over a `body_history`
`odometry`            dead reckoning from joints, contacts and gyroscopes
`scan_match`          corrects the pose by a scan of known obstacles
`dead_reckoned_pose`  the pose of a robot without a pose sensor, corrected by `anchoring` to the obstacles it touches
"""
