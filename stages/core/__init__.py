"""What every stage is made of: declarations, errors, validity masks."""
