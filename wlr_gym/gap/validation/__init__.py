"""Validation: held-out runs, and tests of what the final model leaves."""
