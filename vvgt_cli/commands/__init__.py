"""Work of the smaller commands."""
