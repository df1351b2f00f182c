"""The recording of a robot: every message as it was on the wire, in an MCAP file that other programs open too.

Writing:
    `process`         the recorder, beside a run or any robot; it takes from a `tap` and writes a `recording`
    `tap`             receives what a robot publishes, into a bounded queue
    `recording`       writes one file, by `mcap_file` onto `disk`; `robot_time` dates the messages
    `foxglove`        converts messages for viewers; their topics are in `foxglove_topics`, their content is made by
                      `shapes`, `body_frames` and `state_messages`
    `live`            serves the same to Foxglove as it comes, behind an `origin_relay`

Reading:
    `reader`          reads a file, also a damaged one or that of a killed recorder; `losses` counts what is missing
    `record_search`   reads single records and finds the next intact one; `chunks` unpacks them within bounds
    `recover`         makes a complete file of a damaged one
    `decoder`         decodes messages in `mcap`'s own reader
    `message`         what other packages need to know of recordings
"""
