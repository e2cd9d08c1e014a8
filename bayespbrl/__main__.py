"""`python -m bayespbrl` is `bayespbrl`."""

from bayespbrl.cli.commands import main

main()
