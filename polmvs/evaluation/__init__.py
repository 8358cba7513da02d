"""Evaluation of results against ground truth and against their own data."""
