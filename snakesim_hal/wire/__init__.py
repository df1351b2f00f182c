"""What crosses the network, and how it looks there.

`quantities`  numbers with their units and ranges      `messages`  what is said, made of them
`keys`        where it is said, by whom, how often     `codec`     MessagePack, checked on reading
"""
