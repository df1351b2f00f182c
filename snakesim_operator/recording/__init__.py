"""The recording of a robot: every message as it was on the wire, in an MCAP file that other programs open too.

Writing:
    `recorder_process`  the recorder, beside a run or any robot; it takes from a `tap` and writes with a `writer`
    `tap`               receives what a robot publishes, into a bounded queue
    `writer`            writes one recording, by `mcap_file` onto `disk`; `robot_time` dates the messages
    `foxglove`          converts messages for viewers; their topics are in `foxglove_topics`, their content is made by
                        `shapes`, `body_frames` and `state_messages`
    `live`              serves the same to Foxglove as it comes, behind an `origin_relay`

Reading:
    `reader`            reads a recording, also a damaged one or that of a killed recorder; `losses` counts what is lost
    `mcap_records`      reads single records and finds the next intact one; `chunks` unpacks them within bounds
    `recover`           makes a complete file of a damaged one
    `decoder`           decodes messages in `mcap`'s own reader
    `message`           what other packages need to know of recordings

On one damaged byte, `mcap`'s stream reader ends, and its indexed reader returns damaged messages unchecked. The reader
here loses one chunk.
"""
