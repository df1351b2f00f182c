"""The bus protocol.

`definitions`  ids, opcodes, states, parameters     `codec`     frames to values and back, by the DBC file
`commands`     Commands and their answers           `expanded`  the DBC with a message for every module
"""
