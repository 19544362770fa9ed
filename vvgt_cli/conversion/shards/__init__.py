"""The closed form of volumes larger than memory: block by block, in any order, by any number of workers."""
