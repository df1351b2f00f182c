"""The package of a driver type that `snakesim drive new` writes.

`minimal_driver`   a complete driver type with emulated drives, which the written package renames
`package_files`    the other files of the package
`new_command`      checks the name, and writes the files
"""
