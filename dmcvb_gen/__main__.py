"""`python -m dmcvb_gen` is `dmcvb-gen`."""

from dmcvb_gen.cli import main

main(prog_name="dmcvb-gen")
