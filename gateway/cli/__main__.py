"""`python -m gateway.cli` is `r2rgate`."""

from gateway.cli.main import main

main()
