"""A volume with its look (functions, labels, layers, light), in memory or in blocks."""
