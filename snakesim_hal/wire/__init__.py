"""The messages on the network, and their encoding.

`quantities`  numbers with their units and ranges      `messages`  the messages, made of them
`keys`        the keys: message, writer, rate          `codec`     MessagePack, checked on decoding
`outgoing`    the same judgement before sending
"""
