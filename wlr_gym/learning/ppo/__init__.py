"""Proximal policy optimisation with Stable-Baselines3 on the native batch of robots."""
