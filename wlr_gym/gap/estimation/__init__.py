"""Estimation: fit models to runs, with the uncertainty of what was fitted."""
