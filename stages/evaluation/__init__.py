"""Comparisons with ground truth and with other estimates. No estimate reads them."""
