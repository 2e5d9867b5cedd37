"""The commands of ``rille``."""
