"""Mechanics of the robot: symbolic Gibbs-Appell derivation, the equations generated from it, and a plain numpy reference."""
