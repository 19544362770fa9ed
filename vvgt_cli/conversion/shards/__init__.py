"""The closed form of volumes that no memory holds: block by block, in any order, on any number of workers."""
