"""Results against the truth, or against their own data."""
