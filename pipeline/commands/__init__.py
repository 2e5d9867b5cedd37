"""The commands of ``rille``, by what they look after."""
