"""The fields of configuration files: their types, their descriptions, and the JSON Schemas that are made of them.

`field_types`   finds the first value that a type does not allow
`field_words`   describes types, ranges and units in words
`field_docs`    describes the fields of a Struct
`json_schema`   the JSON Schema of a Struct
"""
