"""What a Python program imports as ``rille``: sequences, the steps of one pair, runs."""
