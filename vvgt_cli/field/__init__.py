"""A volume under its function, labels, layers and light: in memory, or in blocks."""
