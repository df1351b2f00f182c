"""Commands that need no robot: checks of this computer, schemas, shipped files and shell completion.

`setup`   the arguments of these commands
`doctor`, `computer`, `kernel`, `network_findings`   what this computer has, and how to install what is missing
`schemas`, `roles_page`   write the published wire contract from the code
`plugin_sections`         which Struct checks a plugin's section of a scenario
`scenario_files`   lists scenarios, and shows the configuration that a scenario results in
`completion`       tab completion for bash and zsh
"""
