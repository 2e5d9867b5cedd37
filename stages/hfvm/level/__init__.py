"""Matching on one level of the pyramid: features, search, consistency."""
