"""Commands that watch running robots and change nothing: `snakesim topic rate`, `echo`, `preview`.

`watching`   the arguments of these commands; imports little, so that the command line starts quickly
`top`        every key of the robots on a network, as a table
`echo`       the messages on a key, or their rate
`preview`    small compressed copies of camera images
`traffic`    rates, sizes and ages of what arrives, for `top`
"""
