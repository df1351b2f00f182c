"""What one does with a recording: look what is in it, export it, play it back.

`arguments` the commands                `info`      what a recording holds
`play`      plays it on Zenoh           `control`   replays its sensors into guidance, navigation and control
`order`     its messages, tick by tick  `export`    tables, arrays, a dataset
"""
