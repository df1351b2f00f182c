"""MCAP files: writing them for little processor time, and reading them within bounds, also damaged ones.

`file_writer`  writes a chunked, indexed and compressed file
`records`      reads single records, and finds the next intact one behind damage
`chunks`       unpacks records within bounds
`decoder`      decodes the robot's messages in the reader of the library `mcap`
"""
