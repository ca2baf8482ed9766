"""`python -m pigjax` is the command `pigjax`."""

from pigjax.cli import main

main()
