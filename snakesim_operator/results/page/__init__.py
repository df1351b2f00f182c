"""What the report and the comparison share: charts, templates, colors, and the plotting library itself.

`charts`   figures over time, as plain data for Plotly     `html`      templates and numbers for people
`palette`  colors of both themes, one for each joint      `vendor/`   the library, copied into every page
"""
