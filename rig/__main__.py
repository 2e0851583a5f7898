"""`python -m rig`: the command, where no `rig` is on the path."""

from rig.cli.main import main

main()
