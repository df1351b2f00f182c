"""What the report and the comparison share: charts, templates, colours, and the plotting library itself.

`charts`   figures over time, as plain data for Plotly     `html`      templates and numbers for people
`palette`  colours of both themes, one for each joint      `vendor/`   the library, copied into every page
"""
