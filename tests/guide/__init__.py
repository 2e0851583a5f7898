"""The guide: its site, its sentences about commands and keys, its evidence."""
