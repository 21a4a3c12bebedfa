"""Dynamixel servos: protocol, control tables, buses, eight servos in SI units."""
