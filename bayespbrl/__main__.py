"""`python -m bayespbrl` is `bayespbrl`."""

from bayespbrl.cli import main

main()
