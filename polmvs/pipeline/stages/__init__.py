"""One file for each group of stages."""
