"""Base of every stage: declarations, errors, validity masks."""
