"""`python -m wallmirror`."""

from wallmirror.cli import main

main()
