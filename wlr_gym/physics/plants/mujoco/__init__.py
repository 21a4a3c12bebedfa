"""MuJoCo: the MJCF of a robot, and a plant of robots stepped by it, independent of the Gibbs-Appell engine's dynamics."""
