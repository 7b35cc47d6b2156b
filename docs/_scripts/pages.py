"""Pages that the documentation makes of the code: one for each command of `dmcvb-gen`, and their index."""

import mkdocs_gen_files

from dmcvb_gen.cli import COMMANDS

with mkdocs_gen_files.open("cli/index.md", "w") as index:
    index.write("# Commands\n\n")
    for name, (target, summary) in COMMANDS.items():
        index.write(f"- [`dmcvb-gen {name}`]({name}.md): {summary}\n")
        module, attribute = target.split(":")
        with mkdocs_gen_files.open(f"cli/{name}.md", "w") as page:
            page.write(f"# dmcvb-gen {name}\n\n")
            page.write(f"::: mkdocs-click\n    :module: dmcvb_gen.cli.{module}\n    :command: {attribute}\n")
            page.write(f"    :prog_name: dmcvb-gen {name}\n    :depth: 1\n    :style: table\n")
