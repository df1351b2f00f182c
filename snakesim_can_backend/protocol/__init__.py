"""The protocol of the joint modules on a CAN bus.

`definitions`  ids, opcodes, states and parameters     `codec`     frames to values and back, by the DBC file
`commands`     frames that the host sends              `expanded`  the DBC file with a message for every module
"""
