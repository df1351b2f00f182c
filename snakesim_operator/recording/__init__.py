"""The recording of a robot: every message as it was on the wire, in an MCAP file that other programs open too.

Writing:
    `recorder_process`   the recorder, beside a run or any robot; it takes from a `tap` and writes with a `writer`
    `tap`                receives what a robot publishes, into a bounded queue
    `writer`             writes one recording onto a `buffered_file`
    `robot_time`         dates messages in robot time; `log_clock` is the clock of the times in the file
    `foxglove_messages`  what viewers show, in the file and live

Reading:
    `reader`    reads a recording, also a damaged one or that of a killed recorder; `losses` counts what is lost
    `recover`   makes a complete file of a damaged one
    `message`   what other packages need to know of recordings

`mcap_format` is below both. On one damaged byte, the stream reader of the library `mcap` ends, and its indexed reader
returns damaged messages unchecked. The reader here loses one chunk.
"""
