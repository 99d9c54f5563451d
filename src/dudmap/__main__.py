"""``python -m dudmap``."""

from dudmap.cli import main

main()
