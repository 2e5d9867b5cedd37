"""Paths over a risk map: the row graph of the paper."""
