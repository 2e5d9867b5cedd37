"""Readers of text files: bounded, checked, with the file's name in every error."""
