"""Charts, drawings, templates and colors that all pages of results share.

`charts`   charts over time, as plain data for Plotly      `svg`      drawings of the snake and its forces
`palette`  colors of both themes, one for each joint       `html`     templates, and numbers for people
`vendor/`  Plotly itself, copied into every page, so that a page needs no network and no other file

Two technologies draw charts: Plotly on web pages, and matplotlib for papers (`features/figures`). The live charts of
the console are the exception. They are uPlot's, which viser's page contains: that costs no file and no package, and
redraws many lines several times a second on the page that has the stop button.
"""
