"""What Foxglove, PlotJuggler and Rerun show: messages that are made of the robot's messages.

`converter`      makes these messages as the robot's messages arrive
`topics`         their topics and schemas
`shapes`         transforms, shapes, arrows, paths and images
`body_frames`    joint states and transforms, in messages that are built once
`state_messages` messages for which Foxglove has no schema
`file_writer`    writes them into an MCAP file
`live_server`    serves them to Foxglove as they come, behind an `origin_relay`
"""
