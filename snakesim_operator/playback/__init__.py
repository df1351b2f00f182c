"""What one does with a recording: look what is in it, export it, play it back.

`command`   the commands         `info`      what a recording holds
"""
