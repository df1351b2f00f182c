"""The recording of a robot: every message as it was on the wire, in an MCAP file that other programs open too.

`recording`   writes one file, by `mcap_file`        `tap`       takes what a robot publishes, bounded
`process`     the recorder, beside a run or any robot           `reader`   reads a file, also of a killed recorder
`foxglove`    channels that Foxglove and Rerun show             `shapes`   their messages, made of ours
`body_frames` transforms and joint states among them         `disk`     the file's bytes, cut back when a disk is full
`live`        serves those channels to Foxglove as they come    `robot_time` when a message was, in robot time
`recover`     makes a whole file of a torn one                  `state_messages` state, log and references for Foxglove
"""
