"""The base pose from a motion-capture system.

`mocap`            receives one UDP datagram for each captured frame
`mocap_sample`     the datagram
`mocap_times`      checks the timestamps of frames: their order, delay, and jumps of the system's clock
`emulated_mocap`   an emulated motion-capture system
"""
