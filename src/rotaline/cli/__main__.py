"""``python -m rotaline.cli``."""

from rotaline.cli.app import entry

entry()
