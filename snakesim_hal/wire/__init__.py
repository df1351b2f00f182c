"""The messages on the network, and their encoding.

`quantities`  numbers with their units and ranges      `messages`  the messages, made of them
`keys`        the keys: message, writer, rate          `codec`     MessagePack, checked on decoding
`outgoing`    the same checks before sending           `roles`     what each role may do at each key
`custom_sample`  messages of custom sensors          `setpoints` what a controller requests
`freshness`   the age up to which a joint state counts as fresh
"""
