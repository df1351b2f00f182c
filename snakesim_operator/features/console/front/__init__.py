"""The front server of the console: the process that browsers connect to, and that has the second stop.

It needs neither viser nor websockets, so the second stop works while the page server is slow, stopped or gone.
"""
