"""The whole loop in one go: learn, compare on ice, drive a robot with a secret, name the secret, prove it; one page."""
