"""Transfer functions."""
