"""Evaluation: whole episodes as one batch, score cards with confidence intervals, and their plots."""
