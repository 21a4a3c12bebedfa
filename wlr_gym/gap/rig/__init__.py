"""Rigs of the gap workflow: a system of one's own, and one servo that swings a pendulum."""
