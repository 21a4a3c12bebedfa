"""Measured-looking data sets with known missing effects, made by a simulator of its own.

Nothing here knows the code that names effects: the robot, its servos, every effect and every sensor are written a second time,
on MuJoCo with soft contacts. An import contract keeps it so. What is shared is text: the robot file and the effect vocabulary.
"""
