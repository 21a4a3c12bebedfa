"""Selection: screen candidate effects, compare the best, keep what is missing."""
