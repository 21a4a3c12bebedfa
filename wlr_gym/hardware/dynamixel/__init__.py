"""Dynamixel servos: protocol, control tables, ports, buses."""
