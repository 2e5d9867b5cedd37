"""What is wrong with a sequence before it is reconstructed: ``rille check``."""
